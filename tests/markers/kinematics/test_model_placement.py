"""Points through which a model follows the segments of a person, with deviations and weights."""

import numpy as np
import pytest

from marey.body.articulation.model_scaling import JointPlaces
from marey.geometry.rotations import about
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.kinematics.model_placement import (
    SegmentPoint,
    StandingPosture,
    relative_weights,
    segment_point_paths,
    thorax_on_pelvis,
    with_upright_thorax,
)

X, Y, Z = np.eye(3)


def motion(rotation, origin=None, covariance=None):
    count = len(rotation)
    return BoneMotion(
        segments=("pelvis",), rotation=np.array(rotation)[:, None],
        origin=np.zeros((count, 1, 3)) if origin is None else np.array(origin)[:, None],
        covariance=np.zeros((count, 1, 6, 6)) if covariance is None else np.array(covariance)[:, None],
    )  # fmt: skip


def reference(rotation):
    joints = JointPlaces(names=(), places=np.zeros((0, 3)), covariance=np.zeros((0, 0)))
    return StandingPosture(
        joints=joints, segments=("pelvis",), rotation=rotation[None], origin=np.zeros((1, 3)), own_feet=True
    )


def point(offset, segment="pelvis"):
    return SegmentPoint(label="p", segment=segment, offset=np.array(offset), body="pelvis", place=np.zeros(3))


def test_a_point_moves_with_its_segment_and_has_the_deviation_of_its_rotation_and_origin():
    turn, sd = about(Y, 0.4), np.array([0.02, 0.03, 0.05, 0.001, 0.002, 0.004])
    paths, spread = segment_point_paths(
        [point([0.1, 0.0, 0.0])], motion([turn], [[1.0, 2.0, 3.0]], [np.diag(sd**2)])
    )
    np.testing.assert_allclose(paths[0, 0], [1.0, 2.0, 3.0] + turn @ [0.1, 0, 0])
    # A point on the axis X moves by rotations about Y and Z alone.
    variance = 0.1**2 * (sd[1] ** 2 + sd[2] ** 2) + (sd[3:] ** 2).sum()
    np.testing.assert_allclose(spread[0, 0], np.sqrt(variance / 3), rtol=1e-12)


def test_weights_are_inverse_variances_relative_to_the_largest():
    sd = np.array([[0.001, 0.002, np.nan], [0.001, 0.004, np.nan]])
    mean = (1 / 0.002**2 + 1 / 0.004**2) / 2
    expected = np.array([1e6, mean, np.median([1e6, mean])]) / 1e6
    np.testing.assert_allclose(relative_weights(sd), expected, rtol=1e-12)
    np.testing.assert_array_equal(relative_weights(np.full((2, 3), np.nan)), 1.0)


def test_an_unmeasured_thorax_is_upright_and_does_not_sway_with_the_pelvis():
    time = np.arange(400) / 100
    heading, sway = 0.7, 0.15 * np.sin(2 * np.pi * time)
    turns = [about(Y, heading + s) @ about(X, 0.1 * np.sin(7 * s)) @ about(Z, -0.2) for s in sway]
    moved, _ = with_upright_thorax(motion(turns), reference(about(Y, heading)), rate=100.0)
    thorax = moved.bone("thorax")[0]
    np.testing.assert_allclose(thorax[:, :, 1], np.tile(Y, (400, 1)), atol=1e-12)
    # Over whole seconds the pelvis faces ahead on average; a list about X changes it in the second order only.
    inside = thorax[60:-60]
    angle = np.arctan2(inside[:, 2, 0] * -1, inside[:, 0, 0])
    assert np.abs(angle - heading).max() < 0.01


def test_the_pelvis_carries_the_joint_of_the_thorax():
    turn = about(X, 0.3)
    origin = np.array([[1.0, 0, 0], [2.0, 0, 0]])
    moved, whole = with_upright_thorax(motion([turn, turn], origin), reference(np.eye(3)), rate=10.0)
    carried = thorax_on_pelvis(moved, whole, np.array([0.0, 0.1, 0.0]))
    np.testing.assert_allclose(carried.bone("thorax")[1], origin + turn @ [0, 0.1, 0])


def test_frames_without_a_pelvis_have_no_thorax():
    turns = np.stack([np.eye(3)] * 5)
    turns[2] = np.nan
    moved, _ = with_upright_thorax(motion(turns), reference(np.eye(3)), rate=2.0)
    assert moved.answered[:, 1].tolist() == [True, True, False, True, True]
    assert np.isnan(segment_point_paths([point([0, 0.1, 0], "thorax")], moved)[0][2]).all()


@pytest.mark.parametrize("scale", [1.0, 3.0])
def test_weights_do_not_depend_on_the_unit(scale):
    sd = np.array([[0.001, 0.002]])
    np.testing.assert_allclose(relative_weights(scale * sd), relative_weights(sd), rtol=1e-12)
