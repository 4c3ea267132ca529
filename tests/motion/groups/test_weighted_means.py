"""Means of values with uncertainties: laws, and the coverage of the intervals."""

import numpy as np
import pytest
from scipy.stats import t as student

from marey.motion.groups.outliers import FEWEST_FOR_OUTLIERS, find_outliers
from marey.motion.groups.weighted_means import between_variance, difference_of_means, group_mean


def test_equal_uncertainties_give_the_plain_mean_and_its_interval(rng):
    values, sds = rng.normal(3.0, 2.0, 8), np.full(8, 0.1)
    mean = group_mean(values, sds)
    half = student.ppf(0.975, 7) * values.std(ddof=1) / np.sqrt(8)
    assert mean.value == pytest.approx(values.mean())
    assert (mean.low, mean.high) == pytest.approx((values.mean() - half, values.mean() + half))
    assert mean.between_sd**2 == pytest.approx(values.var(ddof=1) - 0.01)


def test_the_variance_between_values_solves_the_equation_of_moments(rng):
    sds = rng.uniform(0.5, 2.0, 12)
    values = rng.normal(0.0, 3.0, 12)
    variance, weights = between_variance(values, sds), 1 / sds**2
    mean = np.average(values, weights=weights)
    expected = 11 + variance * (weights.sum() - (weights**2).sum() / weights.sum())
    assert (weights * (values - mean) ** 2).sum() == pytest.approx(expected)


def test_a_precise_value_counts_more_unless_the_values_differ():
    assert group_mean(np.array([0.0, 1.0]), np.array([1.0, 3.0])).value == pytest.approx(0.1)
    assert group_mean(np.array([0.0, 100.0]), np.array([1.0, 3.0])).value == pytest.approx(50.0, abs=0.1)


def test_intervals_contain_the_truth_as_often_as_they_state(rng):
    inside, tries = 0, 400
    for _ in range(tries):
        sds = rng.uniform(0.2, 2.0, 6)
        mean = group_mean(rng.normal(5.0, np.hypot(1.0, sds)), sds)
        inside += mean.low <= 5.0 <= mean.high
    # Three standard deviations of the number of 95 % in 400 tries.
    assert inside / tries > 0.95 - 3 * np.sqrt(0.95 * 0.05 / tries)


def test_without_all_uncertainties_the_values_have_one_weight():
    mean = group_mean(np.array([1.0, 2.0, 6.0]), np.array([0.1, np.nan, 0.1]))
    assert (mean.value, mean.weighted) == (3.0, False)
    assert mean.standard_error == pytest.approx(np.std([1, 2, 6], ddof=1) / np.sqrt(3))
    alone = group_mean(np.array([1.0]), np.array([np.nan]))
    assert (alone.value, alone.count) == (1.0, 1)
    assert np.isnan([alone.low, alone.high, alone.between_sd]).all()
    assert group_mean(np.array([np.nan]), np.array([1.0])).count == 0


def test_a_single_value_keeps_its_own_interval():
    mean = group_mean(np.array([2.0]), np.array([0.5]))
    assert (mean.low, mean.high) == pytest.approx((2 - 0.5 * 1.959964, 2 + 0.5 * 1.959964))


def test_a_difference_of_means_is_antisymmetric_and_as_wide_as_both(rng):
    first = group_mean(rng.normal(5, 1, 9), np.full(9, 0.2))
    second = group_mean(rng.normal(3, 1, 5), np.full(5, 0.2))
    there, back = difference_of_means(first, second), difference_of_means(second, first)
    assert (there.value, there.low, there.high) == pytest.approx((-back.value, -back.high, -back.low))
    assert there.high - there.value == pytest.approx(np.hypot(first.high - first.value, second.value - second.low))


def test_a_far_value_is_an_outlier_unless_its_own_uncertainty_explains_it(rng):
    values, sds = np.append(rng.normal(0, 1, 20), 9.0), np.full(21, 0.1)
    np.testing.assert_array_equal(np.flatnonzero(find_outliers(values, sds)), [20])
    sds[20] = 5.0
    assert not find_outliers(values, sds).any()
    few = values[-FEWEST_FOR_OUTLIERS + 1 :]
    assert not find_outliers(few, np.zeros(len(few))).any()
    assert not find_outliers(np.ones(9), np.zeros(9)).any()
