"""Laws of rotations, with angles from nothing to a half turn."""

import numpy as np
import pytest
import scipy.linalg

from marey.geometry import rotations

ANGLES = [0.0, 1e-12, 1e-7, 1e-5, 1e-3, 9.9e-3, 1.01e-2, 0.3, 2.0, 3.1]


def draw(rng, angle):
    axis = rng.normal(size=3)
    return axis / np.linalg.norm(axis) * angle


@pytest.mark.parametrize("angle", ANGLES)
def test_exp_agrees_with_the_matrix_exponential(rng, angle):
    vector = draw(rng, angle)
    np.testing.assert_allclose(rotations.exp(vector), scipy.linalg.expm(rotations.hat(vector)), atol=5e-15)


@pytest.mark.parametrize("angle", ANGLES)
def test_log_inverts_exp(rng, angle):
    vector = draw(rng, angle)
    np.testing.assert_allclose(rotations.log(rotations.exp(vector)), vector, atol=1e-14, rtol=1e-9)


@pytest.mark.parametrize("angle", [*ANGLES, np.pi - 1e-9, np.pi])
def test_the_kernel_finds_the_turn_between_rotations_as_log_does(rng, angle):
    for _ in range(8):
        first, turn = rotations.exp(rng.normal(size=3)), rotations.exp(draw(rng, angle))
        found = rotations.turn_between(first, turn @ first)
        # Half a turn may be found about either end of the axis: the rotation is the same.
        np.testing.assert_allclose(rotations.exp(found), turn, atol=1e-14)
        assert np.linalg.norm(found) <= np.pi + 1e-12


@pytest.mark.parametrize("angle", ANGLES)
def test_the_kernels_inverse_of_the_left_jacobian_is_the_same(rng, angle):
    vector = draw(rng, angle)
    ours, plain = rotations.inverse_left_jacobian_of(vector), rotations.inverse_left_jacobian(vector)
    np.testing.assert_allclose(ours, plain, atol=1e-12)


@pytest.mark.parametrize("angle", ANGLES)
def test_left_jacobian_is_the_derivative_of_exp(rng, angle):
    vector, step = draw(rng, angle), 1e-6
    jacobian = np.stack(
        [
            rotations.log(rotations.exp(vector + step * e) @ rotations.exp(vector - step * e).T) / (2 * step)
            for e in np.eye(3)
        ],
        -1,
    )
    np.testing.assert_allclose(rotations.left_jacobian(vector), jacobian, atol=1e-8)
    np.testing.assert_allclose(
        rotations.inverse_left_jacobian(vector) @ rotations.left_jacobian(vector), np.eye(3), atol=1e-11
    )


def test_quaternions_go_there_and_back_also_near_a_half_turn(rng):
    vectors = rng.normal(size=(500, 3))
    vectors *= (rng.uniform(0, np.pi, 500) / np.linalg.norm(vectors, axis=1))[:, None]
    vectors[:50] *= (np.pi - 1e-9) / np.linalg.norm(vectors[:50], axis=1)[:, None]
    turned = rotations.exp(vectors)
    np.testing.assert_allclose(rotations.from_quaternion(rotations.to_quaternion(turned)), turned, atol=1e-14)


def test_the_mean_of_turns_about_one_axis_is_the_middle_turn():
    turned = rotations.about(np.array([0.0, 0.0, 1.0]), np.array([-0.2, 0.1, 0.4]))
    np.testing.assert_allclose(rotations.log(rotations.mean(turned))[:2], 0, atol=1e-14)
    assert 0.05 < rotations.log(rotations.mean(turned))[2] < 0.15


def test_the_kernel_turns_as_the_formula(rng):
    out = np.empty((3, 3))
    for angle in ANGLES:
        axis = draw(rng, 1.0)
        rotations.turn_about(axis, angle, out)
        np.testing.assert_allclose(out, rotations.about(axis, angle), atol=1e-15)


@pytest.mark.parametrize("end", [[0.0, 2, 0], [0.3, -1, 2], [-3.0, 0, 0], [1.0, 0, 0]])
def test_the_shortest_turn_brings_one_direction_into_another(end):
    start = np.array([0.5, 0, 0])
    turn = rotations.shortest(start, np.array(end))
    np.testing.assert_allclose(turn @ [1, 0, 0], np.array(end) / np.linalg.norm(end), atol=1e-12)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    between = np.arccos(np.clip(end[0] / np.linalg.norm(end), -1, 1))
    assert np.linalg.norm(rotations.log(turn)) == pytest.approx(between, abs=1e-7)


def test_continuous_quaternions_are_the_same_rotations(rng):
    quaternions = rng.normal(size=(30, 4))
    found = rotations.continuous(quaternions)
    assert ((found[1:] * found[:-1]).sum(1) >= 0).all()
    np.testing.assert_array_equal(np.abs(found), np.abs(quaternions))
