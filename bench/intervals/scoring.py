"""How well stated standard deviations describe true errors: calibration curve, calibration error, failure detection."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.stats import norm, rankdata

LEVELS = np.arange(0.05, 0.951, 0.05)
"""Levels over which the calibration error is the mean."""
SHOWN = (0.5, 0.8, 0.95)
"""Levels of the intervals in the table."""
LIMIT_MM = 50.0
"""Errors [mm] above this are failures, where a quantity is measured in millimetres and has `FEWEST` of them."""
MULTIPLE = 3.0
"""Elsewhere, errors above this multiple of the quantity's median error are failures."""
FEWEST = 10
"""Fewest failures, and fewest other errors, for which their detection is judged."""
MOST = 20_000
"""Most errors of one case, drawn at random, that are kept."""
DRAWS = 20
"""Draws of errors from the stated deviations, for the detection that exact intervals would reach."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Sample:
    """Errors of one quantity in one case, with their stated standard deviations.

    Attributes:
        quantity: What is measured.
        case: The take, trial, person or seed; errors of different cases are independent.
        unit: Unit of errors and deviations.
        error: (N, D) result less truth, D components of each result.
        sd: (N, D) stated standard deviations.
    """

    quantity: str
    case: str
    unit: str
    error: np.ndarray
    sd: np.ndarray


def sample(quantity: str, case: str, unit: str, error: np.ndarray, sd: np.ndarray) -> Sample:
    """Gather errors (..., D) and their standard deviations, without results that are missing.

    A result without a standard deviation stays: its interval holds nothing.
    """
    error, sd = np.broadcast_arrays(np.asarray(error, float), np.asarray(sd, float))
    error, sd = (each.reshape(-1, each.shape[-1]) for each in (error, sd))
    there = np.flatnonzero(np.isfinite(error).all(1))
    if len(there) > MOST:
        there = np.random.default_rng(0).choice(there, MOST, replace=False)
    return Sample(quantity=quantity, case=case, unit=unit, error=error[there], sd=sd[there])


def single(quantity: str, case: str, unit: str, error: np.ndarray, sd: np.ndarray) -> Sample:
    """Gather errors (...) of a number."""
    return sample(quantity, case, unit, np.asarray(error)[..., None], np.asarray(sd)[..., None])


@dataclass(frozen=True, kw_only=True)
class Detection:
    """How well the stated deviation finds failures.

    Attributes:
        limit: The error above which a result is a failure.
        share: Share of failures.
        auc: Area under the curve of found failures over false alarms; None where there are too few failures.
        exact: The same for errors drawn from the stated deviations: what exact intervals would reach.
    """

    limit: float
    share: float
    auc: float | None
    exact: float | None


def curve(samples: Sequence[Sample], levels: np.ndarray | Sequence[float] = LEVELS) -> np.ndarray:
    """The share of errors inside the central interval of each level, the mean over the cases.

    Args:
        samples: Errors of one quantity. Each case counts the same, however many errors it has.
        levels: Probabilities of the intervals.
    """
    limits = norm.ppf((1 + np.asarray(levels)) / 2)
    return np.mean([held(each, limits) for each in samples], axis=0)


def held(sample: Sample, limits: np.ndarray) -> np.ndarray:
    """The share of a sample's errors within multiples of their standard deviations."""
    sd = np.nan_to_num(sample.sd, nan=0.0)
    return np.array([(np.abs(sample.error) <= limit * sd).mean() for limit in limits])


def calibration_error(samples: Sequence[Sample]) -> float:
    """The mean difference, over the levels 5, 10, ..., 95 %, of the share held from the level [Kuleshov2018].

    Unlike the paper, differences count by their absolute value, as in the expected calibration error of [Guo2017], and
    not by their square: the figure is then a share of errors.
    """
    return float(np.abs(curve(samples) - LEVELS).mean())


def chance(samples: Sequence[Sample]) -> float | None:
    """The calibration error that is expected of exact intervals, by the scatter of the cases; None for one case.

    The share held in a case is taken as independent of the other cases, and the mean of the shares as normal.
    """
    if len(samples) < 2:
        return None
    limits = norm.ppf((1 + LEVELS) / 2)
    scatter = np.std([held(each, limits) for each in samples], axis=0, ddof=1) / np.sqrt(len(samples))
    return float(np.sqrt(2 / np.pi) * scatter.mean())


def ratio(samples: Sequence[Sample]) -> float:
    """The median of errors over standard deviations, relative to that of a normal distribution, mean over the cases.

    Above 1, intervals are too narrow by this factor; below 1, too wide.
    """
    ratios = [np.median(np.abs(s.error[s.sd > 0]) / s.sd[s.sd > 0]) for s in samples if (s.sd > 0).any()]
    return float(np.mean(ratios) / norm.ppf(0.75))


def detection(samples: Sequence[Sample]) -> Detection:
    """Judge the length of the stated deviation as a sign of failures: errors whose length is above a limit."""
    error = np.concatenate([each.error for each in samples])
    sd = np.nan_to_num(np.concatenate([each.sd for each in samples]), nan=np.inf)
    length, stated = np.linalg.norm(error, axis=1), np.linalg.norm(sd, axis=1)
    limit = LIMIT_MM
    if samples[0].unit != "mm" or (length > LIMIT_MM).sum() < FEWEST:
        limit = MULTIPLE * float(np.median(length))
    failed = length > limit
    if min(failed.sum(), (~failed).sum()) < FEWEST:
        return Detection(limit=limit, share=float(failed.mean()), auc=None, exact=None)
    rng = np.random.default_rng(0)
    known = np.isfinite(stated)
    drawn = [np.linalg.norm(sd[known] * rng.normal(size=sd[known].shape), axis=1) > limit for _ in range(DRAWS)]
    exact = [area_under_curve(stated[known], each) for each in drawn if 0 < each.sum() < len(each)]
    return Detection(
        limit=limit, share=float(failed.mean()), auc=area_under_curve(stated, failed),
        exact=float(np.mean(exact)) if exact else None,
    )  # fmt: skip


def area_under_curve(score: np.ndarray, failed: np.ndarray) -> float:
    """The probability that a failure has the higher score than a success, ties counted half [Hanley1982].

    Args:
        score: (N,) the higher, the more likely a failure.
        failed: (N,) whether it is one; some are, some are not.
    """
    ranks, count = rankdata(score), int(failed.sum())
    return float((ranks[failed].sum() - count * (count + 1) / 2) / (count * (len(failed) - count)))


def by_quantity(samples: Iterable[Sample]) -> Iterator[list[Sample]]:
    """Group samples by their quantity, in the order in which quantities appear, and join those of one case."""
    groups: dict[str, dict[str, list[Sample]]] = {}
    for each in samples:
        if len(each.error):
            groups.setdefault(each.quantity, {}).setdefault(each.case, []).append(each)
    for cases in groups.values():
        yield [joined(parts) for parts in cases.values()]


def joined(parts: Sequence[Sample]) -> Sample:
    """Join samples of one quantity and case."""
    error, sd = (np.concatenate([getattr(part, name) for part in parts]) for name in ("error", "sd"))
    return replace(parts[0], error=error, sd=sd)


def write_samples(path: Path, samples: Sequence[Sample]) -> None:
    """Keep samples for later runs of the same commit."""
    path.parent.mkdir(parents=True, exist_ok=True)
    labels = np.array([[each.quantity, each.case, each.unit] for each in samples])
    arrays = {f"{name}_{k}": getattr(s, name) for k, s in enumerate(samples) for name in ("error", "sd")}
    np.savez_compressed(path, labels=labels, **arrays)


def read_samples(path: Path) -> list[Sample]:
    """Read what `write_samples` left."""
    with np.load(path) as file:
        return [
            Sample(quantity=str(q), case=str(c), unit=str(u), error=file[f"error_{k}"], sd=file[f"sd_{k}"])
            for k, (q, c, u) in enumerate(file["labels"])
        ]
