"""Sums of eight numbers at a time are those of NumPy's slices."""

import numba
import numpy as np

from marey.lanes import LANES, add_row, put_combination


@numba.njit
def added(sums, at, factor, row):
    add_row(sums, at, factor, (row[0], row[1], row[2], row[3], row[4], row[5], row[6], row[7]))


@numba.njit
def combined(out, at, factors, rows, start, stride):
    put_combination(out, at, (factors[0], factors[1], factors[2]), rows, start, stride)


def test_a_row_is_added_where_it_belongs(rng):
    sums, row = rng.normal(size=30), rng.normal(size=LANES)
    expected = sums.copy()
    expected[5 : 5 + LANES] += 0.3 * row
    added(sums, 5, 0.3, row)
    np.testing.assert_allclose(sums, expected, rtol=1e-15)


def test_rows_are_combined_across_a_stride(rng):
    out, rows, factors = rng.normal(size=20), rng.normal(size=50), rng.normal(size=3)
    expected = out.copy()
    expected[7 : 7 + LANES] = sum(f * rows[2 + 13 * s : 2 + 13 * s + LANES] for s, f in enumerate(factors))
    combined(out, 7, factors, rows, 2, 13)
    np.testing.assert_allclose(out, expected, atol=1e-15)


def test_a_row_may_be_combined_with_itself(rng):
    rows, factors = rng.normal(size=50), np.array([1.0, 2.0, 3.0])
    expected = rows.copy()
    expected[:LANES] = rows[:LANES] + 2 * rows[10 : 10 + LANES] + 3 * rows[20 : 20 + LANES]
    combined(rows, 0, factors, rows, 0, 10)
    np.testing.assert_allclose(rows, expected, atol=1e-15)
