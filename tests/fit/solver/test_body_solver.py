"""Pose and shape of one frame together."""

from dataclasses import replace

import numpy as np
import pytest
from tests import worlds

from marey.body.articulation.pose import PosedBody
from marey.fit.search.levels import SilhouetteLevel
from marey.fit.solver.body_solver import bounded_body_step, bounded_step, dense_equations, fit_body, shape_reach
from marey.fit.solver.moments import gather_moments
from marey.fit.solver.normal_equations import normal_equations
from marey.fit.solver.pose_solver import Schedule, add_dense, match_all
from marey.observations.correspondence import OutlineMatchSettings
from marey.observations.prior import Habit, JointLimits, ShapePrior

PRIORS = (JointLimits(), Habit(share=0.01), ShapePrior())
SCHEDULE = Schedule(iterations=12)


@pytest.fixture(scope="module")
def scene():
    person = worlds.person("fine", 5).with_numbers(np.array([1.0, -1.2, 0.7, 0.4, -0.5]))
    truth = PosedBody(person, worlds.pose(person))
    cameras = worlds.ring(size=(400, 480), focal=600.0)
    return truth, SilhouetteLevel.of(cameras, worlds.silhouettes(truth, cameras), 0.5)


def test_the_poses_part_of_the_dense_equations_is_that_of_the_moments(scene, rng):
    truth, level = scene
    posed = replace(truth, pose=truth.pose.step(rng.normal(size=len(truth.body.skeleton)) * 0.02))
    found, weights = match_all(posed, level.sightings, OutlineMatchSettings(), 5.0)
    others = PRIORS[:2]
    dense, slope, _ = dense_equations(posed, found, weights, others)
    hessian, gradient, cost = normal_equations(posed, gather_moments(posed, found, weights))
    cost += add_dense(posed, others, hessian, gradient)
    degrees = len(truth.body.skeleton)
    np.testing.assert_allclose(dense[:degrees, :degrees], hessian, atol=1e-9 * np.abs(hessian).max())
    np.testing.assert_allclose(slope[:degrees], gradient, atol=1e-9 * np.abs(gradient).max())
    np.testing.assert_allclose(dense, dense.T, atol=1e-9 * np.abs(dense).max())
    assert dense_equations(posed, found, weights, others)[2] == pytest.approx(cost, rel=1e-6)


def test_the_gradient_is_half_the_slope_of_the_cost(scene, rng):
    truth, level = scene
    posed = truth.moved(rng.normal(size=len(truth.body.skeleton) + len(truth.body.space)) * 0.01)
    found, weights = match_all(posed, level.sightings, OutlineMatchSettings(), 5.0)
    _, gradient, _ = dense_equations(posed, found, weights, PRIORS)
    for column in rng.permutation(len(gradient))[:15]:
        change = np.zeros(len(gradient))
        change[column] = 1e-5
        ahead, behind = (dense_equations(posed.moved(s * change), found, weights, PRIORS)[2] for s in (1, -1))
        assert (ahead - behind) / 4e-5 == pytest.approx(gradient[column], rel=1e-4, abs=1e-3)


def test_shape_and_pose_are_found_from_one_frame(scene):
    truth, level = scene
    mean = truth.body.with_numbers(np.zeros(5))
    rng = np.random.default_rng(1)
    start = PosedBody(mean, truth.pose.step(rng.normal(size=len(mean.skeleton)) * 0.03))
    fitted = fit_body(start, level.sightings, PRIORS, schedule=SCHEDULE)
    found, weights = match_all(fitted, level.sightings, OutlineMatchSettings(gate=5.0), 3.0)
    hessian, _, _ = dense_equations(fitted, found, weights, PRIORS)
    sd = np.sqrt(np.diag(np.linalg.inv(hessian))[-5:])
    assert (np.abs(fitted.body.numbers - truth.body.numbers) < 3 * sd).all()
    assert (sd < 1.0).all()
    assert worlds.joint_errors(fitted, truth).mean() < 0.012
    skin = np.linalg.norm(fitted.vertices - truth.vertices, axis=1)
    assert np.sqrt(np.mean(skin**2)) < 0.015


def test_without_silhouettes_the_shape_equals_its_prior(scene):
    truth, level = scene
    empty_level = SilhouetteLevel.at_size(level.cameras, [np.zeros_like(mask) for mask in level.masks])
    priors = (Habit(), ShapePrior())
    # Where nothing is known of the place, the step there is none.
    fitted = fit_body(truth, empty_level.sightings, priors, schedule=Schedule(iterations=8))
    np.testing.assert_allclose(fitted.body.numbers, truth.body.space.prior_mean, atol=1e-6)
    np.testing.assert_allclose(fitted.pose.translation, truth.pose.translation, atol=1e-9)
    np.testing.assert_allclose(fitted.pose.angles, truth.body.skeleton.habit[0], atol=1e-6)


def test_no_number_leaves_its_bounds(scene):
    truth, level = scene
    start = truth.body.with_numbers(np.zeros(5))
    fitted = fit_body(PosedBody(start, truth.pose), level.sightings, PRIORS, schedule=SCHEDULE, clip=0.5)
    assert np.abs(fitted.body.numbers).max() == pytest.approx(0.5)


def test_a_bounded_step_is_the_lowest_point_within_the_bounds(rng):
    square = rng.normal(size=(12, 6))
    information, gradient = square.T @ square, 5.0 * rng.normal(size=6)
    least, greatest = -rng.uniform(0.0, 0.5, 6), rng.uniform(0.0, 0.5, 6)
    step = bounded_step(information, gradient, least, greatest)
    assert np.all((step >= least - 1e-6) & (step <= greatest + 1e-6))
    slope = gradient + information @ step
    inside = (step > least + 1e-6) & (step < greatest - 1e-6)
    np.testing.assert_allclose(slope[inside], 0.0, atol=1e-6)
    assert np.all(slope[step <= least + 1e-6] >= -1e-6)
    assert np.all(slope[step >= greatest - 1e-6] <= 1e-6)


def test_without_bounds_in_reach_the_step_is_that_of_all_unknowns(rng):
    square = rng.normal(size=(40, 16))
    hessian, gradient = square.T @ square, 0.1 * rng.normal(size=16)
    wide = (np.full(6, -1e3), np.full(6, 1e3))
    np.testing.assert_allclose(
        bounded_body_step(hessian, gradient, 10, wide), -np.linalg.solve(hessian, gradient), atol=1e-6
    )


def test_the_pose_suits_the_shape_that_is_allowed(rng):
    square = rng.normal(size=(40, 16))
    hessian, gradient = square.T @ square, 0.1 * rng.normal(size=16)
    free = -np.linalg.solve(hessian, gradient)
    held = 0.2 * np.abs(free[10:])
    step = bounded_body_step(hessian, gradient, 10, (-held, held))
    np.testing.assert_allclose((gradient + hessian @ step)[:10], 0.0, atol=1e-6)
    assert np.all(np.abs(step[10:]) <= held + 1e-6)


def test_the_reach_ends_at_the_clip(scene):
    body = scene[0].body
    least, greatest = shape_reach(body, 2.0)
    spread = 2.0 * np.sqrt(np.diag(body.space.prior_covariance))
    np.testing.assert_allclose(body.numbers + least, body.space.prior_mean - spread)
    np.testing.assert_allclose(body.numbers + greatest, body.space.prior_mean + spread)
    far = body.with_numbers(body.space.prior_mean + 2.0 * spread)
    assert np.all(shape_reach(far, 2.0)[1] == 0.0)
