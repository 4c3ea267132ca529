"""Steps of the search: exchanges, proposals of limbs, and fits."""

from dataclasses import replace

import numpy as np
import pytest
from tests import worlds

from marey.body.articulation.pose import Pose, PosedBody
from marey.body.people.person import person_body
from marey.fit.search import placements
from marey.fit.search import search as steps
from marey.fit.search.levels import SilhouetteLevel
from marey.fit.search.search import Search, StartSettings, exchanged, pose_from_rotations, turned_about
from marey.geometry import rotations

GATE = (16.0, 5.0)


@pytest.fixture(scope="module")
def scene():
    cameras, body = worlds.ring(size=(100, 120), focal=150.0), worlds.person()
    truth = PosedBody(body, worlds.pose(body))
    return truth, Search(SilhouetteLevel.at_size(cameras, worlds.silhouettes(truth, cameras)), StartSettings())


def within_limits(rng, body, share=0.8):
    low, high = body.skeleton.limits.T
    return rng.uniform(share * low, share * high)


@pytest.mark.parametrize("kind", ["arm", "leg"])
def test_limbs_exchanged_twice_are_as_before(rng, kind):
    body = worlds.person()
    posed = PosedBody(body, Pose(np.zeros(3), np.eye(3), within_limits(rng, body)))
    once = exchanged(posed, kind)
    np.testing.assert_array_equal(exchanged(once, kind).pose.angles, posed.pose.angles)
    own = {"arm": ("upperarm", "forearm", "hand"), "leg": ("thigh", "shank", "foot", "toes")}[kind]
    for name, before, after in zip(
        [c.name for c in body.skeleton.coordinates], posed.pose.angles, once.pose.angles, strict=True
    ):
        coordinate = body.skeleton.coordinates[worlds.column(body.skeleton, name)]
        if coordinate.segment.endswith(own) and "clavicle" not in name:
            side, rest = name.split("_", 1)
            other = f"{'right' if side == 'left' else 'left'}_{rest}"
            assert after == posed.pose.angles[worlds.column(body.skeleton, other)]
        else:
            assert after == before


def test_a_pose_is_read_back_from_the_rotations_of_its_segments(rng):
    """Exact where a segment turns by one or by three coordinates; two at once are small in every habit."""
    body = worlds.person()
    for _ in range(5):
        angles = within_limits(rng, body)
        segment = body.skeleton.coordinate_segment
        pairs = np.bincount(segment)[segment] == 2
        angles[pairs] = 0.0
        pose = Pose(rng.normal(size=3), rotations.exp(rng.normal(size=3)), angles)
        read = pose_from_rotations(body, pose.translation, PosedBody(body, pose).segment_rotation)
        wanted, found = (PosedBody(body, p).segment_rotation for p in (pose, read))
        # A shoulder beyond a quarter turn of its second axis has two sets of angles; one may leave the limits.
        plain = np.abs(angles[[i for i, c in enumerate(body.skeleton.coordinates) if c.name.endswith("lift")]])
        if plain.max() < np.pi / 2:
            np.testing.assert_allclose(found, wanted, atol=1e-9)


def test_a_reversed_pose_faces_the_other_way_with_the_same_outline():
    body = worlds.person()
    posed = PosedBody(body, worlds.pose(body, {"left_shoulder_lift": 40, "right_hip_abduction": 20}, yaw=0.4))
    turned = PosedBody(body, turned_about(posed))
    np.testing.assert_allclose(turned.pose.rotation[:, 1], -posed.pose.rotation[:, 1], atol=1e-12)
    at = {name: k for k, name in enumerate(body.skeleton.segment_names)}
    for left, right in (("left_forearm", "right_forearm"), ("left_shank", "right_shank")):
        # Each joint takes the place of its counterpart, but for what differs between front and back.
        assert np.linalg.norm(turned.segment_origin[at[left]] - posed.segment_origin[at[right]]) < 0.08
        assert np.linalg.norm(turned.segment_origin[at[right]] - posed.segment_origin[at[left]]) < 0.08


def test_reversing_a_pose_twice_restores_it(rng):
    body = worlds.person()
    skeleton = body.skeleton
    segment = skeleton.coordinate_segment
    free = (np.bincount(segment)[segment] == 3) & (np.abs(skeleton.limits).min(1) > np.deg2rad(10))
    # What bends one way only, and what turns about two axes, has no counterpart behind itself.
    angles = np.where(free, rng.uniform(-0.15, 0.15, len(free)), 0.0)
    posed = PosedBody(body, Pose(rng.normal(size=3), rotations.exp(rng.normal(size=3)), angles))
    again = turned_about(replace(posed, pose=turned_about(posed)))
    np.testing.assert_allclose(posed.pose.change_to(again), 0, atol=1e-9)


def test_a_seen_limb_is_proposed_near_where_it_is(scene):
    truth, search = scene
    lost = truth.pose.step(np.zeros(len(truth.body.skeleton)))
    angles = np.array(lost.angles)
    angles[worlds.column(truth.body.skeleton, "left_shoulder_lift")] = np.deg2rad(-30)
    wrong = replace(truth, pose=Pose(lost.translation, lost.rotation, angles))
    hand = truth.body.skeleton.segment("left_hand")
    away = np.linalg.norm(wrong.segment_origin[hand] - truth.segment_origin[hand])
    found = search.limb_proposals(wrong, "left_arm")
    near = min(np.linalg.norm(p.segment_origin[hand] - truth.segment_origin[hand]) for p in found)
    assert len(found) == 2
    assert near < 0.5 * away
    assert near < 0.2
    # Only that limb is moved.
    others = np.delete(found[0].pose.angles, placements.limb_of(truth.body.skeleton, "left_arm").columns)
    np.testing.assert_array_equal(
        others, np.delete(wrong.pose.angles, placements.limb_of(truth.body.skeleton, "left_arm").columns)
    )


def test_lost_limbs_are_found_by_the_search_and_what_is_right_stays(scene):
    truth, search = scene
    angles = np.array(truth.pose.angles)
    angles[worlds.column(truth.body.skeleton, "left_shoulder_lift")] = np.deg2rad(-30)
    angles[worlds.column(truth.body.skeleton, "left_elbow_flexion")] = 0.0
    wrong = search.judge(replace(truth, pose=Pose(truth.pose.translation, truth.pose.rotation, angles)))
    found = search.limbs(wrong, numbers=0)
    assert found.score > wrong.score
    assert worlds.joint_errors(found.posed, truth).max() < 0.08
    right = search.judge(truth)
    assert search.limbs(right, numbers=0).score >= right.score


@pytest.mark.slow
def test_two_passes_over_the_limbs_are_two_searches(scene):
    truth, search = scene
    angles = np.array(truth.pose.angles)
    angles[worlds.column(truth.body.skeleton, "left_shoulder_lift")] = np.deg2rad(-30)
    angles[worlds.column(truth.body.skeleton, "right_elbow_flexion")] = np.deg2rad(90)
    wrong = search.judge(replace(truth, pose=Pose(truth.pose.translation, truth.pose.rotation, angles)))
    expected = search.limbs(search.limbs(wrong, numbers=0), numbers=0)
    found = search.limbs(wrong, numbers=0, passes=2)
    np.testing.assert_array_equal(found.posed.pose.angles, expected.posed.pose.angles)
    assert found.score == expected.score


def test_a_fit_of_some_numbers_leaves_the_others(scene):
    truth, search = scene
    numbers = np.array([0.0, 0.0, 0.7, -0.4, 0.2, 0.1])
    start = PosedBody(truth.body.with_numbers(numbers), truth.pose)
    fitted = search.fit(start, numbers=2, iterations=6, gate=GATE)
    np.testing.assert_array_equal(fitted.posed.body.numbers[2:], numbers[2:])
    assert (fitted.posed.body.numbers[:2] != 0).all()
    assert search.fit(start, numbers=0, iterations=6, gate=GATE).posed.body is start.body
    # More numbers than there are is all of them.
    assert len(search.fit(start, numbers=99, iterations=2, gate=GATE).posed.body.numbers) == 6


def test_a_score_is_the_overlap_less_what_the_posture_costs(scene):
    truth, search = scene
    odd = replace(truth, pose=worlds.pose(truth.body, {"left_knee_flexion": -40}))
    settings = StartSettings(prior_cost=0.0)
    free = Search(search.level, settings)
    assert free.judge(truth).score == 1.0
    assert 0.95 < search.judge(truth).score < 1.0
    assert free.judge(odd).score - search.judge(odd).score > 100 * settings.prior_cost
    assert free.judge(odd).score == pytest.approx(search.score(odd.body, [odd.pose])[0])


@pytest.mark.parametrize(("lean", "ways"), [(0, 1), (20, 2), (45, 3), (85, 4)])
def test_a_leaning_person_is_searched_upright_and_along_the_hulls_axis(rng, lean, ways):
    trunk = rng.normal(size=(500, 3)) * [0.15, 0.15, 0.5]
    turn = rotations.exp(np.array([np.deg2rad(lean), 0, 0]))
    found = steps.standing_ways(trunk @ turn.T)
    assert len(found) == ways
    np.testing.assert_allclose(found[0], np.eye(3), atol=1e-12)
    if ways > 1:
        assert abs(found[1][:, 2] @ turn[:, 2]) > np.cos(np.deg2rad(5))


def test_a_body_of_one_preset_is_searched_with_the_limbs_that_it_has(scene):
    _, search = scene
    body = person_body("coarse", preset="upper")
    posed = PosedBody(body, worlds.pose(body, {}))
    found = search.limbs(search.judge(posed), numbers=0)
    assert found.score >= search.judge(posed).score
