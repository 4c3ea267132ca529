"""Initial postures: rotations, their angles, and joint limits."""

import numpy as np
import pytest
from tests import worlds

from marey.body.articulation.pose import Pose, PosedBody
from marey.body.people.person import person_body
from marey.fit.search import placements
from marey.fit.search.search import limb_directions
from marey.geometry import rotations


@pytest.fixture
def body():
    return worlds.person()


def handed_axes(rng, hand):
    axes = rotations.exp(rng.normal(size=3))
    return axes * np.array([1.0, 1.0, hand])[:, None]


@pytest.mark.parametrize("hand", [1.0, -1.0], ids=["right-handed", "left-handed"])
def test_ball_angles_reproduce_the_rotation(rng, hand):
    axes = handed_axes(rng, hand)
    wanted = rotations.exp(rng.normal(size=(50, 3)))
    angles = placements.ball_angles(axes, wanted)
    turns = [rotations.about(axes[i], angles[:, i]) for i in range(3)]
    np.testing.assert_allclose(turns[0] @ turns[1] @ turns[2], wanted, atol=1e-12)


@pytest.mark.parametrize("hand", [1.0, -1.0])
def test_ball_angles_are_those_that_made_the_rotation(rng, hand):
    axes = handed_axes(rng, hand)
    angles = rng.uniform(-1.4, 1.4, (50, 3)) * [2, 1, 2]
    turns = [rotations.about(axes[i], angles[:, i]) for i in range(3)]
    np.testing.assert_allclose(placements.ball_angles(axes, turns[0] @ turns[1] @ turns[2]), angles, atol=1e-12)


def test_every_ball_joint_of_the_body_has_axes_at_right_angles(body):
    for name in placements.SEARCHED_LIMBS:
        axes = body.skeleton.axes[placements.limb_of(body.skeleton, name).ball]
        np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)


def test_directions_are_unit_and_cover_the_sphere(rng):
    found = placements.directions(60)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0)
    anywhere = rng.normal(size=(500, 3))
    anywhere /= np.linalg.norm(anywhere, axis=1, keepdims=True)
    # Sixty caps that cover the sphere have a radius of 15 degrees at least; a lattice needs no more than twice that.
    assert (anywhere @ found.T).max(1).min() > np.cos(np.deg2rad(30))


def test_the_shortest_turn_carries_one_direction_to_the_other_about_their_normal(rng):
    start, *ends = rng.normal(size=(12, 3)) / np.linalg.norm(rng.normal(size=(12, 3)), axis=1, keepdims=True)
    start = start / np.linalg.norm(start)
    ends = np.array(ends) / np.linalg.norm(ends, axis=1, keepdims=True)
    turn = placements.shortest_turn(start, ends)
    np.testing.assert_allclose(turn @ start, ends, atol=1e-12)
    angle = np.linalg.norm(rotations.log(turn), axis=1)
    np.testing.assert_allclose(np.cos(angle), ends @ start, atol=1e-12)


def test_the_shortest_turn_to_itself_is_none_and_to_its_opposite_a_half():
    start = np.array([0.0, 0.6, 0.8])
    none, half = placements.shortest_turn(start, np.array([start, -start]))
    np.testing.assert_allclose(none, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(half @ start, -start, atol=1e-9)
    np.testing.assert_allclose(half @ half.T, np.eye(3), atol=1e-12)


def test_limbs_have_their_own_coordinates_only(body):
    limbs = placements.limbs_of(body.skeleton)
    assert set(limbs) == set(placements.SEARCHED_LIMBS)
    for limb in limbs.values():
        own = {body.skeleton.coordinates[i].segment for i in limb.columns}
        assert own == set(limb.segments)
        assert len(set(limb.columns)) == len(limb.columns)
    names = [body.skeleton.coordinates[i].name for i in limbs["right_leg"].columns[:4]]
    assert names == ["right_hip_flexion", "right_hip_abduction", "right_hip_rotation", "right_knee_flexion"]


def test_a_preset_has_the_limbs_that_it_follows():
    assert set(placements.limbs_of(person_body("coarse", preset="upper").skeleton)) == {"left_arm", "right_arm"}


@pytest.mark.parametrize("name", placements.SEARCHED_LIMBS)
def test_placements_respect_the_limits_and_their_direction(body, name):
    skeleton, limb = body.skeleton, placements.limb_of(body.skeleton, name)
    arm, leg = limb_directions(body)
    side = np.array([1.0 if name.startswith("left") else -1.0, 1.0, 1.0])
    rest = (arm if "arm" in name else leg) * side
    angles = placements.limb_placements(skeleton, limb, rest, count=50)
    limits = skeleton.limits[limb.columns]
    assert (angles >= limits[:, 0]).all()
    assert (angles <= limits[:, 1]).all()
    # The direction of a placement is one of those requested; a rotation about the limb's own axis does not change it.
    for row in angles[:: max(1, len(angles) // 20)]:
        turn = np.eye(3)
        for axis, angle in zip(skeleton.axes[limb.ball], row[:3], strict=True):
            turn = turn @ rotations.about(axis, angle)
        assert (placements.directions(50) @ (turn @ rest)).max() > 1 - 1e-9


def test_both_sides_have_mirrored_placements_of_whole_postures(body):
    skeleton = body.skeleton
    postures = placements.whole_postures(skeleton, *limb_directions(body))
    assert postures.shape == (80, len(skeleton) - 6)
    _, mirrored = skeleton.mirrored()
    # The postures hold, with every pair of arms and legs, the same pair on the other sides.
    for posture in postures:
        assert np.abs(postures - posture[mirrored]).max(1).min() < 1e-9


def test_the_first_posture_is_upright_with_hanging_arms(body):
    posture = placements.whole_postures(body.skeleton, *limb_directions(body))[0]
    posed = PosedBody(body, Pose(np.zeros(3), np.eye(3), posture))
    at = dict(zip(body.skeleton.segment_names, posed.segment_origin, strict=True))
    for side in ("left", "right"):
        assert at[f"{side}_hand"][2] < at[f"{side}_upperarm"][2] - 0.4
        assert at[f"{side}_foot"][2] < at[f"{side}_thigh"][2] - 0.7
