"""Standard deviations are found again from what a fit leaves over."""

import numpy as np
import pytest

from marey.fit.variance_components import component, redundancy


def test_a_standard_deviation_on_top_of_known_ones_is_found_again(rng):
    known = rng.uniform(0.0, 2.0, 20000) ** 2
    residual = rng.normal(size=len(known)) * np.sqrt(known + 1.5**2)
    # A standard deviation from n squares is known to 1 / sqrt(2 n) of itself, here at most thrice as far.
    assert component(residual, known) == pytest.approx(1.5, rel=3 * 3 / np.sqrt(2 * len(known)))


def test_it_is_the_root_mean_square_where_nothing_is_known(rng):
    residual = rng.normal(size=500)
    assert component(residual, np.zeros(500)) == pytest.approx(np.sqrt(np.mean(residual**2)), rel=1e-5)


def test_known_deviations_that_explain_all_leave_nothing(rng):
    assert component(0.5 * rng.normal(size=1000), np.ones(1000)) == 0.0


def test_nothing_observed_says_nothing():
    assert np.isnan(component(np.zeros(0), np.zeros(0)))


def test_a_fit_leaves_over_what_its_parameters_do_not_take(rng):
    """Two kinds of observations of five parameters: both standard deviations are found again, over many draws."""
    sds, counts, found = (0.3, 2.0), (40, 60), []
    for _ in range(200):
        rows = [rng.normal(size=(n, 5)) for n in counts]
        values = [rng.normal(size=n) * sd for n, sd in zip(counts, sds, strict=True)]
        own = [r.T @ r / sd**2 for r, sd in zip(rows, sds, strict=True)]
        whole = own[0] + own[1]
        solved = np.linalg.solve(whole, sum(r.T @ v / sd**2 for r, v, sd in zip(rows, values, sds, strict=True)))
        found.append(
            [
                component(v - r @ solved, np.zeros(n), left=redundancy(n, k, whole) / n) ** 2
                for v, r, n, k in zip(values, rows, counts, own, strict=True)
            ]
        )
    mean, error = np.mean(found, 0), np.std(found, 0) / np.sqrt(200)
    assert np.all(np.abs(mean - np.square(sds)) < 4 * error)
