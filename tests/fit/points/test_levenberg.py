"""Sizes and motion of an arm are found again from points on one side of it."""

from dataclasses import replace

import numpy as np
import pytest
from tests.fit import metaball_worlds as world

from marey.body.articulation.pose import PosedBody
from marey.body.metaballs.metaball_person import required_metaballs
from marey.body.metaballs.metaballs import PosedMetaballs
from marey.fit.points.levenberg import LevenbergSettings, fit_points
from marey.fit.points.surface_points import PersonPoints

NOISE = 0.0005
ARM = ("upperarm_length", "upperarm_width", "forearm_length", "forearm_width")


@pytest.fixture(scope="module")
def scene():
    rng = np.random.default_rng(11)
    space = world.arm_space()
    truth = np.zeros(len(space))
    truth[[space.names.index(name) for name in ARM]] = 0.06, -0.05, -0.05, 0.07
    body = world.person(space, truth)
    poses = world.arm_poses(rng, 3)
    # As from cameras in front: what looks away from them is not measured.
    points = {f: world.measured(body, p, 1500, NOISE, rng, side=np.array([0, -1.0, 0])) for f, p in enumerate(poses)}
    start = {
        f: p.step(np.append(rng.normal(size=3) * 0.01, rng.normal(size=len(p.angles) + 3) * 0.05))
        for f, p in enumerate(poses)
    }
    return space, truth, body, poses, points, start


def fitted(scene, order, iterations):
    space, _, _, _, points, start = scene
    given = PersonPoints(by_frame=points, model_sd_m=2e-4, patch_m=1e-4, scale_m=0.05)
    generic = world.person(space, np.zeros(len(space)))
    return fit_points(given, generic, start, settings=LevenbergSettings(order=order, iterations=iterations, stop=1e-6))


@pytest.mark.slow
def test_an_arm_is_recovered_from_one_side_of_it(scene):
    space, truth, body, poses, _, _ = scene
    fit = fitted(scene, "together", 50)
    index = [space.names.index(name) for name in ARM]
    sds = np.sqrt(np.diag(fit.covariance))[index]
    # The three frames show some twenty patches of the arm, each of which counts once.
    assert np.all(sds < 0.006)
    assert np.all(np.abs(fit.body.numbers - truth)[index] < 2.5 * sds)
    elbow = body.skeleton.segment("right_forearm")
    for f, pose in fit.poses.items():
        away = PosedBody(fit.body, pose).segment_origin[elbow] - PosedBody(body, poses[f]).segment_origin[elbow]
        assert np.linalg.norm(away) < 0.004
    # Squares of 4500 residuals in standard deviations.
    assert 0.5 * 4500 < fit.cost < 1.5 * 4500
    assert fit.stopped


@pytest.mark.slow
def test_sizes_and_skeleton_in_turn_converge_more_slowly(scene):
    """Unlike the paper, which found turns to converge better; docs/accuracy.md has the figures."""
    assert fitted(scene, "together", 20).cost < fitted(scene, "in turn", 20).cost


def test_without_points_the_prior_is_returned(scene):
    space, _, _, _, _, start = scene
    generic = world.person(space, 0.05 * np.ones(len(space)))
    fit = fit_points(PersonPoints(by_frame={}), generic, start)
    np.testing.assert_allclose(fit.body.numbers, 0.0, atol=1e-3)
    np.testing.assert_allclose(fit.covariance, space.prior_covariance, atol=1e-6)


@pytest.mark.slow
def test_deviations_of_the_skin_that_the_residuals_show_widen_the_covariance(scene):
    """Patches of the skin are 3 mm off, ten times the stated standard deviation."""
    space, _, body, poses, points, _ = scene
    rng = np.random.default_rng(5)
    waves, phases = rng.normal(size=(3, 60)) / 0.035, rng.uniform(0, 2 * np.pi, 60)
    rough = {}
    for f, pose in enumerate(poses):
        own = points[f]
        _, outward = PosedMetaballs(required_metaballs(body).balls(body.numbers), pose).nearest_limbs(own.points)
        bump = 0.003 * np.sqrt(2 / 60) * np.cos((own.points - pose.translation) @ waves + phases).sum(1)
        rough[f] = replace(own, points=own.points + outward * bump[:, None])
    widths = [space.names.index(name) for name in ARM if name.endswith("_width")]
    sds = [
        np.sqrt(np.diag(fit_points(PersonPoints(by_frame=p, model_sd_m=3e-4), body, dict(enumerate(poses))).covariance))
        for p in (points, rough)
    ]  # fmt: skip
    assert np.all(sds[1][widths] > 3.0 * sds[0][widths])
    assert np.all(sds[1] <= np.sqrt(np.diag(space.prior_covariance)) + 1e-9)


@pytest.mark.slow
def test_a_step_to_balls_without_size_is_rejected(scene):
    """A body far from the points would shrink until a ball has no size; such a step counts as one that is too long."""
    space, _, _, _, points, start = scene
    index = [space.names.index(name) for name in ARM if name.endswith("_width")]
    wide = np.zeros(len(space))
    wide[index] = -20.0
    assert not space.is_possible(wide)
    with pytest.raises(ValueError, match="positive"):
        space.balls(wide)
    loose = replace(space, prior_covariance=1e4 * space.prior_covariance)
    small = {f: replace(own, points=own.points.mean(0) + 0.02 * (own.points - own.points.mean(0)))
             for f, own in points.items()}  # fmt: skip
    fit = fit_points(
        PersonPoints(by_frame=small, model_sd_m=1e-3, scale_m=np.inf), world.person(loose, np.zeros(len(space))), start,
        settings=LevenbergSettings(iterations=6),
    )  # fmt: skip
    assert loose.is_possible(fit.body.numbers)
    assert np.all(np.diff(fit.costs) < 0.0)
