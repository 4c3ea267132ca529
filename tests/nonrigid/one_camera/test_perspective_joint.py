"""Joint equations of motion and shapes: symmetry, agreement with differences, lower costs, and random draws."""

from copy import copy

import numpy as np
import pytest

from marey.geometry import rotations
from marey.nonrigid.one_camera.perspective_joint import _random_priors, joint_equations, posterior_draws, refine_jointly
from marey.nonrigid.one_camera.perspective_model import (
    MOTION,
    frame_equations,
    initial_model,
    refine,
    residuals_and_jacobians,
)
from marey.nonrigid.one_camera.shape_equations import in_rows, in_shapes

FRAMES, POINTS, MODES = 14, 9, 2
SEEN = np.ones((FRAMES, POINTS))
TIME = np.arange(FRAMES) / FRAMES


@pytest.fixture
def made(rng):
    """A model of a body that deforms, and tracks that it explains exactly."""
    weights = 0.1 * np.sin(6 * np.outer(TIME, [1, 1.7]))
    shapes = rng.normal(size=(3, POINTS)) + np.einsum("fm,mip->fip", weights, rng.normal(size=(2, 3, POINTS)))
    rotation = rotations.exp(np.outer(np.sin(5 * TIME), [0.3, 0.8, 0.1]))
    shift = np.stack([0.3 * TIME, 0.1 * TIME, 6 + np.sin(4 * TIME)], 1)
    points = rotation @ shapes + shift[:, :, None]
    pairs = np.array([[0, 1], [1, 2], [3, 5]])
    return initial_model(rotation, shift, shapes, MODES, 0.01, pairs), points[:, :2] / points[:, 2:]


def test_the_matrix_is_symmetric_and_the_solution_satisfies_the_equations(made, rng):
    equations = joint_equations(*made, SEEN)
    sizes = (FRAMES, MOTION + MODES), (POINTS, 3 + 3 * MODES)
    (x, y), (u, v) = ([rng.normal(size=size) for size in sizes] for _ in range(2))
    one, other = equations.times(x, y), equations.times(u, v)
    np.testing.assert_allclose((one[0] * u).sum() + (one[1] * v).sum(), (other[0] * x).sum() + (other[1] * y).sum())
    found = equations.times(*equations.solve(*one, 2000))
    for side, wanted in zip(found, one, strict=True):
        assert np.linalg.norm(side - wanted) < 1e-2 * np.linalg.norm(wanted)


def test_changes_of_the_shapes_couple_to_the_frames(made, rng):
    model, tracks = made
    model.pairs, model.distance = model.pairs[:0], model.distance[:0]
    model.distance_variance = model.distance_variance[:0]
    equations = joint_equations(model, tracks, SEEN)
    step = 1e-6 * rng.normal(size=(1 + MODES, 3, POINTS))
    moved = copy(model)
    moved.mean, moved.modes = model.mean + step[0], model.modes + step[1:]
    change = residuals_and_jacobians(moved, tracks, SEEN)[0] / model.variance
    jacobian = residuals_and_jacobians(model, tracks, SEEN)[1]
    wanted = -np.einsum("fkpd,fkp->fd", jacobian, change)
    np.testing.assert_allclose(equations.times(np.zeros_like(wanted), in_rows(step))[0], wanted, atol=1e-5)
    np.testing.assert_array_equal(in_shapes(in_rows(step)), step)


def test_joint_rounds_lower_the_cost_more_than_alternating_ones(made, rng):
    model, tracks = made
    noisy = tracks + 1e-3 * rng.normal(size=tracks.shape)
    model.rotation = rotations.exp(0.05 * rng.normal(size=(FRAMES, 3))) @ model.rotation
    refine(model, noisy, SEEN, 3, 1e-4)
    other = copy(model)
    other.processes = copy(model.processes)
    refine(other, noisy, SEEN, 5, 1e-4)
    refine_jointly(model, noisy, SEEN, 5, 1e-4)
    assert model.cost < other.cost


def test_random_priors_have_the_variance_of_the_equations(made, rng):
    model, tracks = made
    beliefs = frame_equations(model, tracks, 0 * SEEN)[0]
    drawn = np.stack([_random_priors(model, rng) for _ in range(1500)])
    of_distances = joint_equations(model, tracks, SEEN).by_weight
    wanted = np.einsum("fdd->fd", beliefs)
    wanted[:, MOTION:] -= (of_distances**2).sum(1)
    np.testing.assert_allclose((drawn**2).mean(0), wanted, rtol=0.25)


def test_draws_vary_more_than_the_frames_alone_and_fit_the_image(made, rng):
    model, tracks = made
    refine(model, tracks + 1e-3 * rng.normal(size=tracks.shape), SEEN, 10, 1e-3)
    drawn = list(posterior_draws(model, tracks, SEEN, 10, rng))
    spread = np.mean([(draw.shapes - model.shapes) ** 2 for draw in drawn])
    own = np.einsum("mip,fmn,nip->fip", model.modes, model.covariance[0][:, MOTION:, MOTION:], model.modes)
    assert spread > own.mean()
    for draw in drawn:
        points = draw.rotation @ draw.shapes + draw.shift[:, :, None]
        assert np.sqrt(((points[:, :2] / points[:, 2:] - tracks) ** 2).mean()) < 5e-3
        np.testing.assert_allclose((draw.shapes - model.shapes).mean(2), 0, atol=1e-12)
