"""The Gaussian model in perspective: derivatives, gauge, and the solution of its equations."""

import numpy as np
import pytest

from marey.geometry import rotations
from marey.nonrigid.one_camera.perspective_model import (
    MOTION,
    _motion_products,
    distance_jacobians,
    initial_model,
    refine,
    remove_small_modes,
    residuals_and_jacobians,
    set_gauge,
    solve_frames,
)

FRAMES, POINTS, MODES = 14, 9, 2


@pytest.fixture
def made(rng):
    """A model that fits its tracks exactly, and these."""
    time = np.arange(FRAMES) / FRAMES
    shapes = rng.normal(size=(3, POINTS)) + np.einsum(
        "fm,mip->fip", 0.1 * np.sin(6 * np.outer(time, [1, 1.7])), rng.normal(size=(2, 3, POINTS))
    )
    rotation = rotations.exp(np.outer(np.sin(5 * time), [0.3, 0.8, 0.1]))
    shift = np.stack([0.3 * time, 0.1 * time, 6 + np.sin(4 * time)], 1)
    pairs = np.array([[0, 1], [1, 2], [3, 5]])
    points = rotation @ shapes + shift[:, :, None]
    return initial_model(rotation, shift, shapes, MODES, 0.01, pairs), points[:, :2] / points[:, 2:]


def test_the_initial_model_explains_its_tracks(made):
    model, tracks = made
    residual, _ = residuals_and_jacobians(model, tracks, np.ones((FRAMES, POINTS)))
    np.testing.assert_allclose(residual, 0, atol=1e-12)
    assert np.sqrt((model.mean**2).mean()) == pytest.approx(1)


def test_derivatives_are_those_of_differences(made, rng):
    model, tracks = made
    seen = np.ones((FRAMES, POINTS))
    residual, jacobian = residuals_and_jacobians(model, tracks, seen)
    missing, by_weight = distance_jacobians(model)
    step = 1e-6 * rng.normal(size=(FRAMES, MOTION + MODES))
    model.rotation = rotations.exp(step[:, :3]) @ model.rotation
    model.shift = model.shift + step[:, 3:MOTION]
    model.weights = model.weights + step[:, MOTION:]
    moved = residual - residuals_and_jacobians(model, tracks, seen)[0]
    np.testing.assert_allclose(moved, np.einsum("fkpd,fd->fkp", jacobian, step), atol=1e-10)
    stretched = missing - distance_jacobians(model)[0]
    np.testing.assert_allclose(stretched, np.einsum("fem,fm->fe", by_weight, step[:, MOTION:]), atol=1e-10)


def test_the_gauge_preserves_the_image_and_removes_motion_from_the_modes(made, rng):
    model, tracks = made
    set_gauge(model)
    turn = np.array([0.2, -0.1, 0.3])
    model.modes = model.modes + 1e-3 * (np.cross(turn, model.mean.T).T + turn[:, None])
    before = residuals_and_jacobians(model, tracks, np.ones((FRAMES, POINTS)))[0]
    set_gauge(model)
    after = residuals_and_jacobians(model, tracks, np.ones((FRAMES, POINTS)))[0]
    np.testing.assert_allclose(after, before, atol=1e-5)
    np.testing.assert_allclose(model.modes.mean(2), 0, atol=1e-12)
    moments = np.cross(model.mean.T[None], np.swapaxes(model.modes, 1, 2)).sum(1)
    np.testing.assert_allclose(moments, 0, atol=1e-10)


def test_rounds_converge_from_a_wrong_start(made, rng):
    model, tracks = made
    true = model.points
    model.rotation = rotations.exp(0.05 * rng.normal(size=(FRAMES, 3))) @ model.rotation
    model.mean = model.mean + 0.05 * rng.normal(size=model.mean.shape)
    noisy = tracks + 1e-4 * rng.normal(size=tracks.shape)
    refine(model, noisy, np.ones((FRAMES, POINTS)), 20, 1e-5)
    ratio = (true**2).sum() / (true * model.points).sum()
    assert np.sqrt(((ratio * model.points - true) ** 2).mean()) < 0.02 * model.shift[:, 2].mean()
    assert np.sqrt(model.variance) < 5e-4


def test_errors_of_weights_and_motion_are_correlated(made):
    model, tracks = made
    solve_frames(model, tracks, np.ones((FRAMES, POINTS)))
    wanted = np.zeros((FRAMES, 1 + MODES, 3, POINTS))
    roots = np.linalg.cholesky(model.covariance[0])
    for column in np.moveaxis(roots, 2, 0):
        carried = np.cross(column[:, None, :3], np.swapaxes(model.rotation @ model.shapes, 1, 2))
        carried = (carried + column[:, None, 3:MOTION]) @ model.rotation
        wanted[:, 1:] += column[:, MOTION:, None, None] * np.swapaxes(carried, 1, 2)[:, None]
    np.testing.assert_allclose(_motion_products(model), wanted, atol=1e-12)


def test_negligible_modes_are_removed(made):
    model, tracks = made
    seen = np.ones((FRAMES, POINTS))
    solve_frames(model, tracks, seen)
    before = model.points
    model.modes = np.concatenate([model.modes[:1], 1e-9 * model.modes[1:], model.modes[1:]])
    model.weights = model.weights[:, [0, 1, 1]]
    model.processes = model.processes.among(np.array([0, 1, 1]))
    model.covariance = tuple(
        part[:, [*range(MOTION + 1), 7, 7]][:, :, [*range(MOTION + 1), 7, 7]] for part in model.covariance
    )
    remove_small_modes(model)
    assert model.modes.shape[0] == model.weights.shape[1] == len(model.processes.weight_variance) == MODES
    assert model.covariance[0].shape[1] == MOTION + MODES
    np.testing.assert_allclose(model.points, before, atol=1e-9)


@pytest.mark.slow
def test_many_rounds_do_not_diverge(made, rng):
    model, tracks = made
    noisy = tracks + 1e-3 * rng.normal(size=tracks.shape)
    model = initial_model(
        model.rotation, model.shift, model.shapes + 0.01 * rng.normal(size=model.shapes.shape), 6, 0.01, model.pairs
    )
    refine(model, noisy, np.ones((FRAMES, POINTS)), 150, 1e-4)
    assert np.sqrt(model.variance) < 2e-3
