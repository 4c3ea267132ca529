import numpy as np
import pytest

from marey.motion.planted_feet import LegJoints, StanceSettings, leg_rotations, planted_feet, standing

RATE = 30.0
TIME = np.arange(90) / RATE


def steps(*, lifted=0.15, noise=0.0, rng=None):
    """A foot that stands for a second, goes half a metre forward in a half one, and stands again."""
    share = np.clip((TIME - 1.0) / 0.5, 0, 1)
    share = share * share * (3 - 2 * share)
    path = np.stack([0.1 + 0 * TIME, -0.5 * share, 0.03 + lifted * np.sin(np.pi * share)], axis=1)
    return path + (0 if rng is None else rng.normal(0, noise, path.shape))


def test_both_stands_of_a_step_are_found_in_noise(rng):
    found = standing(TIME, steps(noise=0.002, rng=rng), 0.03)
    assert len(found) == 2
    assert found[0].start == 0
    assert found[1].stop == len(TIME)
    assert 27 <= found[0].stop <= 34
    assert 41 <= found[1].start <= 47


def test_a_foot_held_in_the_air_or_dragged_does_not_stand():
    assert standing(TIME, steps() + [0, 0, 0.3], 0.03) == []
    dragged = np.stack([0.5 * TIME, 0 * TIME, 0.03 + 0 * TIME], axis=1)
    assert standing(TIME, dragged, 0.03) == []
    creeping = standing(TIME, 0.2 * dragged, 0.03)
    assert len(creeping) > 5
    assert max(rows.stop - rows.start for rows in creeping) <= 0.03 / 0.1 * RATE + 1


def test_the_settings_limit_the_duration_of_a_stance():
    assert standing(TIME, steps(), 0.03, StanceSettings(shortest_s=5.0)) == []


def test_a_gap_in_the_frames_ends_a_stand():
    time = np.concatenate([TIME[:20], TIME[20:] + 1.0])
    path = np.tile([0.1, 0.2, 0.03], (90, 1))
    assert standing(time, path, 0.03) == [slice(0, 20), slice(20, 90)]
    assert standing(time[:2], path[:2], 0.03) == []


def test_planted_feet_stay_in_place_and_move_smoothly_between_stands(rng):
    path = steps(noise=0.004, rng=rng)
    stands = [slice(0, 30), slice(45, 90)]
    shift = planted_feet(path, stands)
    for rows in stands:
        assert np.ptp(path[rows] + shift[rows], axis=0).max() < 1e-12
    assert np.linalg.norm(np.diff(shift[29:46], axis=0), axis=1).max() < 0.25 * np.linalg.norm(shift, axis=1).max()
    np.testing.assert_array_equal(planted_feet(path, []), 0)


def leg(rng, count=40):
    hip = rng.normal(0, 0.1, (count, 3)) + [0, 0, 0.9]
    knee = hip + [0, -0.05, -0.42] + rng.normal(0, 0.03, (count, 3))
    ankle = knee + [0, 0.08, -0.40] + rng.normal(0, 0.03, (count, 3))
    return LegJoints(hip, knee, ankle, np.tile([1.0, 0, 0], (count, 1)))


def test_a_leg_reaches_where_its_ankle_shall_be(rng):
    own = leg(rng)
    shift = rng.normal(0, 0.01, own.ankle.shape) + [0, 0, 0.02]
    thigh, shank = leg_rotations(own, shift)
    knee = own.hip + np.einsum("kab,kb->ka", thigh, own.knee - own.hip)
    ankle = knee + np.einsum("kab,kb->ka", shank, own.ankle - own.knee)
    np.testing.assert_allclose(ankle, own.ankle + shift, atol=1e-4)


def test_a_leg_that_need_not_move_does_not(rng):
    own = leg(rng)
    for turn in leg_rotations(own, np.zeros_like(own.ankle)):
        np.testing.assert_allclose(turn, np.broadcast_to(np.eye(3), turn.shape), atol=1e-6)


def test_a_straight_leg_bends_forward_at_the_knee():
    hip, knee, ankle = (np.array([[0.0, 0, z]]) for z in (0.9, 0.5, 0.1))
    thigh, shank = leg_rotations(LegJoints(hip, knee, ankle, np.array([[1.0, 0, 0]])), np.array([[0.0, 0, 0.05]]))
    bent = hip + np.einsum("kab,kb->ka", thigh, knee - hip)
    # Forward is -Y.
    assert bent[0, 1] < -0.05
    np.testing.assert_allclose(bent + np.einsum("kab,kb->ka", shank, ankle - knee), [[0, 0, 0.15]], atol=1e-9)


def test_what_is_out_of_reach_is_come_near_to():
    hip, knee, ankle = (np.array([[0.0, y, z]]) for y, z in ((0, 0.9), (-0.1, 0.5), (0, 0.1)))
    thigh, shank = leg_rotations(LegJoints(hip, knee, ankle, np.array([[1.0, 0, 0]])), np.array([[0.0, 0, -0.5]]))
    there = hip + np.einsum("kab,kb->ka", thigh, knee - hip) + np.einsum("kab,kb->ka", shank, ankle - knee)
    assert np.linalg.norm(there - hip) == pytest.approx(0.999 * 2 * np.hypot(0.1, 0.4))
    np.testing.assert_allclose(there[0, :2], 0, atol=1e-9)
