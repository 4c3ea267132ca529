"""The equations of points are those of the observation, summed up."""

import numpy as np
import pytest
from tests.fit import metaball_worlds as world

from marey.body.articulation.pose import PosedBody
from marey.body.metaballs.metaball_person import single_radii
from marey.fit.points.point_equations import distances_of, point_equations
from marey.fit.solver.weights import geman_mcclure
from marey.observations.metaball_points import assign


@pytest.fixture(scope="module", params=["sizes", "single radii"])
def scene(request):
    rng = np.random.default_rng(3)
    space = world.arm_space()
    if request.param == "single radii":
        space = single_radii(space, ["forearm", "hand"])
    numbers = rng.multivariate_normal(np.zeros(len(space)), 0.1 * space.prior_covariance)
    body = world.person(space, numbers)
    pose = world.arm_poses(rng, 1)[0]
    points = world.measured(body, pose, 300, 0.004, rng)
    posed = PosedBody(body, pose)
    return posed, assign(space, posed, points.points, points.covariance, model_sd=rng.uniform(0.002, 0.004, 300))


@pytest.mark.parametrize("scale", [np.inf, 0.006])
def test_the_sum_is_that_of_the_plain_rows(scene, scale):
    posed, observed = scene
    found = point_equations(posed, observed, scale=scale)
    rows = observed.linearize(posed, shape=True)
    distance = rows.residual * observed.spread
    weight = geman_mcclure(distance, scale)
    # Balls with less than 1e-6 of the field are ignored.
    np.testing.assert_allclose(found.residual, distance, atol=1e-7)
    np.testing.assert_allclose(found.weight, weight, atol=1e-4)
    hessian = rows.jacobian.T @ (weight[:, None] * rows.jacobian)
    np.testing.assert_allclose(found.hessian, hessian, atol=1e-4 * np.abs(hessian).max())
    gradient = rows.jacobian.T @ (weight * rows.residual)
    np.testing.assert_allclose(found.gradient, gradient, atol=1e-4 * np.abs(gradient).max())


def test_the_papers_residual_is_the_field_less_the_threshold(scene):
    posed, observed = scene
    found = point_equations(posed, observed, as_distance=False)
    surface = observed.surface(posed)
    np.testing.assert_allclose(found.residual, surface.field(observed.points, observed.limb) - 0.5, atol=1e-5)
    of = surface.potentials(observed.points, observed.limb)
    rows = np.concatenate([surface.by_pose(observed.points, of), observed.space.by_numbers(surface, of)], 1)
    rows /= observed.spread[:, None]
    hessian = rows.T @ rows
    np.testing.assert_allclose(found.hessian, hessian, atol=1e-4 * np.abs(hessian).max())


def test_distances_agree_with_the_residuals(scene):
    posed, observed = scene
    np.testing.assert_allclose(distances_of(posed, observed), point_equations(posed, observed).residual, atol=1e-7)


def test_points_are_assigned_to_the_nearest_limb(scene):
    posed, observed = scene
    names = posed.body.skeleton.segment_names
    hand = posed.segment_origin[names.index("right_hand")]
    near = np.linalg.norm(observed.points - hand, axis=1) < 0.08
    assert near.any()
    np.testing.assert_array_equal(observed.limb[near], posed.body.skeleton.segment_limb[names.index("right_hand")])


def test_a_point_without_a_standard_deviation_is_rejected(scene):
    posed, observed = scene
    with pytest.raises(ValueError, match="standard deviation"):
        assign(observed.space, posed, observed.points, np.zeros((300, 3, 3)), model_sd=np.zeros(300))
