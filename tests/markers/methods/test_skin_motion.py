from dataclasses import replace

import numpy as np
import pytest
from tests.skin_clusters import placed, problem, smooth_motion, thigh

from marey.markers.data.cluster_data import ClusterData, cluster_data
from marey.markers.methods.skin_motion import (
    CANDIDATE_SHARES,
    SkinMotion,
    SkinVarianceShares,
    filled_postures,
    learn_skin,
    shrink_sizes,
    without_gaps,
)

FRAMES = 120


def learned(rng, moved, markers=10, noise=5e-4, turn=None) -> SkinMotion:
    rotation, origin = smooth_motion(rng, FRAMES)
    points = placed(rotation, origin, thigh(rng, markers) + moved) + rng.normal(0, noise, (FRAMES, markers, 3))
    data = cluster(points, (rotation, origin))
    turn = np.zeros(FRAMES) if turn is None else turn
    return learn_skin(data, turn, np.arange(FRAMES) / 100, noise)


def cluster(points, bone, frames=(0,)) -> ClusterData:
    trial = problem({"thigh": bone}, {"thigh": points}, frames=list(frames))
    return cluster_data(trial, trial.clusters[0])


def test_noise_is_no_skin_motion(rng):
    skin = learned(rng, np.zeros((FRAMES, 10, 3)))
    # The noise's own variance is known to about one part in the root of half its 24 * 119 coordinates.
    assert skin.size < 5e-4 * np.sqrt(6) * np.sqrt(3 * np.sqrt(2 / (24 * FRAMES)))


def test_the_size_is_that_of_the_motion(rng):
    moved = rng.normal(0, 0.004, (FRAMES, 30, 3))
    moved[0] = 0
    assert learned(rng, moved, markers=30).size == pytest.approx(0.004 * np.sqrt(3), rel=0.1)


def test_skin_that_steps_with_the_joint_is_likelier_to_follow_it_than_to_wobble(rng):
    turn = np.cumsum(rng.uniform(0, 0.02, FRAMES))
    moved = np.cumsum(rng.normal(0, 0.001, (FRAMES, 10, 3)), 0)
    moved -= moved[0]
    scored = dict(zip(CANDIDATE_SHARES, learned(rng, moved, turn=turn).log_likelihood, strict=True))
    assert scored[SkinVarianceShares(turn=0.8)] > scored[SkinVarianceShares(turn=0.4)]


def test_the_modes_of_skin_with_two_modes_are_found(rng):
    courses = np.stack([np.sin(np.arange(FRAMES) / 7), np.cos(np.arange(FRAMES) / 3)], -1)
    moved = np.einsum("fr,rmk->fmk", courses - courses[0], rng.normal(0, 0.004, (2, 10, 3)))
    skin = learned(rng, moved)
    assert skin.form.rank >= 2
    assert skin.form.modes == 0.4
    assert len(skin.log_likelihood) == len(CANDIDATE_SHARES)


def test_three_markers_leave_none_out_and_keep_the_plain_form(rng):
    skin = learned(rng, rng.normal(0, 0.004, (FRAMES, 3, 3)), markers=3)
    assert skin.log_likelihood == ()
    assert skin.form.rank == 0


def test_a_loose_marker_counts_less(rng):
    moved = rng.normal(0, 0.001, (FRAMES, 10, 3))
    moved[:, 4] *= 20
    relative = learned(rng, moved).relative_sd
    assert relative.argmax() == 4
    assert relative[4] > 2 * np.delete(relative, 4).max()


def test_the_semivariance_is_a_half_on_the_mean_from_the_first_posture(rng):
    skin = learned(rng, rng.normal(0, 0.004, (FRAMES, 10, 3)), turn=np.linspace(0, 1, FRAMES))
    half = skin.semivariance(np.arange(1, FRAMES), np.array([0]))
    assert half.mean() == pytest.approx(0.5)
    assert skin.semivariance(np.array([7]), np.array([7])) == 0


def test_sizes_are_drawn_together_the_more_the_fewer_markers_there_are_and_rigid_clusters_stay(rng):
    few = learned(rng, rng.normal(0, 0.004, (FRAMES, 4, 3)), markers=4)
    many = replace(few, segment="pelvis", size=0.016, freedom=99)
    few = replace(few, segment="trunk", size=0.004)
    rigid = replace(few, segment="head", size=0.0)
    settled = shrink_sizes([few, many, rigid])
    assert 0.004 < settled[0].size < settled[1].size < 0.016
    assert settled[1].size > 0.013
    assert settled[2].size == 0
    assert shrink_sizes([few])[0].size == few.size


def test_a_marker_missing_in_a_posture_has_its_place_of_the_nearest(rng):
    bone = smooth_motion(rng, 9)
    points = placed(*bone, thigh(rng, 5))
    points[4, 2] = np.nan
    data = cluster(points, bone, frames=(0, 4, 8))
    filled = filled_postures(data)
    np.testing.assert_allclose(filled[1, 2], data.postures[0, 2])
    np.testing.assert_array_equal(filled[[0, 2]], data.postures[[0, 2]])


def test_gaps_are_filled_from_beside_and_what_is_never_known_is_zero():
    values = np.array([[np.nan, np.nan], [1.0, np.nan], [np.nan, np.nan], [3.0, np.nan]])
    np.testing.assert_array_equal(without_gaps(values), [[1, 0], [1, 0], [2, 0], [3, 0]])
