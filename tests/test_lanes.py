"""Sums of several numbers at a time are those of NumPy's slices."""

import numba
import numpy as np

from marey.lanes import (
    LANES,
    POSITIONS,
    add_row,
    correlate_rows,
    lowest_bit,
    paint_flat_row,
    paint_row,
    put_combination,
    take_larger,
    weighted_square,
)


@numba.njit
def added(sums, at, factor, row):
    add_row(sums, at, factor, (row[0], row[1], row[2], row[3], row[4], row[5], row[6], row[7]))


@numba.njit
def combined(out, at, factors, rows, start, stride):
    put_combination(out, at, (factors[0], factors[1], factors[2]), rows, start, stride)


@numba.njit
def weighted(picture, first, width, across, down):
    return weighted_square(
        picture, first, width, (across[0], across[1], across[2], across[3]), (down[0], down[1], down[2], down[3])
    )


def test_a_square_of_an_image_is_weighted_by_rows_and_columns(rng):
    picture = rng.normal(size=(9, 11)).astype(np.float32)
    across, down = rng.normal(size=(2, 4)).astype(np.float32)
    expected = down.astype(float) @ picture[3:7, 6:10].astype(float) @ across
    found = weighted(picture.ravel(), 3 * 11 + 6, 11, across, down)
    # Sixteen products of three numbers of about 1, rounded to 6e-8 each.
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_an_unknown_pixel_makes_the_weighted_square_unknown(rng):
    picture = np.ones(40, np.float32)
    picture[2 * 8 + 3] = np.nan
    assert np.isnan(weighted(picture, 0, 8, np.ones(4, np.float32), np.ones(4, np.float32)))


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
