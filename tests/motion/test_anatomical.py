"""Anatomical angles have the meaning of their names on both sides, and their standard deviations are correct."""

import re
from pathlib import Path

import numpy as np
import pytest
from tests import performer

from marey.body.articulation.presets import PRESETS
from marey.body.articulation.surface import Body
from marey.body.people.person import preset_body
from marey.errors import MareyError
from marey.geometry import rotations
from marey.motion import anatomical
from marey.motion.anatomical import FORWARD, RIGHT, UP

SIDES = ("left", "right")


@pytest.fixture(scope="module")
def anatomy(person: Body) -> anatomical.Anatomy:
    return anatomical.anatomy_of(person.skeleton, person.joint_centres)


def bent(person: Body, anatomy: anatomical.Anatomy, degrees: dict[str, float]) -> dict[str, float]:
    """Give the angles [degrees] of the body at rest after some of its coordinates were turned."""
    q = np.zeros((1, len(person.skeleton)))
    for name, value in degrees.items():
        q[0, person.skeleton.coordinate_names.index(name)] = np.radians(value)
    values = anatomical.anatomical_angles(anatomy, performer.pose(person, q[0]).segment_rotation[None])
    return dict(zip(anatomy.angle_names, np.degrees(values[0]), strict=True))


def placed(anatomy: anatomical.Anatomy, frames: dict[str, np.ndarray]) -> dict[str, float]:
    """Give the angles [degrees] where some segments' anatomical frames lie as given and all others as at rest."""
    turn = np.tile(np.eye(3), (1, len(anatomy.segment_names), 1, 1))
    for name, frame in frames.items():
        k = anatomy.segment_names.index(name)
        turn[0, k] = frame @ anatomy.frames[k].T
    values = anatomical.anatomical_angles(anatomy, turn)
    return dict(zip(anatomy.angle_names, np.degrees(values[0]), strict=True))


def test_an_angle_is_between_the_two_segments_of_its_joint():
    assert anatomical.segments_of_angle("left_knee_flexion") == ("left_thigh", "left_shank")
    assert anatomical.segments_of_angle("right_hip_rotation") == ("pelvis", "right_thigh")
    assert anatomical.segments_of_angle("head_flexion") == ("thorax", "head")
    assert anatomical.segments_of_angle("right_forearm_pronation") == ("right_upperarm", "right_forearm")
    for name in ("pelvis_tilt", "knee_flexion", "left_knee_valgus"):
        assert anatomical.segments_of_angle(name) is None


def test_frames_are_right_handed_with_anterior_up_and_right(anatomy: anatomical.Anatomy):
    frames = anatomy.frames
    np.testing.assert_allclose(frames @ np.swapaxes(frames, 1, 2), np.tile(np.eye(3), (len(frames), 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(frames), 1)
    for k, name in enumerate(anatomy.segment_names):
        x, y, z = frames[k].T
        assert y @ UP > 0.7, name
        if "arm" not in name and "hand" not in name:
            assert x @ FORWARD > 0.9, name
            assert z @ RIGHT > 0.9, name


def test_standing_as_at_rest_is_zero_where_limbs_are_straight(person: Body, anatomy: anatomical.Anatomy):
    at_rest = bent(person, anatomy, {})
    for name in ("pelvis_tilt", "thorax_tilt", "pelvis_obliquity", "trunk_flexion", "head_rotation"):
        assert abs(at_rest[name]) < 1e-9
    for side in SIDES:
        assert abs(at_rest[f"{side}_elbow_flexion"]) < 1e-6
        assert abs(at_rest[f"{side}_knee_flexion"]) < 6  # hip, knee and ankle of the person lie not quite on a line
        assert 40 < at_rest[f"{side}_shoulder_elevation"] < 45  # the arms of the rest posture
        assert at_rest[f"{side}_hip_adduction"] < 0  # legs slightly apart


def test_the_arm_hanging_in_the_anatomical_position_is_zero(anatomy: anatomical.Anatomy):
    upright = np.stack([FORWARD, UP, RIGHT], -1)
    names = [f"{side}_{s}" for side in SIDES for s in ("upperarm", "forearm", "hand")]
    angles = placed(anatomy, {name: upright for name in names})
    for side in SIDES:
        zero = ("shoulder_elevation", "shoulder_flexion", "shoulder_adduction", "shoulder_rotation")
        for name in (*zero, "elbow_flexion", "forearm_pronation", "wrist_flexion", "wrist_ulnar_deviation"):
            assert abs(angles[f"{side}_{name}"]) < 1e-9, name


@pytest.mark.parametrize("side", SIDES)
def test_the_elevated_arm_has_the_published_planes(anatomy: anatomical.Anatomy, side: str):
    outwards = RIGHT if side == "right" else -RIGHT
    for direction, plane, flexion, adduction in (
        (outwards, 0.0, None, -90.0),
        (FORWARD, 90.0, 90.0, 0.0),
        (np.cos(1.0) * outwards + np.sin(1.0) * FORWARD, np.degrees(1.0), None, None),
    ):
        y = -(direction * np.sin(1.2) - UP * np.cos(1.2))
        z = np.cross(FORWARD, y) if abs(y @ FORWARD) < 0.9 else RIGHT
        arm = anatomical._from_y_and_z(y, z)
        angles = placed(anatomy, {f"{side}_upperarm": arm})
        assert angles[f"{side}_shoulder_plane"] == pytest.approx(plane, abs=1e-9)
        assert angles[f"{side}_shoulder_elevation"] == pytest.approx(np.degrees(1.2))
        if flexion is not None:
            assert angles[f"{side}_shoulder_flexion"] == pytest.approx(np.degrees(1.2))
        if adduction == -90.0:
            assert angles[f"{side}_shoulder_adduction"] == pytest.approx(-np.degrees(1.2))


@pytest.mark.parametrize(
    ("coordinate", "angle", "sign"),
    [
        ("hip_flexion", "hip_flexion", 1), ("hip_abduction", "hip_adduction", -1), ("knee_flexion", "knee_flexion", 1),
        ("ankle_dorsiflexion", "ankle_dorsiflexion", 1), ("toe_extension", "toe_extension", 1),
        ("elbow_flexion", "elbow_flexion", 1), ("wrist_flexion", "wrist_flexion", 1),
        ("clavicle_elevation", "clavicle_elevation", 1), ("clavicle_protraction", "clavicle_protraction", 1),
    ],
)  # fmt: skip
def test_a_coordinate_and_the_angle_of_its_name_turn_the_same_way_on_both_sides(
    person: Body, anatomy: anatomical.Anatomy, coordinate: str, angle: str, sign: int
):
    before = bent(person, anatomy, {})
    for side in SIDES:
        change = bent(person, anatomy, {f"{side}_{coordinate}": 10})[f"{side}_{angle}"] - before[f"{side}_{angle}"]
        assert change * sign == pytest.approx(10, abs=0.6), side


def test_angles_that_the_skeleton_holds_still_are_known(person: Body):
    names = anatomical.anatomy_of(person.skeleton, person.joint_centres).angle_names
    free = anatomical.turned_angles(person.skeleton, person.joint_centres)
    held = {name for name, kept in zip(names, free, strict=True) if not kept}
    assert held == {f"{side}_{name}" for side in SIDES for name in ("elbow_adduction", "ankle_rotation")}
    # The preset of the upper body has one coordinate of the back, and none of the head and the legs.
    upper = preset_body(person, PRESETS["upper"])
    free = anatomical.turned_angles(upper.skeleton, upper.joint_centres)
    turned = {name for name, kept in zip(names, free, strict=True) if kept}
    assert {"pelvis_tilt", "trunk_flexion", "left_elbow_flexion"} <= turned
    assert not {"trunk_rotation", "head_flexion", "left_knee_flexion", "right_hip_flexion"} & turned


def test_signs_that_no_coordinate_shows_follow_the_table(anatomy: anatomical.Anatomy):
    def turned(segment: str, axis: np.ndarray) -> dict[str, float]:
        frame = anatomy.frames[anatomy.segment_names.index(segment)]
        return placed(anatomy, {segment: rotations.about(axis, np.array(0.1)) @ frame})

    rest = placed(anatomy, {})
    for side, medial in (("right", 1.0), ("left", -1.0)):
        inwards = medial * UP  # turning the right thigh to the left is a positive turn about up
        for segment, angle in (
            ("thigh", "hip_rotation"), ("shank", "knee_rotation"), ("upperarm", "shoulder_rotation"),
            ("forearm", "forearm_pronation"), ("foot", "ankle_rotation"),
        ):  # fmt: skip
            assert turned(f"{side}_{segment}", inwards)[f"{side}_{angle}"] > rest[f"{side}_{angle}"], (side, angle)
        tilt = medial * FORWARD
        for segment, angle in (("foot", "ankle_inversion"), ("shank", "knee_adduction")):
            assert turned(f"{side}_{segment}", tilt)[f"{side}_{angle}"] > rest[f"{side}_{angle}"], (side, angle)
    assert turned("pelvis", -RIGHT)["pelvis_tilt"] > 0  # leaning forward
    assert turned("thorax", -RIGHT)["trunk_flexion"] > 0
    assert turned("thorax", FORWARD)["trunk_bending"] > 0  # to the right
    assert turned("thorax", UP)["trunk_rotation"] > 0  # to the left
    assert turned("head", UP)["head_rotation"] > 0


def test_the_mirrored_pose_has_the_same_angles_with_sides_exchanged(person: Body, anatomy: anatomical.Anatomy, rng):
    q = performer.coordinates(person, 6, rng)
    q[:, 3:5] = 0
    other = np.array(q)
    other[:, 6:] = q[:, 6:][:, person.skeleton.mirrored()[1]]
    trunk = [i for i, n in enumerate(person.skeleton.coordinate_names) if n.endswith(("_bending", "_rotation"))]
    trunk = [i for i in trunk if not person.skeleton.coordinate_names[i].startswith(("left", "right"))]
    other[:, trunk] *= -1
    angles = [
        anatomical.anatomical_angles(anatomy, np.stack([performer.pose(person, row).segment_rotation for row in each]))
        for each in (q, other)
    ]
    for k, name in enumerate(anatomy.angle_names):
        if name.startswith("left_"):
            mirrored = anatomy.angle_names.index("right_" + name[5:])
            np.testing.assert_allclose(angles[0][:, k], angles[1][:, mirrored], atol=1e-9, err_msg=name)


@pytest.mark.parametrize("sequence", ["ZXY", "YXZ", "XYZ", "YXY", "ZXZ"])
def test_euler_angles_rebuild_the_rotation(sequence: str, rng):
    rotation = rotations.exp(rng.normal(0, 1.5, (200, 3)))
    angles = anatomical.euler_angles(rotation, sequence)
    unit = [np.eye(3)["XYZ".index(axis)] for axis in sequence]
    rebuilt = rotations.about(unit[0], angles[:, 0])
    for i in (1, 2):
        rebuilt = rebuilt @ rotations.about(unit[i], angles[:, i])
    np.testing.assert_allclose(rebuilt, rotation, atol=1e-12)


def turns_by_difference(rotations_of, q, step=1e-5):
    """The derivative (S, 3, D) of each segment's small rotation by each coordinate (D,), by central differences."""
    columns = []
    for d in range(len(q)):
        change = np.zeros_like(q)
        change[d] = step
        after, before = rotations_of(q + change), rotations_of(q - change)
        columns.append(rotations.log(after @ np.swapaxes(before, -1, -2)) / (2 * step))
    return np.stack(columns, -1)


def test_the_turns_of_steps_agree_with_differences_of_the_pose(person: Body, rng):
    q = performer.coordinates(person, 2, rng)
    posed = [performer.pose(person, row) for row in q]
    exact = anatomical.turns_of_steps(person.skeleton, np.stack([p.world_axes for p in posed]))
    for f, p in enumerate(posed):
        by_step = turns_by_difference(lambda d, p=p: p.moved(d).segment_rotation, np.zeros(len(person.skeleton)))
        np.testing.assert_allclose(exact[f], by_step, atol=1e-8)


def test_standard_deviations_match_the_spread_of_sampled_poses(person: Body, anatomy: anatomical.Anatomy, rng):
    q = performer.coordinates(person, 1, rng)[0]
    posed = performer.pose(person, q)
    root = rng.normal(0, 1, (len(q), len(q)))
    covariance = 1e-6 * (root @ root.T / len(q) + np.eye(len(q)))
    turns = anatomical.turns_of_steps(person.skeleton, posed.world_axes[None])
    angles, sd = anatomical.angles_with_sd(anatomy, posed.segment_rotation[None], turns, covariance[None])
    count = 4000
    steps = rng.multivariate_normal(np.zeros(len(q)), covariance, count)
    sampled = np.stack([posed.moved(step).segment_rotation for step in steps])
    spread = (anatomical.anatomical_angles(anatomy, sampled) - angles).std(0)
    near_singular = sd[0] > 0.1
    assert near_singular.mean() < 0.1
    # A sample's standard deviation is good to 1 / sqrt(2 n) of it: 5 times that for 60 angles, and 2 % of curvature.
    rtol = 5 / np.sqrt(2 * count) + 0.02
    np.testing.assert_allclose(spread[~near_singular], sd[0][~near_singular], rtol=rtol, atol=1e-12)


def test_a_singular_sequence_has_an_unbounded_deviation(anatomy: anatomical.Anatomy):
    hanging = np.stack([FORWARD, UP, RIGHT], -1)
    turn = np.tile(np.eye(3), (1, len(anatomy.segment_names), 1, 1))
    k = anatomy.segment_names.index("right_upperarm")
    turn[0, k] = hanging @ anatomy.frames[k].T
    wrt = np.zeros((1, len(anatomy.segment_names), 3, 3))
    wrt[0, k] = np.eye(3)
    _, sd = anatomical.angles_with_sd(anatomy, turn, wrt, 1e-4 * np.eye(3)[None])
    at = anatomy.angle_names.index
    assert sd[0, at("right_shoulder_plane")] == pytest.approx(np.pi)
    assert sd[0, at("right_shoulder_flexion")] == pytest.approx(0.01, rel=1e-6)


def test_frames_without_an_estimate_have_none(anatomy: anatomical.Anatomy):
    turn = np.tile(np.eye(3), (3, len(anatomy.segment_names), 1, 1))
    turn[1] = np.nan
    wrt = np.zeros((3, len(anatomy.segment_names), 3, 6))
    covariance = np.tile(np.eye(6), (3, 1, 1))
    covariance[1] = np.nan
    angles, sd = anatomical.angles_with_sd(anatomy, turn, wrt, covariance)
    assert np.isnan(angles[1]).all()
    assert np.isnan(sd[1]).all()
    assert np.isfinite(angles[[0, 2]]).all()


def test_a_turn_on_the_spot_is_continuous(anatomy: anatomical.Anatomy):
    heading = np.linspace(0, 4 * np.pi, 60)
    turn = np.repeat(rotations.about(UP, heading)[:, None], len(anatomy.segment_names), 1)
    turn[30] = np.nan
    rotation = anatomical.anatomical_angles(anatomy, turn)[:, anatomy.angle_names.index("pelvis_rotation")]
    np.testing.assert_allclose(np.delete(rotation - rotation[0], 30), np.delete(heading, 30), atol=1e-9)


def test_a_limb_without_its_end_is_rejected():
    with pytest.raises(MareyError, match="left_shank"):
        anatomical.anatomy(("pelvis", "left_thigh"), np.zeros((2, 3)))


def test_the_page_lists_every_angle_and_no_other(anatomy: anatomical.Anatomy):
    page = (Path(__file__).parents[2] / "docs" / "explanation" / "angles.md").read_text()
    listed = re.findall(r"^\| `([a-z_]+)` \|", page, re.MULTILINE)
    assert len(listed) == len(set(listed))
    assert set(listed) == {re.sub("^(left|right)_", "", name) for name in anatomy.angle_names}
