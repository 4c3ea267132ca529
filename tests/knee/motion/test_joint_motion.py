import numpy as np
import pytest
from tests.made_animations import flexed
from tests.made_joints import made_joint

from marey.errors import MareyError
from marey.geometry import rotations
from marey.knee.motion.joint_motion import (
    JointMotion,
    joint_proximities,
    joint_sides,
    knee_angles,
    motion_of_chains,
    packed_joints,
    unpacked_joints,
)
from marey.markers.kinematics.transform_chain import (
    CAPTURE_ANATOMIC,
    CAPTURE_BONE,
    CAPTURE_DEFORMED,
    CAPTURE_GLOBAL,
    MR_ANATOMIC,
    MR_GLOBAL,
    NamedTransform,
    TransformChain,
    identity,
)

FRAMES = 5
ANATOMIC_FROM_LPS = np.array([[0.0, -1, 0], [0, 0, 1], [-1, 0, 0]])
SPREAD = np.diag([0.01] * 3 + [0.5] * 3) ** 2


def chain(rotation: np.ndarray, translation: np.ndarray) -> TransformChain:
    """The axes of the scanner are those of the bone; only the last step changes over time."""
    return TransformChain(
        mr_anatomic_from_mr_global=NamedTransform(
            to=MR_ANATOMIC, from_=MR_GLOBAL, rotation=ANATOMIC_FROM_LPS, translation=np.zeros(3)
        ),
        capture_anatomic_from_mr_anatomic=NamedTransform(
            to=CAPTURE_ANATOMIC, from_=MR_ANATOMIC, rotation=ANATOMIC_FROM_LPS.T, translation=np.zeros(3),
            covariance=SPREAD,
        ),
        deformed_from_capture_anatomic=identity(CAPTURE_DEFORMED, CAPTURE_ANATOMIC),
        bone_from_deformed=identity(CAPTURE_BONE, CAPTURE_DEFORMED),
        capture_global_from_bone=NamedTransform(
            to=CAPTURE_GLOBAL, from_=CAPTURE_BONE, rotation=rotation, translation=translation
        ),
    )  # fmt: skip


@pytest.fixture
def motion(rng) -> JointMotion:
    """A right knee that flexes by 15 degrees per frame while the shank moves through the room."""
    turn, place = rotations.exp(rng.normal(size=(FRAMES, 3))), rng.normal(0, 500, (FRAMES, 3))
    bends = [flexed(15.0 * f) for f in range(FRAMES)]
    femur = np.stack([turn[f] @ bends[f].rotation for f in range(FRAMES)])
    at = np.stack([turn[f] @ bends[f].translation + place[f] for f in range(FRAMES)])
    femur[2], at[2] = np.nan, np.nan
    return motion_of_chains(
        {"femur": chain(femur, at), "tibia": chain(turn, place)}, np.arange(FRAMES) / 10, left=False
    )  # fmt: skip


def test_with_the_tibia_fixed_the_femur_moves_as_the_knee(motion):
    held = motion.held("femur")
    for frame in (0, 1, 3, 4):
        np.testing.assert_allclose(held.rotation[frame], flexed(15.0 * frame).rotation, atol=1e-9)
        np.testing.assert_allclose(held.translation[frame], flexed(15.0 * frame).translation, atol=1e-6)
    np.testing.assert_array_equal(motion.answered("femur"), [True, True, False, True, True])
    np.testing.assert_allclose(motion.held("tibia").matrix(), np.broadcast_to(np.eye(4), (FRAMES, 4, 4)), atol=1e-6)


def test_flexion_is_read_in_the_bones_own_frames(motion):
    angles = knee_angles(motion)
    assert angles is not None
    assert angles.angle_names == ("right_knee_flexion", "right_knee_adduction", "right_knee_rotation")
    np.testing.assert_allclose(np.degrees(angles.angles[:, 0]), [0, 15, np.nan, 45, 60], atol=1e-6)
    np.testing.assert_allclose(np.degrees(angles.angles[[0, 1, 3, 4], 1:]), 0, atol=1e-6)
    # Both bones turn by 0.01 about the axis, independently.
    np.testing.assert_allclose(angles.angles_sd[1, 0], np.sqrt(2) * 0.01, rtol=1e-3)


def test_both_legs_bend_by_the_same_sign(motion):
    other = JointMotion(time=motion.time, left=True, poses=motion.poses, anatomical=motion.anatomical)
    angles = knee_angles(other)
    assert angles is not None
    np.testing.assert_allclose(np.degrees(angles.angles[[0, 1, 3, 4], 0]), [0, 15, 45, 60], atol=1e-6)


def test_the_gap_stays_where_the_condyles_turn_about_their_middles(motion):
    parts = made_joint(fine=3)
    sides, notes = joint_sides(parts, ["femur", "tibia", "patella"], left=False)
    assert notes == ()
    shares = []
    joints = joint_proximities(motion, sides, done=shares.append)
    # The patella does not move: its joint is left out.
    assert [joint.name for joint in joints] == ["tibiofemoral"]
    gap = joints[0].gap_mm
    assert np.isnan(gap[2]).all()
    np.testing.assert_allclose(gap[[0, 1, 3, 4]], 1.0, atol=0.12)
    assert (joints[0].gap_sd_mm[[0, 1, 3, 4]] > 0.5).all()
    assert shares[-1] == pytest.approx(1.0)


def test_a_patella_that_was_measured_has_its_own_joint(motion):
    both = JointMotion(
        time=motion.time, left=False, poses={**motion.poses, "patella": motion.poses["femur"]},
        anatomical=motion.anatomical,
    )  # fmt: skip
    sides, _ = joint_sides(made_joint(fine=3), ["femur", "tibia", "patella"], left=False)
    joints = joint_proximities(both, sides)
    assert [joint.name for joint in joints] == ["tibiofemoral", "patellofemoral"]
    # It moves with the femur here: its distance stays what it was in the scanner.
    gap = joints[1].gap_mm
    np.testing.assert_allclose(gap[[1, 3, 4]], np.broadcast_to(gap[0], (3, 2)), atol=1e-6)
    assert (gap[0] > 0).all()


def test_packed_joints_are_restored_unchanged(motion):
    sides, _ = joint_sides(made_joint(fine=2), ["femur", "tibia"], left=False)
    joints = joint_proximities(motion, sides, limit_mm=4.0)
    again = unpacked_joints(packed_joints(joints), sides)
    assert again[0].compartments == joints[0].compartments
    assert again[0].limit_mm == 4.0
    for key, value in vars(joints[0]).items():
        if isinstance(value, np.ndarray):
            np.testing.assert_array_equal(getattr(again[0], key), value)


def test_a_bone_without_cartilage_is_used_itself():
    parts = made_joint(fine=2)
    del parts["femoral_cartilage"]
    sides, notes = joint_sides(parts, ["femur", "tibia"], left=None)
    assert len(sides["femur"].surface.faces) == len(parts["femur"].faces)
    assert "femur has no cartilage" in notes[0]


def test_a_bone_that_was_not_measured_has_no_place(motion):
    with pytest.raises(MareyError, match="patella was not measured"):
        motion.held("patella")
    alone = JointMotion(
        time=motion.time, left=None, poses={"femur": motion.poses["femur"]},
        anatomical={"femur": motion.anatomical["femur"]},
    )  # fmt: skip
    assert knee_angles(alone) is None
    with pytest.raises(MareyError, match="another number of frames"):
        JointMotion(time=motion.time[:2], left=None, poses=motion.poses, anatomical=motion.anatomical)
