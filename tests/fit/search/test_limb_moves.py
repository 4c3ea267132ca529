"""Other postures of a limb: what a swing and a move along rays keep, and what is carried from other frames."""

import numpy as np
import pytest
from tests import worlds

from marey.body.articulation.pose import PosedBody
from marey.body.people.person import person_body
from marey.fit.search.limb_moves import bent, carried, limb_chains, moved_in_depth, swung
from marey.geometry import rotations


@pytest.fixture(scope="module")
def posed():
    body = worlds.scan()
    return PosedBody(body, worlds.pose(body, yaw=0.4, at=(0.1, -0.2, 0.0)))


@pytest.mark.parametrize("limb", ["left arm", "right arm", "left leg", "right leg"])
@pytest.mark.parametrize("degrees", [-120.0, 60.0, 180.0])
def test_a_swing_keeps_both_ends_and_the_lengths(posed, limb, degrees):
    chain = next(c for c in limb_chains(posed.body.skeleton) if c.name == limb)
    other = PosedBody(posed.body, swung(posed, chain, np.deg2rad(degrees)))
    upper, lower, end = chain.segments
    before, after = posed.segment_origin, other.segment_origin
    np.testing.assert_allclose(after[[upper, end]], before[[upper, end]], atol=1e-9)
    line = rotations.about((before[end] - before[upper]) / np.linalg.norm(before[end] - before[upper]),
                           np.deg2rad(degrees))  # fmt: skip
    # The elbow or knee lies on the circle about the line between the ends.
    np.testing.assert_allclose(after[lower], before[upper] + line @ (before[lower] - before[upper]), atol=1e-9)
    assert bent(other, chain) == pytest.approx(bent(posed, chain))
    others = np.setdiff1d(np.arange(len(before)), np.flatnonzero(posed.body.skeleton.above()[:, upper]))
    np.testing.assert_array_equal(after[others], before[others])


def test_a_swing_prefers_the_angles_within_the_limits(posed):
    skeleton = posed.body.skeleton
    for chain in limb_chains(skeleton):
        same = swung(posed, chain, 0.0)
        np.testing.assert_allclose(same.angles, posed.pose.angles, atol=1e-9)


@pytest.mark.parametrize("limb", ["left arm", "right arm", "left leg", "right leg"])
def test_a_limb_that_moves_in_depth_stays_on_the_rays_of_the_camera(posed, limb):
    chain = next(c for c in limb_chains(posed.body.skeleton) if c.name == limb)
    upper, lower, end = chain.segments
    eye, before = np.array([3.0, -3.0, 1.5]), posed.segment_origin
    moved = moved_in_depth(posed, chain, eye)
    assert 1 <= len(moved) <= 3
    for pose in moved:
        after = PosedBody(posed.body, pose).segment_origin
        np.testing.assert_allclose(after[upper], before[upper], atol=1e-9)
        for first, second in ((upper, lower), (lower, end)):
            length = np.linalg.norm(after[second] - after[first])
            assert length == pytest.approx(np.linalg.norm(before[second] - before[first]))
            old, new = before[second] - eye, after[second] - eye
            np.testing.assert_allclose(np.cross(old, new), 0, atol=1e-5)
        assert max(np.linalg.norm(after[joint] - before[joint]) for joint in (lower, end)) > 0.01


def test_a_limb_that_moves_in_depth_twice_comes_back(posed):
    chain = limb_chains(posed.body.skeleton)[1]
    eye, before = np.array([3.0, -3.0, 1.5]), posed.segment_origin
    again = [
        np.abs(PosedBody(posed.body, back).segment_origin - before).max()
        for pose in moved_in_depth(posed, chain, eye)
        for back in moved_in_depth(PosedBody(posed.body, pose), chain, eye)
    ]
    assert min(again) < 1e-6


def test_a_straight_limb_is_not_bent():
    body = worlds.scan()
    straight = PosedBody(body, worlds.pose(body, {}))
    half = PosedBody(body, worlds.pose(body, {"left_elbow_flexion": 90}))
    arm = limb_chains(body.skeleton)[0]
    assert arm.name == "left arm"
    assert bent(straight, arm) < 0.03
    # The elbow of a right angle is as far away as the height of the triangle of both segments.
    assert 0.1 < bent(half, arm) < 0.25


def test_the_limbs_of_a_preset_are_those_that_it_follows():
    names = {preset: [c.name for c in limb_chains(person_body("coarse", preset=preset).skeleton)] for preset in
             ("full", "upper", "left_arm", "right_leg")}  # fmt: skip
    assert names["full"] == ["left arm", "right arm", "left leg", "right leg"]
    assert names["upper"] == ["left arm", "right arm"]
    assert names["left_arm"] == ["left arm"]
    assert names["right_leg"] == ["right leg"]


def test_only_the_limb_is_carried(posed):
    body = posed.body
    other = worlds.pose(body, {"left_elbow_flexion": 100, "right_elbow_flexion": 80})
    arm = limb_chains(body.skeleton)[0]
    found = carried(posed.pose, other, arm.coordinates)
    np.testing.assert_array_equal(found.angles[arm.coordinates], other.angles[arm.coordinates])
    rest = np.setdiff1d(np.arange(len(found.angles)), arm.coordinates)
    np.testing.assert_array_equal(found.angles[rest], posed.pose.angles[rest])
