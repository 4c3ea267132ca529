"""Priors: zero at usual values, and weighted by their share elsewhere."""

from dataclasses import replace

import numpy as np
import pytest
from tests import worlds

from marey.body.articulation.pose import Pose, PosedBody
from marey.observations.prior import Habit, JointLimits, NearPose, ShapePrior


@pytest.fixture
def posed():
    body = worlds.person()
    return PosedBody(body, Pose(np.zeros(3), np.eye(3), np.array(body.skeleton.habit[0])))


def cost(observation, posed):
    return float(np.sum(observation.whiten(posed).residual ** 2))


def test_a_usual_pose_of_a_mean_body_costs_nothing(posed):
    spread = np.ones(len(posed.body.skeleton))
    for prior in (JointLimits(), Habit(), ShapePrior(), NearPose(pose=posed.pose, spread=spread)):
        assert cost(prior, posed) == 0.0


@pytest.mark.parametrize("degrees", [2.0, 10.0])
def test_a_knee_bent_backwards_costs_by_its_overshoot(posed, degrees):
    knee = worlds.column(posed.body.skeleton, "left_knee_flexion")
    low = posed.body.skeleton.limits[knee, 0]
    angles = np.array(posed.pose.angles)
    angles[knee] = low - np.deg2rad(degrees)
    bent = replace(posed, pose=Pose(np.zeros(3), np.eye(3), angles))
    assert cost(JointLimits(), bent) == pytest.approx((degrees / 3.0) ** 2)


def test_a_share_weighs_a_prior_like_that_many_observations(posed):
    moved = posed.moved(np.full(len(posed.body.skeleton) + len(posed.body.space), 0.3))
    for prior in (Habit, ShapePrior):
        assert cost(prior(share=0.25), moved) == pytest.approx(0.25 * cost(prior(), moved))


def test_one_standard_deviation_costs_one(posed):
    skeleton = posed.body.skeleton
    angles = skeleton.habit[0] + skeleton.habit[1] * (np.arange(len(skeleton) - 6) == 5)
    assert cost(Habit(), replace(posed, pose=Pose(np.zeros(3), np.eye(3), angles))) == pytest.approx(1.0)
    numbers = np.array(posed.body.numbers)
    numbers[0] += np.sqrt(posed.body.space.prior_covariance[0, 0])
    assert cost(ShapePrior(), replace(posed, body=posed.body.with_numbers(numbers))) == pytest.approx(1.0)


def test_an_infinite_standard_deviation_leaves_a_coordinate_free(posed):
    spread = np.full(len(posed.body.skeleton), 0.1)
    spread[:3] = np.inf
    near = NearPose(pose=posed.pose, spread=spread)
    change = np.zeros(len(spread))
    change[:3] = 100.0
    assert cost(near, posed.moved(change)) == 0.0
    change[3:6] = [0.0, 0.2, 0.0]
    assert cost(near, posed.moved(change)) == pytest.approx(4.0)


def test_the_shape_prior_of_a_scan_is_empty(posed):
    scanned = PosedBody(worlds.scan(), posed.pose)
    for shape in (False, True):
        model = ShapePrior().linearize(scanned, shape=shape)
        assert model.residual.shape == (0,)
        assert model.jacobian.shape == (0, len(posed.body.skeleton))
