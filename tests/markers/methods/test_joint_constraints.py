import numpy as np
import pytest
from tests.skin_clusters import leg_bones

from marey.geometry import rotations
from marey.markers.methods.joint_constraints import (
    Bed,
    KnownJoint,
    angles_wrt_turns,
    better_centres,
    first_centres,
    is_anatomical,
    joint_rows,
    laxity,
)
from marey.motion.anatomical import euler_angles

STEP = 1e-6


def leg(rng, frames=12, spread=0.05):
    """Two beds off the true bones by nothing, and the knee between them, known in frames 0 and 6."""
    bones = leg_bones(rng, frames)
    prior = np.broadcast_to(np.eye(6) * spread**2, (frames, 6, 6))
    centres = (np.array([0.02, 0.2, -0.01]), np.array([0.0, -0.2, 0.03]))
    beds = [
        Bed(rotation=r, origin=o, centre=centre, prior=prior)
        for (r, o), centre in zip(bones.values(), centres, strict=True)
    ]
    known = np.array([0, 6])
    flexion = euler_angles(np.swapaxes(beds[0].rotation, 1, 2) @ beds[1].rotation, "ZXY")[:, 0]
    joint = KnownJoint(
        parent=0, child=1, laxity=laxity("thigh", "shank"), frames=known, turn=flexion, time=np.arange(frames) / 10,
        parent_pose=(beds[0].rotation[known], beds[0].origin[known]),
        child_pose=(beds[1].rotation[known], beds[1].origin[known]), anatomical=True,
    )  # fmt: skip
    return beds, joint


def test_the_angles_change_as_their_derivative_says(rng):
    relative = rotations.exp(rng.normal(0, 0.4, (7, 3)))
    wrt = angles_wrt_turns(relative, euler_angles(relative, "ZXY"))
    for axis in range(6):
        turn = rotations.exp(STEP * np.eye(3)[axis % 3])
        moved = [turn.T @ relative, turn @ relative] if axis < 3 else [relative @ turn, relative @ turn.T]
        difference = (euler_angles(moved[0], "ZXY") - euler_angles(moved[1], "ZXY")) / (2 * STEP)
        np.testing.assert_allclose(wrt[..., axis], difference, atol=1e-8)


def test_the_rows_change_as_their_derivative_says(rng):
    beds, joint = leg(rng)
    centres = (rng.normal(0, 0.1, 3), rng.normal(0, 0.1, 3))
    steps = np.zeros((12, 2, 6))
    rows = joint_rows(joint, beds, steps, centres)
    for axis in range(12):
        ends = []
        for sign in (1, -1):
            there = steps.copy()
            there[:, axis // 6, axis % 6] += sign * STEP
            ends.append(joint_rows(joint, beds, there, centres).residual)
        np.testing.assert_allclose(rows.wrt[..., axis], (ends[1] - ends[0]) / (2 * STEP), atol=1e-8)


def test_a_true_hinge_leaves_nothing_to_settle_and_known_postures_hold_it_exactly(rng):
    beds, joint = leg(rng)
    rows = joint_rows(joint, beds, np.zeros((12, 2, 6)), (np.zeros(3), np.zeros(3)))
    np.testing.assert_allclose(rows.residual, 0, atol=1e-12)
    np.testing.assert_allclose(rows.sd[joint.frames], 0, atol=1e-7)
    assert rows.sd[3].min() > 1e-3


def test_a_frame_without_one_of_the_bones_says_nothing(rng):
    beds, joint = leg(rng)
    rotation = np.array(beds[1].rotation)
    rotation[4] = np.nan
    beds[1] = Bed(rotation=rotation, origin=beds[1].origin, centre=beds[1].centre, prior=beds[1].prior)
    rows = joint_rows(joint, beds, np.zeros((12, 2, 6)), (np.zeros(3), np.zeros(3)))
    assert not rows.wrt[4].any()
    assert not rows.residual[4].any()
    assert np.isfinite(rows.residual).all()


def test_the_centre_of_the_joint_is_found_where_it_is(rng):
    beds, joint = leg(rng, frames=60, spread=1e-3)
    guess = first_centres(joint, beds)
    centres = guess
    for _ in range(3):
        centres = better_centres(joint, beds, np.zeros((60, 2, 6)), centres, guess[0])
    # Along the hinge's axis nothing tells where it is.
    for centre in centres:
        assert np.abs(centre[:2]).max() < 2e-3


def test_a_joint_that_turns_about_another_axis_is_not_taken_for_a_knee(rng):
    angle = np.linspace(0, 1, 20)
    assert is_anatomical(rotations.about(np.array([0.0, 0.0, 1.0]), angle))
    assert not is_anatomical(rotations.about(np.array([1.0, 0.0, 0.0]), angle))
    assert is_anatomical(rotations.about(np.array([1.0, 0.0, 0.0]), 0.1 * angle))
    assert is_anatomical(np.full((3, 3, 3), np.nan))


@pytest.mark.parametrize("name", ["adduction", "rotation"])
def test_a_knee_whose_axes_are_not_anatomical_keeps_its_angles_free(rng, name):
    beds, joint = leg(rng)
    free = KnownJoint(**{**joint.__dict__, "anatomical": False})
    there = np.zeros((12, 2, 6)), (np.zeros(3), np.zeros(3))
    assert getattr(joint.laxity, name) is not None
    assert joint_rows(free, beds, *there).residual.shape[1] == 3
    assert joint_rows(joint, beds, *there).residual.shape[1] == 5
