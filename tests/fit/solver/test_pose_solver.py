"""The pose of one frame: recovered truth within what the stated uncertainty allows, and the steps on the way."""

from dataclasses import replace

import numpy as np
import pytest
from tests import worlds

from marey.body.articulation.pose import PosedBody
from marey.body.people.person import person_body
from marey.fit.search.levels import SilhouetteLevel
from marey.fit.solver.moments import gather_moments
from marey.fit.solver.pose_solver import (
    LONGEST_STEP_RAD,
    Schedule,
    add_dense,
    fit_pose,
    match_all,
    solve_pose,
    solve_pose_step_by_step,
    solve_step,
)
from marey.observations.correspondence import OutlineMatchSettings
from marey.observations.prior import Habit, JointLimits, NearPose

SCHEDULE = Schedule(iterations=10)
PRIORS = (JointLimits(), Habit(share=0.01))


@pytest.fixture(scope="module")
def scene():
    """Silhouettes drawn at twice the size and shrunk, as another program would have made them."""
    body = worlds.person("fine")
    truth = PosedBody(body, worlds.pose(body))
    cameras = worlds.ring(size=(400, 480), focal=600.0)
    return truth, SilhouetteLevel.of(cameras, worlds.silhouettes(truth, cameras), 0.5)


def joint_sd(posed, hessian):
    """Standard deviation of each joint centre (J,) [m] by the stated information matrix."""
    jacobian = posed.pose_jacobian(*posed.joint_parts(posed.body.joint_segments))
    covariance = np.linalg.inv(hessian)
    return np.sqrt(np.einsum("jad,de,jae->j", jacobian, covariance, jacobian))


@pytest.mark.parametrize("seed", range(4))
def test_the_pose_is_found_again_within_its_stated_uncertainty(scene, seed):
    truth, level = scene
    rng = np.random.default_rng(seed)
    away = np.concatenate([rng.normal(size=3) * 0.03, rng.normal(size=len(truth.body.skeleton) - 3) * np.deg2rad(4)])
    start = replace(truth, pose=truth.pose.step(away))
    # Far starts need their time: limbs slide along themselves slowly.
    fit = fit_pose(start, level.sightings, PRIORS, schedule=Schedule(iterations=30))
    errors, sd = worlds.joint_errors(fit.posed, truth), joint_sd(fit.posed, fit.hessian)
    assert worlds.joint_errors(start, truth).mean() > 0.03
    # Of distances of three components with root mean square sd, 0.1 % exceed three times sd.
    assert (errors < 3 * sd).all()
    assert errors.mean() < 0.006
    assert fit.matches > 1000
    assert np.linalg.eigvalsh(fit.hessian)[0] > 0


def test_another_level_of_the_body_fits_the_same_silhouettes(scene):
    truth, level = scene
    coarse = worlds.person("coarse")
    start = PosedBody(coarse, truth.pose.step(np.full(len(coarse.skeleton), 0.02)))
    fit = fit_pose(start, level.sightings, PRIORS, schedule=SCHEDULE)
    # The coarse skin lies up to some millimetres inside the fine one.
    assert worlds.joint_errors(fit.posed, PosedBody(coarse, truth.pose)).mean() < 0.008


def test_noisy_contours_are_fitted_within_the_stated_uncertainty(scene):
    """The stated 3.2 px of a match stand for outlines that err by a tenth of it, alike over some ten pixels."""
    truth, level = scene
    share = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        masks = [worlds.rough(mask, rng, spread=0.35) for mask in level.masks]
        noisy = SilhouetteLevel.at_size(level.cameras, masks)
        fit = fit_pose(truth, noisy.sightings, PRIORS, schedule=SCHEDULE)
        share.append(worlds.joint_errors(fit.posed, truth) / joint_sd(fit.posed, fit.hessian))
    assert 0.2 < np.sqrt(np.mean(np.square(share))) < 1.0
    assert np.max(share) < 3


def test_one_camera_fewer_still_gives_the_pose(scene):
    truth, level = scene
    start = replace(truth, pose=truth.pose.step(np.full(len(truth.body.skeleton), 0.02)))
    fit = fit_pose(start, level.sightings[:3], PRIORS, schedule=SCHEDULE)
    errors, sd = worlds.joint_errors(fit.posed, truth), joint_sd(fit.posed, fit.hessian)
    assert (errors < 3 * sd).all()
    whole = fit_pose(start, level.sightings, PRIORS, schedule=SCHEDULE)
    assert np.trace(np.linalg.inv(fit.hessian)) > np.trace(np.linalg.inv(whole.hessian))


def test_a_person_cut_by_the_border_is_fitted_by_what_shows():
    body = worlds.person("fine")
    truth = PosedBody(body, worlds.pose(body))
    cameras = worlds.ring(size=(200, 150), target=(0, 0, 0.25))
    masks = worlds.silhouettes(truth, cameras)
    assert all(mask[-1].any() for mask in masks)
    start = replace(truth, pose=truth.pose.step(np.full(len(body.skeleton), 0.02)))
    near = NearPose(pose=start.pose, spread=np.full(len(body.skeleton), 0.3))
    fit = fit_pose(start, SilhouetteLevel.at_size(cameras, masks).sightings, (*PRIORS, near), schedule=SCHEDULE)
    errors, sd = worlds.joint_errors(fit.posed, truth), joint_sd(fit.posed, fit.hessian)
    assert (errors < 3 * sd).all()
    shown = [i for i, name in enumerate(body.joint_names) if name.endswith(("shoulder", "elbow", "wrist", "neck"))]
    assert errors[shown].max() < 0.02


def test_the_upper_preset_fits_the_arms_of_a_person_without_legs():
    whole = worlds.person("fine")
    truth = PosedBody(
        whole, worlds.pose(whole, {k: v for k, v in worlds.ARMS_AND_KNEES.items() if "thoracic" not in k})
    )
    body = person_body("fine", preset="upper")
    cameras = worlds.ring(size=(200, 135), target=(0, 0, 0.32))
    start = worlds.pose(body, {k: v for k, v in worlds.ARMS_AND_KNEES.items() if "shoulder" in k or "elbow" in k})
    away = np.full(len(body.skeleton), 0.03)
    level = SilhouetteLevel.at_size(cameras, worlds.silhouettes(truth, cameras))
    fit = fit_pose(PosedBody(body, start.step(away)), level.sightings, PRIORS, schedule=SCHEDULE)
    errors = worlds.joint_errors(fit.posed, truth)
    arms = [i for i, name in enumerate(body.joint_names) if name.endswith(("shoulder", "elbow", "wrist"))]
    assert errors[arms].max() < 0.02


def test_without_silhouettes_the_priors_decide(scene):
    truth, level = scene
    empty_level = SilhouetteLevel.at_size(level.cameras, [np.zeros_like(mask) for mask in level.masks])
    near = NearPose(pose=truth.pose, spread=np.full(len(truth.body.skeleton), 0.1))
    start = replace(truth, pose=truth.pose.step(np.full(len(truth.body.skeleton), 0.02)))
    fit = fit_pose(start, empty_level.sightings, (near,), schedule=SCHEDULE)
    assert fit.matches == 0
    np.testing.assert_allclose(truth.pose.change_to(fit.posed.pose), 0, atol=1e-8)


def test_a_solved_pose_is_a_stationary_point_of_its_cost(scene):
    truth, level = scene
    start = replace(truth, pose=truth.pose.step(np.full(len(truth.body.skeleton), 0.01)))
    found, weights = match_all(start, level.sightings, OutlineMatchSettings(), 5.0)
    moments = gather_moments(start, found, weights)
    near = NearPose(pose=start.pose, spread=np.full(len(truth.body.skeleton), 0.5))
    posed, _ = solve_pose(start, moments, (near,), steps=30, stop=1e-12)

    def cost(p):
        white = near.whiten(p).residual
        rows = zip(weights, found, strict=True)
        return sum(float(w @ (m.residuals(p)[:, 0] / m.sigma) ** 2) for w, m in rows) + float(white @ white)

    least = cost(posed)
    rng = np.random.default_rng(0)
    for _ in range(5):
        step = rng.normal(size=len(truth.body.skeleton)) * 1e-4
        ahead, behind = (cost(replace(posed, pose=posed.pose.step(s * step))) for s in (1, -1))
        assert min(ahead, behind) > least
        assert abs(ahead - behind) < 0.01 * (ahead + behind - 2 * least)


def test_a_step_solves_the_system_and_no_joint_turns_too_far(rng):
    root = rng.normal(size=(9, 9))
    hessian, gradient = root @ root.T + np.eye(9), rng.normal(size=9) * 0.01
    np.testing.assert_allclose(hessian @ solve_step(hessian, gradient), -gradient, atol=1e-8)
    long = solve_step(hessian, gradient * 1e4)
    assert np.abs(long[3:]).max() == pytest.approx(LONGEST_STEP_RAD)
    whole = np.linalg.solve(hessian, -gradient)
    np.testing.assert_allclose(long / np.linalg.norm(long), whole / np.linalg.norm(whole), atol=1e-6)
    # Shape numbers behind the pose's degrees may go as far as they like.
    np.testing.assert_allclose(hessian @ solve_step(hessian, hessian[:, 8] * 5.0, degrees=8), -5 * hessian[:, 8])


def test_dense_observations_add_their_squares(rng):
    body = worlds.person()
    posed = PosedBody(body, worlds.pose(body).step(rng.normal(size=len(body.skeleton)) * 0.5))
    size = len(body.skeleton)
    hessian, gradient = np.zeros((size, size)), np.zeros(size)
    cost = add_dense(posed, PRIORS, hessian, gradient)
    rows = [prior.whiten(posed) for prior in PRIORS]
    stacked, residual = np.concatenate([r.jacobian for r in rows]), np.concatenate([r.residual for r in rows])
    np.testing.assert_allclose(hessian, stacked.T @ stacked)
    np.testing.assert_allclose(gradient, stacked.T @ residual)
    assert cost == pytest.approx(residual @ residual)


def test_the_schedule_narrows_from_its_first_to_its_last_value():
    schedule = Schedule(iterations=5, gate=(16.0, 4.0), scale=(9.0, 1.0))
    gates = [schedule.at(i)[0].gate for i in range(5)]
    np.testing.assert_allclose(gates, 16.0 * 0.25 ** (np.arange(5) / 4))
    assert schedule.at(4)[1] == pytest.approx(1.0)
    assert Schedule(iterations=1).at(0)[0].gate == 25.0


@pytest.mark.parametrize("count", range(4))
def test_the_kernel_does_what_the_steps_one_by_one_do(scene, count):
    truth, level = scene
    degrees = len(truth.body.skeleton)
    start = replace(truth, pose=truth.pose.step(np.full(degrees, 0.05)))
    found, weights = match_all(start, level.sightings, OutlineMatchSettings(), 5.0)
    moments = gather_moments(start, found, weights)
    # One angle begins beyond its limit.
    angles = start.pose.angles.copy()
    angles[10] = truth.body.skeleton.limits[10, 1] + 0.1
    start = replace(start, pose=replace(start.pose, angles=angles))
    near = NearPose(pose=truth.pose.step(np.full(degrees, -0.03)), spread=np.linspace(0.05, 0.5, degrees))
    others = (near, JointLimits(), Habit(share=0.1))[:count]
    quick, information = solve_pose(start, moments, others, steps=3)
    plain, expected = solve_pose_step_by_step(start, moments, others, steps=3, stop=1e-5)
    np.testing.assert_allclose(information, expected, atol=1e-9 * np.abs(expected).max())
    # Without a prior some coordinates are hardly fixed: rounding shows there.
    np.testing.assert_allclose(plain.pose.change_to(quick.pose), 0, atol=1e-9 if count else 1e-5)
    # The kernel handles one prior of usual angles; the weights of two add up.
    twice, _ = solve_pose(start, moments, (near, Habit(share=0.1), Habit(share=0.1)))
    once, _ = solve_pose(start, moments, (near, Habit(share=0.2)))
    np.testing.assert_allclose(once.pose.change_to(twice.pose), 0, atol=1e-9)


def test_an_undetermined_coordinate_is_an_error(scene):
    truth, _ = scene
    with pytest.raises(np.linalg.LinAlgError, match="prior"):
        solve_pose(truth, gather_moments(truth, []), ())
