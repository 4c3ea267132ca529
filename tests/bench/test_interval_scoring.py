"""Calibration curves, calibration errors and the detection of failures from errors and stated deviations."""

from pathlib import Path

import numpy as np
import pytest
from bench.intervals.scoring import (
    FEWEST,
    LEVELS,
    area_under_curve,
    by_quantity,
    calibration_error,
    chance,
    curve,
    detection,
    ratio,
    read_samples,
    sample,
    single,
    write_samples,
)

COUNT = 20_000


def exact(rng: np.random.Generator, case: str = "seed", factor: float = 1.0, unit: str = "deg"):
    """Normal errors of deviations that differ, which are stated with a factor."""
    sd = np.exp(rng.normal(0, 0.7, (COUNT, 1)))
    return sample("turns", case, unit, sd * rng.normal(size=(COUNT, 3)), factor * np.repeat(sd, 3, axis=1))


def test_the_curve_of_exact_deviations_is_the_diagonal():
    samples = [exact(np.random.default_rng(0))]
    # Four standard deviations of a share of 3 COUNT independent errors.
    assert np.abs(curve(samples) - LEVELS).max() < 4 * 0.5 / np.sqrt(3 * COUNT)
    assert calibration_error(samples) < 4 * 0.5 / np.sqrt(3 * COUNT)


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_the_ratio_is_the_factor_by_which_intervals_are_too_narrow(factor: float):
    samples = [exact(np.random.default_rng(1), factor=factor)]
    # The median of n absolute normal values scatters by 1.17 / sqrt(n) of itself.
    assert ratio(samples) == pytest.approx(1 / factor, rel=4 * 1.17 / np.sqrt(3 * COUNT))
    assert calibration_error(samples) > 0.1
    assert np.all((curve(samples) < LEVELS) == (factor < 1))


def test_each_case_counts_the_same_however_many_errors_it_has():
    few = single("lengths", "few", "mm", np.zeros(2), np.ones(2))
    many = single("lengths", "many", "mm", np.full(100, 9.0), np.ones(100))
    assert curve([few, many], (0.95,)) == pytest.approx([0.5])


def test_a_result_without_a_deviation_holds_nothing_and_a_missing_one_does_not_count():
    one = single("lengths", "take", "mm", np.array([0.1, 0.1, np.nan]), np.array([1.0, np.nan, 1.0]))
    assert curve([one], (0.95,)) == pytest.approx([0.5])


def test_errors_of_one_case_are_joined():
    parts = [single("lengths", "take", "mm", np.full(n, 1.0), np.full(n, 1.0)) for n in (2, 3)]
    other = single("turns", "take", "deg", np.zeros(1), np.ones(1))
    groups = list(by_quantity([parts[0], other, parts[1]]))
    assert [[len(each.error) for each in group] for group in groups] == [[5], [1]]


def test_the_area_under_the_curve_is_the_share_of_ordered_pairs():
    rng = np.random.default_rng(2)
    score, failed = rng.integers(0, 6, 60).astype(float), rng.random(60) < 0.3
    pairs = score[failed][:, None] - score[~failed]
    assert area_under_curve(score, failed) == pytest.approx(np.mean((pairs > 0) + 0.5 * (pairs == 0)))


def test_exact_deviations_detect_as_well_as_they_can():
    found = detection([exact(np.random.default_rng(3))])
    assert found.auc is not None
    # The standard error of the area is at most 0.5 / sqrt of the number of failures.
    assert found.auc == pytest.approx(found.exact, abs=4 * 0.5 / np.sqrt(found.share * COUNT))
    assert found.auc > 0.7


def test_equal_deviations_detect_nothing():
    rng = np.random.default_rng(4)
    found = detection([single("turns", "seed", "deg", rng.normal(size=COUNT), np.ones(COUNT))])
    assert found.auc == found.exact == 0.5


def test_failures_are_above_50_mm_where_there_are_some():
    error = np.concatenate([np.full(100, 5.0), np.full(FEWEST, 60.0)])
    assert detection([single("joints", "take", "mm", error, error)]).limit == 50.0
    assert detection([single("joints", "take", "mm", error[1:-1], error[1:-1])]).limit == 15.0
    assert detection([single("joints", "take", "deg", error, error)]).limit == 15.0
    assert detection([single("joints", "take", "mm", error[1:-1], error[1:-1])]).auc is None


def test_chance_is_the_scatter_of_the_cases():
    rng = np.random.default_rng(5)
    alike = [exact(rng, case=str(k)) for k in range(6)]
    apart = [exact(rng, case=str(k), factor=2.0 ** (k - 2.5)) for k in range(6)]
    assert chance(alike[:1]) is None
    assert chance(alike) < 0.005 < 0.05 < chance(apart)


def test_what_is_written_is_read(tmp_path: Path):
    path = tmp_path / "kept" / "turns.npz"
    written = [exact(np.random.default_rng(6), case=case) for case in ("a", "b")]
    write_samples(path, written)
    for one, other in zip(written, read_samples(path), strict=True):
        assert (one.quantity, one.case, one.unit) == (other.quantity, other.case, other.unit)
        assert np.array_equal(one.error, other.error)
        assert np.array_equal(one.sd, other.sd)
