"""The verdict on a comparison of two motions: whether their clocks are known, and whether they move alike."""

from collections.abc import Iterator, Sequence

import numpy as np

from marey.arrays import Floats
from marey.motion.comparison import MotionComparison
from marey.pipelines.verdict import Verdict, VerdictReason

POOR_SHIFT_S = 0.05
"""Standard deviation of the time shift above which it is named [s].

Chosen by hand: about the time in which a knee turns by 20 degrees in walking.
"""
NO_CORRELATION, FULL_CORRELATION = 0.5, 0.9
"""Correlation of all angles together, or of all points together, below which two recordings do not show the same
motion, and from which on they do. Chosen on captures of four rendered takes: points of one take by two ways of capture
have 0.998, angles 0.92 to 0.96; different takes have 0.31 at most, and 0.81 if two people reach about."""


def comparison_verdict(result: MotionComparison, causes: Sequence[VerdictReason] = ()) -> Verdict:
    """Return the verdict on a comparison.

    Args:
        result: Both motions over common times, their alignment and agreement.
        causes: Why the motions do not agree, if it is known.
    """
    alignment = result.alignment
    reasons = [*causes, *(VerdictReason.limit(note) for note in alignment.notes)]
    if np.isfinite(alignment.rival_s):
        what = (
            f"The motion is periodic: a time shift of {alignment.rival_s:.3f} s fits nearly as well as the estimated "
            f"shift of {alignment.shift_s:.3f} s."
        )
        reasons.append(VerdictReason.limit(what, "If the shift is known, give it as shift (--shift)."))
    if alignment.shift_sd_s > POOR_SHIFT_S:
        what = f"The standard deviation of the time shift is {alignment.shift_sd_s:.2f} s."
        remedy = "Are both motions of the same trial? In a long one, estimate the rate of the clock (--clock rate)."
        reasons.append(VerdictReason.limit(what, remedy))
    return Verdict.of([*reasons, *(() if causes else _unlike(result))])


def _unlike(result: MotionComparison) -> Iterator[VerdictReason]:
    """Name two motions whose quantities do not rise and fall together, at the shift that fits best."""
    own, other = result.first, result.second
    angles = pooled_correlation(own.angles, other.angles)
    points = pooled_correlation(*(each.points.reshape(len(result.time), -1) for each in (own, other)))
    known = [value for value in (angles, points) if np.isfinite(value)]
    if np.isfinite(result.alignment.shift_sd_s) and known and max(known) < FULL_CORRELATION:
        often = "do not" if max(known) < NO_CORRELATION else "only partly"
        what = f"The quantities of the two motions {often} rise and fall together (correlation {max(known):.2f})."
        make = VerdictReason.failure if max(known) < NO_CORRELATION else VerdictReason.limit
        yield make(what, "Give two recordings of the same motion.")


def pooled_correlation(first: Floats, second: Floats) -> float:
    """Return the correlation of several quantities together, of which those that move more count more.

    Args:
        first: (N, K) quantities of one unit; NaN where unknown.
        second: The same of another recording.

    Returns:
        From -1 to 1; NaN if nothing moves.
    """
    known = np.isfinite(first) & np.isfinite(second)
    count = np.maximum(known.sum(0), 1)
    own, other = (np.where(known, each, 0.0) for each in (first, second))
    own, other = (np.where(known, each - each.sum(0) / count, 0.0) for each in (own, other))
    size = np.sqrt((own**2).sum() * (other**2).sum())
    return float((own * other).sum() / size) if size > 0 else float("nan")
