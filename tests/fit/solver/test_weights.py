"""Robust weights against their definition, and standard deviations estimated from residuals."""

import numpy as np
import pytest

from marey.fit.solver.weights import component_sd, geman_mcclure, match_weights


def test_a_weight_is_one_at_zero_and_a_quarter_at_the_scale():
    np.testing.assert_allclose(geman_mcclure(np.array([0.0, 2.0, -2.0]), 2.0), [1.0, 0.25, 0.25])
    far = geman_mcclure(np.array([200.0, 400.0]), 2.0)
    np.testing.assert_allclose(far[0] / far[1], 16.0, rtol=1e-3)


def test_weights_of_matches_are_those_of_their_residuals(rng):
    vertices, faces = rng.normal(size=(7, 3)), np.array([[0, 1, 2], [3, 5, 4], [6, 0, 5]])
    face, barycentric, counts = np.array([2, 0, 1, 2]), rng.dirichlet(np.ones(3), 4), np.array([1.0, 2.0, 2.0, 1.0])
    rows, offsets = rng.normal(size=(4, 2, 3)), rng.normal(size=(4, 2))
    points = np.einsum("nv,nvk->nk", barycentric, vertices[faces[face]])
    residual = np.einsum("nrk,nk->nr", rows, points) - offsets
    found = match_weights(rows, offsets, vertices, faces, face, barycentric, counts, 0.8)
    np.testing.assert_allclose(found, counts * geman_mcclure(residual, 0.8))


def test_rows_count_by_their_length(rng):
    rows = rng.normal(size=(9, 3))
    np.testing.assert_allclose(geman_mcclure(rows, 0.7), geman_mcclure(np.linalg.norm(rows, axis=1), 0.7))


def test_the_weight_is_the_slope_of_a_bounded_cost(rng):
    scale, step = 1.7, 1e-6
    r = rng.normal(size=20) * 3

    def cost(x):
        return scale**2 * x**2 / (scale**2 + x**2)

    slope = (cost(r + step) - cost(r - step)) / (2 * step)
    np.testing.assert_allclose(2 * r * geman_mcclure(r, scale), slope, atol=1e-8)


def test_a_standard_deviation_on_top_of_known_ones_is_found_again(rng):
    known = rng.uniform(0.0, 2.0, 20000) ** 2
    residual = rng.normal(size=len(known)) * np.sqrt(known + 1.5**2)
    # A standard deviation from n squares is known to 1 / sqrt(2 n) of itself, here at most thrice as far.
    assert component_sd(residual, known) == pytest.approx(1.5, rel=3 * 3 / np.sqrt(2 * len(known)))


def test_it_is_the_root_mean_square_where_nothing_is_known(rng):
    residual = rng.normal(size=500)
    assert component_sd(residual, np.zeros(500)) == pytest.approx(np.sqrt(np.mean(residual**2)), rel=1e-5)


def test_known_deviations_that_explain_all_leave_nothing(rng):
    assert component_sd(0.5 * rng.normal(size=1000), np.ones(1000)) == 0.0


def test_without_observations_the_result_is_nan():
    assert np.isnan(component_sd(np.zeros(0), np.zeros(0)))


def test_estimated_parameters_reduce_the_redundancy(rng):
    """Five observations about each of many means: a fifth of them went into the means."""
    values = rng.normal(size=(4000, 5)) * 0.3
    residual = (values - values.mean(1, keepdims=True)).ravel()
    found = component_sd(residual, np.zeros(len(residual)), left=4 / 5)
    assert found == pytest.approx(0.3, rel=3 / np.sqrt(2 * 16000))
