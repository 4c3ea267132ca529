from dataclasses import replace

import numpy as np
import pytest
from tests.skin_clusters import leg_and_bones, leg_bones, placed, problem, rigid_leg, thigh, turns

from marey.errors import MareyError
from marey.geometry import rotations
from marey.markers.data.rigid_fit import rigid
from marey.markers.methods.joint_turn import segment_turn
from marey.markers.methods.multiple_calibration import multiple_calibration, places_at


def test_places_lie_on_the_postures_between_them_and_hold_beyond(rng):
    postures = rng.normal(size=(3, 4, 3))
    at = np.array([0.0, 1.0, -0.5])
    places = places_at(np.array([0.0, 1.0, -0.5, 0.5, 2.0, np.nan]), at, postures)
    np.testing.assert_allclose(places[:3], postures)
    np.testing.assert_allclose(places[3], (postures[0] + postures[1]) / 2)
    np.testing.assert_allclose(places[4], postures[1])
    assert np.isnan(places[5]).all()


def test_a_marker_missing_in_one_posture_is_taken_from_the_others(rng):
    postures = rng.normal(size=(2, 4, 3))
    postures[1, 2] = np.nan
    places = places_at(np.array([0.3]), np.array([0.0, 1.0]), postures)
    np.testing.assert_allclose(places[0, 2], postures[0, 2])


def test_skin_that_follows_the_joint_in_proportion_is_removed_whole(rng):
    bones = leg_bones(rng, 40)
    flexion = turns(bones["thigh"][0], bones["shank"][0])
    skin = flexion[:, None, None] * rng.normal(0, 0.01, (1, 9, 3))
    points = {
        "thigh": placed(*bones["thigh"], thigh(rng, 9) + skin),
        "shank": placed(*bones["shank"], -thigh(rng, 7)),
    }
    leg = problem(bones, points, frames=[0, 20])
    motion = multiple_calibration(leg)
    assert turns(motion.rotation[:, 0], bones["thigh"][0]).max() < 1e-9
    assert turns(rigid(leg).rotation[:, 0], bones["thigh"][0]).max() > 0.01


def test_the_known_postures_are_reproduced_exactly(rng):
    leg, bones = leg_and_bones(rng, known=[3, 20])
    points = leg.trajectories.points + rng.normal(0, 0.005, leg.trajectories.points.shape)
    motion = multiple_calibration(replace(leg, trajectories=replace(leg.trajectories, points=points)))
    for frame in (3, 20):
        assert turns(motion.rotation[frame, 1], bones["shank"][0][frame]) < 1e-9


def test_one_posture_is_an_error(rng):
    with pytest.raises(MareyError, match="at least two postures"):
        multiple_calibration(rigid_leg(rng))


def test_two_equal_postures_are_reported_and_fitted_rigidly(rng):
    leg = rigid_leg(rng, known=[0, 0])
    motion = multiple_calibration(leg)
    assert any("differ too little" in note for note in motion.notes)
    np.testing.assert_allclose(motion.rotation, rigid(leg).rotation)


def test_a_missing_cluster_leaves_its_frames_empty(rng):
    leg = rigid_leg(rng, known=[0, 20])
    points = leg.trajectories.points.copy()
    points[5, :8] = np.nan
    motion = multiple_calibration(replace(leg, trajectories=replace(leg.trajectories, points=points)))
    assert np.flatnonzero(~motion.answered[:, 0]).tolist() == [5]


def test_where_the_joints_turn_is_not_known_the_mean_shape_is_fitted_and_is_reported(rng):
    leg, bones = leg_and_bones(rng, known=[0, 20])
    points = leg.trajectories.points.copy()
    points[5, :8] = np.nan
    motion = multiple_calibration(replace(leg, trajectories=replace(leg.trajectories, points=points)))
    assert turns(motion.rotation[5, 1], bones["shank"][0][5]) < 1e-9
    assert any("shank: 1 of 40 frames are fitted by the mean shape" in note for note in motion.notes)


def test_the_turn_of_a_hinge_is_its_flexion(rng):
    for known in ([0, 20], [0]):
        leg, bones = leg_and_bones(rng, known=known)
        turn = segment_turn(leg, rigid(leg), "shank")
        flexion = np.linalg.norm(rotations.log(bones["thigh"][0].swapaxes(1, 2) @ bones["shank"][0]), axis=1)
        np.testing.assert_allclose(turn.turn, flexion, atol=1e-9)


def test_a_segment_without_a_joint_turns_in_the_laboratory(rng):
    leg, bones = leg_and_bones(rng, known=[0, 20])
    turn = segment_turn(replace(leg, joints=()), rigid(leg), "thigh")
    assert turn.at_postures[1] == pytest.approx(turns(bones["thigh"][0][0], bones["thigh"][0][20]))


def test_what_does_not_turn_has_no_turn(rng):
    leg = rigid_leg(rng)
    still = np.broadcast_to(leg.trajectories.points[0], leg.trajectories.points.shape)
    leg = replace(leg, trajectories=replace(leg.trajectories, points=still))
    assert segment_turn(leg, rigid(leg), "shank") is None
