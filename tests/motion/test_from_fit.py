"""A fitted sequence as a motion: what is copied, what is derived, and how uncertain it is."""

from dataclasses import replace

import numpy as np
import pytest
from tests import worlds
from tests.performer import root_rotation

from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.skeleton import ROOT_COORDINATES, root_angles
from marey.fit.recipes.sequence import SequenceFit
from marey.geometry import rotations
from marey.motion import from_fit
from marey.motion.from_fit import coordinates_of, measure_piece, root_coordinates_from_turn
from marey.motion.motion import LOST, MEASURED, NO_PERSON

COUNT, FRAMES = 12, np.array([2, 3, 4, 5, 8, 9])


def motion_of(fit, **more):
    """The motion of a fit in two pieces."""
    half = len(fit.frames) // 2
    pieces = [
        replace(
            fit, frames=fit.frames[part], poses=fit.poses[part], covariance=fit.covariance[part],
            information=fit.information[part],
        )
        for part in (slice(0, half), slice(half, None))
    ]  # fmt: skip
    return from_fit.motion_of([measure_piece(piece) for piece in pieces], fit.body, **more)


@pytest.fixture
def fit(rng):
    body = worlds.person()
    degrees = len(body.skeleton)
    roots = rng.normal(size=(len(FRAMES), degrees, degrees)) * 0.003
    covariance = roots @ np.swapaxes(roots, 1, 2) + 1e-6 * np.eye(degrees)
    return SequenceFit(FRAMES, tuple(worlds.swing(body, len(FRAMES))), body, covariance, np.linalg.inv(covariance), 0.5)


@pytest.fixture
def motion(fit):
    lost = np.zeros(COUNT, bool)
    lost[6:8] = True
    agreement = {int(f): np.array([0.9, np.nan]) for f in FRAMES}
    return motion_of(fit, count=COUNT, rate=50.0, lost=lost, camera_names=("cam01", "cam02"), agreement=agreement)


def test_every_frame_of_the_video_has_a_row_and_missing_ones_are_nan(motion):
    expected = np.full(COUNT, NO_PERSON)
    expected[FRAMES], expected[6:8] = MEASURED, LOST
    np.testing.assert_array_equal(motion.state, expected)
    np.testing.assert_allclose(motion.time, np.arange(COUNT) / 50)
    rest = np.setdiff1d(np.arange(COUNT), FRAMES)
    for values in (
        motion.joint_centres, motion.joint_centres_sd, motion.segment_rotation, motion.segment_origin,
        motion.coordinates, motion.coordinates_sd, motion.angles_deg, motion.angles_deg_sd, motion.agreement,
    ):  # fmt: skip
        assert len(values) == COUNT
        assert np.isnan(values[rest]).all()
        assert np.isfinite(values[FRAMES]).any()
    for flags in (motion.determined, motion.angles_determined):
        assert flags.dtype == bool
        assert not flags[rest].any()


def test_joints_and_segments_are_those_of_the_poses(fit, motion):
    for frame, pose in zip(FRAMES, fit.poses, strict=True):
        posed = PosedBody(fit.body, pose)
        np.testing.assert_array_equal(motion.segment_rotation[frame], posed.segment_rotation)
        np.testing.assert_array_equal(motion.joint_centres[frame], posed.segment_origin[fit.body.joint_segments])


def test_coordinates_make_the_pose_again(fit, motion):
    for frame, pose in zip(FRAMES, fit.poses, strict=True):
        q = motion.coordinates[frame]
        again = Pose(q[:3], root_rotation(q[3:6]), q[6:])
        np.testing.assert_allclose(again.change_to(pose), 0, atol=1e-12)
    assert motion.coordinate_names[:6] == ROOT_COORDINATES


def test_turns_count_on_through_full_turns(fit):
    body = fit.body
    yaws = np.linspace(0, 4 * np.pi, len(FRAMES) * 3)
    frames = np.arange(len(yaws))
    covariance = np.tile(np.eye(len(body.skeleton)) * 1e-4, (len(yaws), 1, 1))
    turning = SequenceFit(
        frames, tuple(worlds.pose(body, yaw=yaw) for yaw in yaws), body, covariance, np.linalg.inv(covariance), 0.5
    )
    motion = motion_of(
        turning, count=len(yaws), rate=30.0, lost=np.zeros(len(yaws), bool), camera_names=(),
        agreement={int(f): np.zeros(0) for f in frames},
    )  # fmt: skip
    np.testing.assert_allclose(motion.coordinates[:, 3], yaws, atol=1e-9)


def test_the_roots_turns_follow_a_small_turn_as_the_derivative_predicts(rng):
    step = 1e-6
    for _ in range(10):
        rotation = root_rotation(rng.uniform(-1.3, 1.3, 3) * [2, 1, 2])
        derivative = root_coordinates_from_turn(rotation)
        for axis in np.eye(3):
            ahead, behind = (root_angles(rotations.exp(s * step * axis) @ rotation) for s in (1, -1))
            change = (ahead - behind + np.pi) % (2 * np.pi) - np.pi
            np.testing.assert_allclose(derivative @ axis, change / (2 * step), atol=1e-7)


def test_standard_deviations_are_those_of_poses_drawn_from_the_covariance(fit, motion, rng):
    k, frame = 2, FRAMES[2]
    pose, draws = fit.poses[k], 4000
    changes = rng.multivariate_normal(np.zeros(len(fit.covariance[k])), fit.covariance[k], draws)
    drawn = [PosedBody(fit.body, pose.step(change)) for change in changes]
    coordinates = np.array([coordinates_of(p.pose) for p in drawn])
    centres = np.array([p.segment_origin[fit.body.joint_segments] for p in drawn])
    # The spread of n draws errs by 1 / sqrt(2 n) = 1.1 %; the worst of a hundred by four times that, and curvature.
    np.testing.assert_allclose(motion.coordinates_sd[frame], coordinates.std(0), rtol=0.06)
    beneath = fit.body.joint_sd[fit.body.joint_segments][:, None]
    np.testing.assert_allclose(motion.joint_centres_sd[frame], np.hypot(centres.std(0), beneath), rtol=0.06)


def test_what_a_frame_does_not_fix_is_not_determined(fit):
    body = fit.body
    turn = 6 + worlds.column(body.skeleton, "left_pronation")
    information = np.array(100 * fit.information)
    information[:, turn, :] = information[:, :, turn] = 0.0
    agreement = {int(f): np.zeros(0) for f in FRAMES}
    motion = motion_of(
        replace(fit, information=information), count=COUNT, rate=30.0, lost=np.zeros(COUNT, bool), camera_names=(),
        agreement=agreement,
    )  # fmt: skip
    assert not motion.determined[FRAMES, turn].any()
    assert np.delete(motion.determined[FRAMES], turn, 1).all()
    angle = motion.angle_names.index("left_forearm_pronation")
    assert not motion.angles_determined[FRAMES, angle].any()
    assert np.delete(motion.angles_determined[FRAMES], angle, 1).all()


def test_an_angle_is_determined_where_only_its_division_among_coordinates_is_not(fit):
    body = fit.body
    turns = [6 + worlds.column(body.skeleton, f"{part}_rotation") for part in ("neck", "head")]
    information = 1e4 * np.tile(np.eye(len(body.skeleton)), (len(FRAMES), 1, 1))
    # The images show the sum of the two rotations about nearly the same axis, not each of them.
    for row in turns:
        information[:, row, turns] = 1e4
    motion = motion_of(
        replace(fit, information=information), count=COUNT, rate=30.0, lost=np.zeros(COUNT, bool), camera_names=(),
        agreement={int(f): np.zeros(0) for f in FRAMES},
    )  # fmt: skip
    assert not motion.determined[np.ix_(FRAMES, turns)].any()
    assert motion.angles_determined[FRAMES, motion.angle_names.index("head_rotation")].all()


def test_joints_that_lie_elsewhere_than_the_skin_indicates_are_as_much_less_certain(fit, motion):
    away = np.full(len(fit.body.skeleton.segment_names), 0.01)
    agreement = {int(f): np.zeros(2) for f in FRAMES}
    uncertain = motion_of(
        replace(fit, body=replace(fit.body, joint_sd=away)), count=COUNT, rate=50.0, lost=np.zeros(COUNT, bool),
        camera_names=("cam01", "cam02"), agreement=agreement,
    )  # fmt: skip
    certain = motion_of(
        replace(fit, body=replace(fit.body, joint_sd=None)), count=COUNT, rate=50.0, lost=np.zeros(COUNT, bool),
        camera_names=("cam01", "cam02"), agreement=agreement,
    )  # fmt: skip
    more = uncertain.joint_centres_sd[FRAMES] ** 2 - certain.joint_centres_sd[FRAMES] ** 2
    np.testing.assert_allclose(more, 0.01**2, rtol=1e-6)
    np.testing.assert_array_equal(uncertain.coordinates_sd, certain.coordinates_sd)


def test_frames_of_which_only_neighbours_spoke_are_flagged(fit):
    agreement = {int(f): np.zeros(0) for f in FRAMES}
    more = {"count": COUNT, "rate": 30.0, "lost": np.zeros(COUNT, bool), "camera_names": (), "agreement": agreement}
    motion = motion_of(fit, filled={4, 8}, **more)
    assert motion.state.tolist() == [0, 0, 1, 1, 2, 1, 0, 0, 2, 1, 0, 0]
    assert np.isfinite(motion.joint_centres[[4, 8]]).all()


def test_angles_that_the_model_holds_still_are_left_out(motion):
    assert "left_elbow_flexion" in motion.angle_names
    assert not {"left_elbow_adduction", "right_ankle_rotation"} & set(motion.angle_names)
    assert motion.angles_deg.shape == motion.angles_deg_sd.shape == (COUNT, len(motion.angle_names))


def test_the_constant_offset_of_joint_centres_is_a_part_of_the_whole_deviation(fit, motion):
    own, whole = from_fit.joint_centre_sds(motion, replace(fit.body, joint_offset_sd=None))
    assert own == whole
    offset = np.full(len(fit.body.skeleton.segment_names), 0.012)
    own, whole = from_fit.joint_centre_sds(motion, replace(fit.body, joint_offset_sd=offset))
    assert whole > max(0.012, own)
    # All joints have one offset here, so that the median coordinate is the same.
    assert whole == pytest.approx(np.hypot(own, 0.012), rel=1e-6)


def test_what_a_preset_does_not_follow_has_no_joint_centre_and_no_angle(fit, motion):
    names = fit.body.skeleton.segment_names
    followed = np.array([name not in ("left_shank", "left_foot", "left_toes") for name in names])
    partly = motion_of(
        replace(fit, body=replace(fit.body, followed=followed)), count=COUNT, rate=50.0, lost=np.zeros(COUNT, bool),
        camera_names=("cam01", "cam02"), agreement={int(f): np.zeros(2) for f in FRAMES},
    )  # fmt: skip
    gone = [
        name
        for name in partly.joint_names
        if np.isnan(partly.joint_centres[FRAMES, partly.joint_names.index(name)]).all()
    ]
    # The knee still turns on a thigh that is followed.
    assert gone == ["left_ankle", "left_toe"]
    angles = [name for k, name in enumerate(partly.angle_names) if np.isnan(partly.angles_deg[FRAMES, k]).all()]
    assert angles == [name for name in partly.angle_names if name.startswith(("left_knee", "left_ankle", "left_toe"))]
    np.testing.assert_array_equal(partly.segment_rotation, motion.segment_rotation)
