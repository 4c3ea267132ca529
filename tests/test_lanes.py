"""Sums of several numbers at a time are those of NumPy's slices."""

import numba
import numpy as np
import pytest

from marey.images.matching.splines import SplinePicture
from marey.lanes import (
    LANES,
    POSITIONS,
    add_row,
    correlate_rows,
    interpolate_pixels,
    lowest_bit,
    paint_flat_row,
    paint_row,
    place_pixels,
    put_combination,
    take_larger,
)
from tests.reference_matching import sample


@numba.njit
def added(sums, at, factor, row):
    add_row(sums, at, factor, (row[0], row[1], row[2], row[3], row[4], row[5], row[6], row[7]))


@numba.njit
def combined(out, at, factors, rows, start, stride):
    put_combination(out, at, (factors[0], factors[1], factors[2]), rows, start, stride)


@numba.njit
def interpolated(flat, width, to_image, corner, last, x, y, first, right, below, out):
    u, v, a, b, c, d = to_image
    near = (np.float32(u), np.float32(v), np.float32(a), np.float32(b), np.float32(c), np.float32(d))
    for at in range(0, len(x), 8):
        place_pixels(near, corner, width, last, x, y, at, first, right, below)
        interpolate_pixels(flat, width, first, right, below, at, out)


def spline_values(coefficients, origin, linear, offsets):
    """Values of a spline at `origin + linear offsets`, eight at a time, and the indices of the coefficients used."""
    height, width = coefficients.shape
    column, row = np.floor(origin).astype(int)
    x, y = np.ascontiguousarray(np.asarray(offsets, np.float32).T)
    first, right, below, out = np.empty(len(x), np.int32), *np.empty((3, len(x)), np.float32)
    to_image = (*(origin - [column, row]), *np.ravel(linear))
    corner, last = (row - 1) * width + column - 1, (height - 3) * width - 4
    interpolated(coefficients.ravel(), width, to_image, corner, last, x, y, first, right, below, out)
    return out, first


def test_a_spline_is_evaluated_at_eight_pixels_at_a_time(rng):
    coefficients, linear = rng.normal(size=(40, 50)).astype(np.float32), np.array([[0.9, 0.3], [-0.2, 1.1]])
    origin, offsets = np.array([24.3, 20.8]), rng.uniform(-12, 12, (24, 2)).astype(np.float32)
    found, _ = spline_values(coefficients, origin, linear, offsets)
    expected, _ = sample(SplinePicture(coefficients=coefficients), origin + offsets @ linear.T)
    # Places are rounded to 1e-6 px, sixteen products of numbers of about 1 to 6e-8 each.
    np.testing.assert_allclose(found, expected, atol=2e-5)


def test_an_unknown_coefficient_makes_the_values_about_it_unknown():
    coefficients, offsets = np.ones((12, 12), np.float32), np.array([[i % 4 - 1.5, i // 4] for i in range(8)])
    coefficients[4, 3] = np.nan
    found, _ = spline_values(coefficients, np.array([5.9, 5.9]), np.eye(2), offsets)
    about = np.abs(np.array([3.0, 4.0]) - (np.array([5.9, 5.9]) + offsets)).max(axis=1) < 2
    np.testing.assert_array_equal(np.isnan(found), about)
    assert 0 < about.sum() < 8


@pytest.mark.parametrize("aside", [-1e4, 1e4])
def test_no_coefficient_beyond_the_image_is_read(aside):
    coefficients = np.ones((9, 11), np.float32)
    _, first = spline_values(coefficients, np.array([5.5, 4.5]), np.eye(2), np.full((8, 2), aside))
    assert (first >= 0).all()
    assert (first + 3 * 11 + 3 < coefficients.size).all()


@numba.njit
def correlated(patch, size, window, at, stride, sums):
    correlate_rows(patch, size, window, at, stride, sums)


def test_two_rows_of_positions_are_correlated(rng):
    patch, window = (rng.normal(size=shape).astype(np.float32) for shape in ((5, 5), (11, 40)))
    expected = np.zeros((2, POSITIONS))
    for i in range(5):
        for j in range(5):
            expected += patch[i, j] * window[3 + i : 5 + i, 7 + j : 7 + j + POSITIONS].astype(float)
    sums = np.empty(2 * POSITIONS, np.float32)
    correlated(patch.ravel(), 5, window.ravel(), 3 * 40 + 7, 40, sums)
    # Twenty-five products of about 1, rounded to 6e-8 each.
    np.testing.assert_allclose(sums.reshape(2, POSITIONS), expected, atol=1e-5)


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


def test_rows_of_single_precision_are_combined(rng):
    out, rows, factors = (rng.normal(size=size).astype(np.float32) for size in (20, 50, 3))
    expected = out.astype(float)
    expected[7 : 7 + LANES] = sum(
        f * rows[2 + 13 * s : 2 + 13 * s + LANES].astype(float) for s, f in enumerate(factors)
    )
    combined(out, 7, factors, rows, 2, 13)
    # Three products of about 1, rounded to 6e-8 each; all other numbers are unchanged.
    np.testing.assert_allclose(out, expected, atol=1e-6)


def test_a_row_may_be_combined_with_itself(rng):
    rows, factors = rng.normal(size=50), np.array([1.0, 2.0, 3.0])
    expected = rows.copy()
    expected[:LANES] = rows[:LANES] + 2 * rows[10 : 10 + LANES] + 3 * rows[20 : 20 + LANES]
    combined(rows, 0, factors, rows, 0, 10)
    np.testing.assert_allclose(rows, expected, atol=1e-15)


@numba.njit
def painted(depth, label, at, count, first, second, third, value):
    paint_row(
        depth, label, at, count, (first[0], first[1]), (second[0], second[1]), (third[0], third[1]), np.int32(value)
    )


def test_a_row_is_painted_where_it_lies_inside_and_nearer(rng):
    for count in (1, 5, 8, 11):
        depth, label = rng.uniform(0, 1, 30), np.full(30, -1, np.int32)
        first, second, third = np.array([-0.2, 0.15]), np.array([1.1, -0.2]), np.array([0.4, 0.02])
        x = np.arange(LANES)
        u, v, z = (line[0] + line[1] * x for line in (first, second, third))
        shown = (u >= 0) & (v >= 0) & (1 - u - v >= 0) & (z > depth[4 : 4 + LANES]) & (x < count)
        expected, names = depth.copy(), label.copy()
        expected[4 : 4 + LANES][shown], names[4 : 4 + LANES][shown] = z[shown], 7
        painted(depth, label, 4, count, first, second, third, 7)
        np.testing.assert_allclose(depth, expected, rtol=1e-15)
        np.testing.assert_array_equal(label, names)


@numba.njit
def painted_flat(order, label, at, count, first, second, own, value):
    paint_flat_row(order, label, at, count, (first[0], first[1]), (second[0], second[1]), own, value)


def test_a_row_of_one_order_is_painted_where_it_lies_inside_and_nearer(rng):
    first, second = np.array([-0.2, 0.15], np.float32), np.array([1.1, -0.2], np.float32)
    x = np.arange(LANES)
    u, v = (line[0] + line[1] * x for line in (first, second))
    for count, kind in ((1, np.int8), (5, np.int16), (8, np.int8), (11, np.int16)):
        order, label = rng.uniform(0, 1, 30).astype(np.float32), np.full(30, -1, kind)
        shown = (u >= 0) & (v >= 0) & (1 - u - v >= 0) & (order[4 : 4 + LANES] < 0.6) & (x < count)
        expected, names = order.copy(), label.copy()
        expected[4 : 4 + LANES][shown], names[4 : 4 + LANES][shown] = 0.6, 7
        painted_flat(order, label, 4, count, first, second, np.float32(0.6), 7)
        np.testing.assert_array_equal(order, expected)
        np.testing.assert_array_equal(label, names)


@numba.njit
def taken(order, other, at, empty):
    return take_larger(order, other, at, empty)


def test_larger_pixels_are_taken_and_eight_are_emptied(rng):
    for other in (rng.uniform(0, 1, 30).astype(np.float32), np.float32(0.5)):
        order = rng.uniform(0, 1, 30).astype(np.float32)
        larger = (order > other)[5 : 5 + LANES]
        emptied = order.copy()
        emptied[5 : 5 + LANES] = -1
        assert taken(order, other, 5, np.float32(-1)) == np.sum(larger << np.arange(LANES))
        np.testing.assert_array_equal(order, emptied)


@numba.njit
def lowest(bits):
    return lowest_bit(bits)


def test_the_lowest_bit_is_found():
    assert [lowest(bits) for bits in (1, 2, 6, 128, 0b10100000)] == [0, 1, 1, 7, 5]
