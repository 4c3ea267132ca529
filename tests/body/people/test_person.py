"""The bodies that a capture starts from."""

from dataclasses import replace

import numpy as np
import pytest
from tests import worlds
from tests.people import stick_person

from marey.body.articulation.pose import Pose, PosedBody
from marey.body.people.person import family_body, measured_stature, person_body, shown_segments, stature
from marey.errors import SettingProblem
from marey.geometry import rotations


def rest(body):
    return PosedBody(body, Pose(np.zeros(3), np.eye(3), np.zeros(len(body.skeleton) - 6)))


def test_the_full_body_has_at_least_forty_degrees_of_freedom_and_the_upper_one_the_papers_21():
    assert len(person_body("coarse").skeleton) >= 40
    upper = person_body("coarse", preset="upper").skeleton
    assert len(upper) == 21
    assert sum("left" in c.name for c in upper.coordinates) == sum("right" in c.name for c in upper.coordinates) == 7


@pytest.mark.parametrize(
    ("preset", "degrees"), [("left_arm", 13), ("right_arm", 13), ("left_leg", 15), ("right_leg", 15)]
)
def test_a_limbs_preset_follows_that_limb_alone(preset, degrees):
    body = person_body("coarse", preset=preset)
    side, kind = preset.split("_")
    other = "right" if side == "left" else "left"
    assert len(body.skeleton) == 6 + (7 if kind == "arm" else 9)
    assert all(c.name.startswith(side) for c in body.skeleton.coordinates)
    shown = {body.skeleton.segment_names[k] for k in body.face_segment}
    assert f"{side}_{'hand' if kind == 'arm' else 'foot'}" in shown
    assert not any(name.startswith(other) for name in shown)
    measured = {name for name, there in zip(body.joint_names, body.followed_joints, strict=True) if there}
    assert f"{side}_{'wrist' if kind == 'arm' else 'ankle'}" in measured
    assert not measured & {f"{other}_{joint}" for joint in ("elbow", "wrist", "knee", "ankle", "toe")}


def test_where_a_limbs_skin_ends_it_has_no_outline():
    whole, limb = person_body("coarse"), person_body("coarse", preset="right_leg")
    kept = {tuple(face) for face in limb.faces}
    cut = np.unique([v for face in whole.faces if tuple(face) not in kept for v in face])
    touches = np.isin(limb.faces, cut).any(1)
    assert touches.any()
    assert not limb.outlined[touches].any()
    assert limb.outlined[~touches].all()


def test_the_full_body_is_followed_everywhere():
    assert person_body("coarse").followed_joints.all()


def test_the_error_for_an_unknown_preset_lists_the_known_ones():
    with pytest.raises(SettingProblem, match="full, upper"):
        person_body(preset="lower")


@pytest.mark.parametrize("level", ["fine", "coarse"])
def test_the_body_stands_upright_looks_along_minus_y_and_has_its_left_at_plus_x(level):
    body = family_body(level)
    at = dict(zip(body.skeleton.segment_names, body.joint_centres, strict=True))
    assert at["head"][2] > at["thorax"][2] > at["pelvis"][2] > at["left_shank"][2] > at["left_foot"][2]
    assert at["left_hand"][0] > at["left_upperarm"][0] > 0 > at["right_upperarm"][0]
    assert at["left_toes"][1] < at["left_foot"][1]
    assert 1.5 < np.ptp(body.vertices[:, 2]) < 1.95


def test_its_surface_is_closed_and_looks_outwards():
    body = family_body("coarse")
    edges = np.concatenate([body.faces[:, [a, b]] for a, b in ((0, 1), (1, 2), (2, 0))])
    forth, back = {tuple(e) for e in edges}, {tuple(e[::-1]) for e in edges}
    assert forth == back
    a, b, c = np.swapaxes(body.vertices[body.faces], 0, 1)
    volume = np.einsum("na,na->n", a, np.cross(b, c)).sum() / 6
    assert 0.04 < volume < 0.12


@pytest.mark.parametrize(
    ("name", "segment", "axis", "sign"),
    [
        ("left_elbow_flexion", "left_hand", 1, -1),
        ("right_elbow_flexion", "right_hand", 1, -1),
        ("left_knee_flexion", "left_foot", 1, 1),
        ("right_knee_flexion", "right_foot", 1, 1),
        ("left_hip_flexion", "left_foot", 1, -1),
        ("left_hip_abduction", "left_foot", 0, 1),
        ("right_hip_abduction", "right_foot", 0, -1),
        ("left_ankle_dorsiflexion", "left_toes", 2, 1),
        ("lumbar_flexion", "head", 1, -1),
        ("left_clavicle_elevation", "left_upperarm", 2, 1),
        ("left_clavicle_protraction", "left_upperarm", 1, -1),
    ],
)
def test_a_positive_rotation_has_the_direction_of_its_name(name, segment, axis, sign):
    body = family_body("coarse")
    moved = PosedBody(body, worlds.pose(body, {name: 10}))
    k = body.skeleton.segment(segment)
    change = moved.segment_origin[k] - rest(body).segment_origin[k]
    assert sign * change[axis] > 0.004
    assert sign * change[axis] > 0.5 * np.abs(change).max()


def test_left_and_right_mirror_each_other_in_every_pose(rng):
    body = family_body("coarse")
    segments, coordinates = body.skeleton.mirrored()
    angles = rng.uniform(-0.5, 0.5, len(coordinates))
    # Trunk coordinates that lean or turn to a side change their sign; the limbs' do not.
    names = [c.name for c in body.skeleton.coordinates]
    trunk = [not name.startswith(("left_", "right_")) and not name.endswith("_flexion") for name in names]
    sides = np.where(trunk, -1, 1)
    pose = Pose(np.zeros(3), rotations.exp(np.array([0.1, 0, 0])), angles)
    other = Pose(np.zeros(3), pose.rotation, (sides * angles)[coordinates])
    here, there = PosedBody(body, pose), PosedBody(body, other)
    np.testing.assert_allclose(there.segment_origin, here.segment_origin[segments] * [-1, 1, 1], atol=2e-3)


def test_a_known_stature_makes_the_body_that_tall():
    for height in (1.6, 1.9):
        body = person_body("fine", stature_m=height)
        assert np.ptp(body.vertices[:, 2]) == pytest.approx(height, abs=0.02)


def test_both_levels_are_one_body(rng):
    numbers = rng.normal(size=len(person_body("coarse").space)) * 0.5
    coarse, fine = (person_body(level).with_numbers(numbers) for level in ("coarse", "fine"))
    assert coarse.skeleton.coordinate_names == fine.skeleton.coordinate_names
    assert coarse.space.names == fine.space.names
    np.testing.assert_allclose(coarse.joint_centres, fine.joint_centres, atol=0.01)


def test_the_outline_of_what_a_preset_does_not_follow_does_not_count():
    body = person_body("coarse", preset="upper")
    names = np.array(body.skeleton.segment_names)[body.face_segment]
    legs = np.array([name.endswith(("thigh", "shank", "foot", "toes")) for name in names])
    np.testing.assert_array_equal(body.outlined, ~legs)
    assert person_body("coarse").outlined.all()


def test_the_height_reaches_from_the_lowest_to_the_highest_point(rng):
    body = stick_person(rng)
    height, sd = stature(body)
    assert height == pytest.approx(np.ptp(body.vertices[:, 2]))
    assert np.isnan(sd)


def test_its_spread_is_that_of_the_numbers(rng):
    body = stick_person(rng)
    body = replace(body, numbers_covariance=np.eye(len(body.space)) * 1e-6)
    _, sd = stature(body)
    draws = [stature(body.with_numbers(body.numbers + rng.normal(size=len(body.space)) * 1e-3))[0] for _ in range(4000)]
    # A standard deviation from n draws is good to 1 / sqrt(2 n).
    assert sd == pytest.approx(np.std(draws), rel=4 / np.sqrt(2 * 4000))


def test_a_stature_is_measured_if_the_images_show_the_whole_body_and_narrow_it():
    body = person_body("coarse")
    before = np.asarray(body.space.prior_covariance)
    seen = replace(body, numbers_covariance=0.25 * before)
    assert measured_stature(seen) == stature(seen)
    # Half of the variance is the limit: a standard deviation of 0.7 of that in people.
    assert measured_stature(replace(body, numbers_covariance=0.6 * before)) is None
    arm = replace(person_body("coarse", preset="right_arm"), numbers_covariance=0.25 * before)
    assert measured_stature(arm) is None


def test_an_arms_preset_shows_the_arm_and_the_trunk_and_not_the_head():
    body = person_body("coarse", preset="right_arm")
    shown = {name for name, seen in zip(body.skeleton.segment_names, shown_segments(body), strict=True) if seen}
    assert {"right_upperarm", "right_forearm", "right_hand", "thorax"} <= shown
    assert not {"head", "neck", "pelvis", "left_upperarm", "left_thigh"} & shown
    assert shown_segments(person_body("coarse")).all()
