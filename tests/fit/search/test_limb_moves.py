"""Other postures of a limb: what a swing keeps, and what is carried from other frames."""

import numpy as np
import pytest
from tests import worlds

from marey.body.articulation.pose import PosedBody
from marey.body.people.person import person_body
from marey.fit.search.limb_moves import bent, carried, limb_chains, swung
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
