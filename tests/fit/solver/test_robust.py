"""Robust weights against their definition."""

import numpy as np

from marey.fit.solver.weights import geman_mcclure


def test_a_weight_is_one_on_the_spot_a_quarter_at_the_scale_and_fades_with_the_fourth_power():
    np.testing.assert_allclose(geman_mcclure(np.array([0.0, 2.0, -2.0]), 2.0), [1.0, 0.25, 0.25])
    far = geman_mcclure(np.array([200.0, 400.0]), 2.0)
    np.testing.assert_allclose(far[0] / far[1], 16.0, rtol=1e-3)


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
