"""Means of measured values with uncertainties of their own, and with a variance between them ([DerSimonian1986])."""

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri, stdtrit

from marey.arrays import Floats

_LEVEL = 0.95
"""Probability of the intervals."""


@dataclass(frozen=True, kw_only=True)
class GroupMean:
    """The mean of a group of values."""

    value: float
    """The mean; NaN for an empty group."""
    low: float
    """Lower end of the 95 % interval; NaN if unknown."""
    high: float
    """Upper end of the 95 % interval; NaN if unknown."""
    standard_error: float
    """Standard deviation of the mean; NaN if unknown."""
    between_sd: float
    """Standard deviation between the true values, without that of the measurements; NaN for fewer than two."""
    count: int
    """Number of values."""
    weighted: bool
    """Whether the uncertainties give the weights; otherwise all values have the same weight."""


def group_mean(values: Floats, sds: Floats) -> GroupMean:
    """Average values whose true values differ, by weights that include the variance between them.

    The variance between the true values is estimated by moments ([DerSimonian1986]); it is added to that of
    each value, and the inverse sums are the weights. The interval is that of [Hartung2001] with Student's t; unlike
    the paper, it is never narrower than that of known variances with the same t, as [Rover2015] recommend.

    Args:
        values: (N,) values.
        sds: (N,) their standard deviations. If one of them is unknown or not positive, all values have the same weight,
            and the interval follows from their spread.

    Returns:
        The mean.
    """
    known = np.isfinite(values)
    values, sds = values[known], sds[known]
    count, nan = len(values), float("nan")
    if not count:
        return _mean(nan, nan, nan, nan, 0, weighted=False)
    if not (np.isfinite(sds) & (sds > 0)).all():
        spread = float(values.std(ddof=1)) if count > 1 else nan
        return _mean(float(values.mean()), spread / np.sqrt(count), _quantile(count), spread, count, weighted=False)
    if count == 1:
        return _mean(float(values[0]), float(sds[0]), float(ndtri(0.5 + _LEVEL / 2)), nan, 1, weighted=True)
    variance = between_variance(values, sds)
    weights = 1 / (sds**2 + variance)
    mean = float(np.average(values, weights=weights))
    ratio = max(1.0, float((weights * (values - mean) ** 2).sum()) / (count - 1))
    error = float(np.sqrt(ratio / weights.sum()))
    return _mean(mean, error, _quantile(count), float(np.sqrt(variance)), count, weighted=True)


def between_variance(values: Floats, sds: Floats) -> float:
    """Estimate the variance between the true values of a group by moments ([DerSimonian1986]).

    Args:
        values: (N,) two or more values.
        sds: (N,) their standard deviations, all positive.
    """
    weights = 1 / sds**2
    mean = np.average(values, weights=weights)
    excess = float((weights * (values - mean) ** 2).sum()) - (len(values) - 1)
    return max(0.0, excess / float(weights.sum() - (weights**2).sum() / weights.sum()))


def difference_of_means(first: GroupMean, second: GroupMean) -> GroupMean:
    """Return the difference of the means of two independent groups, first minus second ([Zou2008]).

    Args:
        first: The mean of one group.
        second: The mean of the other.

    Returns:
        The difference; its interval combines those of the means, which need not be normal. `between_sd` is NaN.
    """
    value = first.value - second.value
    low = value - float(np.hypot(first.value - first.low, second.high - second.value))
    high = value + float(np.hypot(first.high - first.value, second.value - second.low))
    return GroupMean(
        value=value, low=low, high=high, standard_error=float(np.hypot(first.standard_error, second.standard_error)),
        between_sd=float("nan"), count=first.count + second.count, weighted=first.weighted and second.weighted,
    )  # fmt: skip


def _quantile(count: int) -> float:
    """Return the quantile of Student's distribution for the interval of a mean of some values; NaN for one."""
    return float(stdtrit(count - 1, 0.5 + _LEVEL / 2)) if count > 1 else float("nan")


def _mean(
    value: float, error: float, quantile: float, between_sd: float, count: int, *, weighted: bool
) -> GroupMean:  # fmt: skip
    half = quantile * error
    return GroupMean(
        value=value, low=value - half, high=value + half, standard_error=float(error), between_sd=between_sd,
        count=count, weighted=weighted,
    )  # fmt: skip
