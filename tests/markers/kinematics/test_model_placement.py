"""Points through which a model follows the segments of a person, with deviations and weights."""

import numpy as np
import pytest

from marey.body.articulation.jointed_kinematics import place
from marey.body.articulation.model_scaling import JointPlaces, centre_in_ground, model_joints, neutral_posture
from marey.geometry.rotations import about
from marey.io.opensim.osim_model import read_osim_model
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.kinematics.model_placement import (
    POINT_DISTANCE_M,
    SegmentPoint,
    StandingPosture,
    place_segment_points,
    relative_weights,
    segment_point_paths,
    with_carried_segments,
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
    moved, _ = with_upright_thorax(motion([turn, turn], origin), reference(np.eye(3)), rate=10.0)
    carried = with_carried_segments(moved, {"thorax": ("pelvis", np.array([0.0, 0.1, 0.0]))})
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


def joint(kind, name, parent, child, at, coordinates):
    listed = "".join(f"<Coordinate name='{c}'/>" for c in coordinates.split())
    frames = "".join(
        f"<PhysicalOffsetFrame name='{body}_offset'><socket_parent>{'/' if body == 'ground' else '/bodyset/'}{body}"
        f"</socket_parent><translation>{place}</translation></PhysicalOffsetFrame>"
        for body, place in ((parent, at), (child, "0 0 0"))
    )
    return (
        f"<{kind} name='{name}'><socket_parent_frame>{parent}_offset</socket_parent_frame><socket_child_frame>"
        f"{child}_offset</socket_child_frame><coordinates>{listed}</coordinates><frames>{frames}</frames></{kind}>"
    )


@pytest.fixture
def whole(tmp_path):
    """A model of legs, a trunk of one body, and arms."""
    joints = [joint("FreeJoint", "base", "ground", "pelvis", "0 0.9 0", "a b c x y z")]
    joints += [joint("BallJoint", "back", "pelvis", "torso", "-0.1 0.1 0", "d e f")]
    bodies = ["pelvis", "torso"]
    for side, z in (("l", -1), ("r", 1)):
        for kind, name, parent, at, count in (
            ("BallJoint", "femur", "pelvis", f"-0.07 -0.06 {0.08 * z}", 3),
            ("PinJoint", "tibia", "femur", "0 -0.4 0", 1), ("PinJoint", "talus", "tibia", "0 -0.4 0", 1),
            ("PinJoint", "toes", "talus", "0.18 -0.04 0", 1),
            ("BallJoint", "humerus", "torso", f"0 0.37 {0.17 * z}", 3), ("PinJoint", "ulna", "humerus", "0 -0.29 0", 1),
            ("PinJoint", "hand", "ulna", "0 -0.25 0", 1),
        ):  # fmt: skip
            above = parent if parent in ("pelvis", "torso") else f"{parent}_{side}"
            named = " ".join(f"{name}_{side}_{n}" for n in range(count))
            joints.append(joint(kind, f"{name}_{side}_joint", above, f"{name}_{side}", at, named))
            bodies.append(f"{name}_{side}")
    listed = "".join(f"<Body name='{name}'/>" for name in bodies)
    (tmp_path / "whole.osim").write_text(
        f"<OpenSimDocument Version='40000'><Model name='m'><BodySet><objects>{listed}</objects></BodySet><JointSet>"
        f"<objects>{''.join(joints)}</objects></JointSet></Model></OpenSimDocument>"
    )
    return read_osim_model(tmp_path / "whole.osim")


def test_shoulders_and_elbows_elsewhere_than_in_the_model_do_not_turn_its_pelvis(whole):
    joints = model_joints(whole)
    placed = place(whole, neutral_posture(whole))
    places = {name: centre_in_ground(whole, placed, body) for name, body in joints.items()}
    for name in places:
        if name.split("_")[1] in ("shoulder", "elbow", "wrist"):
            places[name] = places[name] + [0.06, -0.05, 0.0]
    hips = (places["left_hip"] + places["right_hip"]) / 2
    segments = {"pelvis": hips, "thorax": hips}
    for side in ("left", "right"):
        for segment, name in (("thigh", "hip"), ("shank", "knee"), ("upperarm", "shoulder"), ("forearm", "elbow")):
            segments[f"{side}_{segment}"] = places[f"{side}_{name}"]
    posture = StandingPosture(
        joints=JointPlaces(
            names=tuple(places), places=np.array(list(places.values())), covariance=np.zeros((3 * len(places),) * 2)
        ),
        segments=tuple(segments), rotation=np.tile(np.eye(3), (len(segments), 1, 1)),
        origin=np.array(list(segments.values())), own_feet=True,
    )  # fmt: skip
    found = place_segment_points(whole, joints, posture)
    at = {point.label: point.place for point in found.points}
    for segment in ("pelvis", "thorax", "left_thigh", "right_upperarm", "left_forearm"):
        for ending, axis in zip("xyz", np.eye(3), strict=True):
            step = at[f"{segment}_{ending}"] - at[f"{segment}_o"]
            # Coordinates are held at 0 by a weight of 1e-6 only; nothing else acts against the axes.
            np.testing.assert_allclose(step, POINT_DISTANCE_M * axis, atol=1e-5)
    # Thorax and arms are where the model has their joints.
    np.testing.assert_allclose(at["thorax_o"], 0.0, atol=1e-6)
    np.testing.assert_allclose(at["left_upperarm_o"], 0.0, atol=1e-6)
    assert found.carried["left_upperarm"][0] == "thorax"
    np.testing.assert_allclose(found.carried["left_upperarm"][1], [0.0, 0.37, -0.17], atol=1e-5)
    np.testing.assert_allclose(found.carried["left_forearm"][1], [0.0, -0.29, 0.0], atol=1e-5)
