import numpy as np

from marey.markers.methods.joint_constraints import krige


def linear(first, second):
    return np.abs(np.asarray(first)[:, None] - np.asarray(second))


def test_known_frames_get_themselves_back_and_weights_sum_to_one(rng):
    place, known = rng.uniform(0, 3, 30), np.array([4, 11, 20])
    weights, variance = krige(linear(place, place[known]), linear(place[known], place[known]))
    np.testing.assert_allclose(weights.sum(1), 1, atol=1e-12)
    np.testing.assert_allclose(weights[known], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(variance[known], 0, atol=1e-12)


def test_independent_steps_are_interpolated_linearly_and_held_beyond():
    place, known = np.array([-1.0, 0.0, 0.25, 1.0, 3.0]), np.array([0.0, 1.0])
    weights, variance = krige(linear(place, known), linear(known, known))
    np.testing.assert_allclose(weights[:, 1], [0, 0, 0.25, 1, 1], atol=1e-12)
    # Half the variance a step: a walk of length t has variance 2t, a bridge between ends 1 apart 2t(1 - t).
    np.testing.assert_allclose(variance[2], 2 * 0.25 * 0.75, atol=1e-12)


def test_one_known_frame_holds_everywhere_with_the_variance_of_the_difference():
    weights, variance = krige(np.array([[0.0], [2.0]]), np.zeros((1, 1)))
    np.testing.assert_allclose(weights, 1)
    np.testing.assert_allclose(variance, [0, 4], atol=1e-12)


def test_a_frame_known_twice_shares_its_weight():
    known = np.array([0.0, 0.0, 1.0])
    weights, _ = krige(linear([0.0, 0.5], known), linear(known, known))
    np.testing.assert_allclose(weights, [[0.5, 0.5, 0], [0.25, 0.25, 0.5]], atol=1e-12)
