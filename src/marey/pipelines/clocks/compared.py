"""The verdict on a comparison of two motions: whether their clocks are known, and whether they move alike."""

from collections.abc import Iterator

import numpy as np

from marey.motion.comparison import MotionComparison
from marey.pipelines.verdict import Verdict, VerdictReason

POOR_SHIFT_S = 0.05
"""Standard deviation of the time shift above which it is named [s].

Chosen by hand: about the time in which a knee turns by 20 degrees in walking.
"""
NO_CORRELATION = 0.5
"""Correlation that no quantity reaches if two recordings do not show the same motion. Chosen by hand."""


def comparison_verdict(result: MotionComparison) -> Verdict:
    """Return the verdict on a comparison.

    Args:
        result: Both motions over common times, their alignment and agreement.
    """
    alignment = result.alignment
    reasons = [VerdictReason.limit(note) for note in alignment.notes]
    if np.isfinite(alignment.rival_s):
        what = (
            f"The motion is periodic: a time shift of {alignment.rival_s:.3f} s fits nearly as well as the estimated "
            f"shift of {alignment.shift_s:.3f} s."
        )
        reasons.append(VerdictReason.limit(what, "If the shift is known, give it as shift (--shift)."))
    if alignment.shift_sd_s > POOR_SHIFT_S:
        what = f"The standard deviation of the time shift is {alignment.shift_sd_s:.2f} s."
        reasons.append(VerdictReason.limit(what, "Are both motions of the same trial?"))
    return Verdict.of([*reasons, *_unlike(result)])


def _unlike(result: MotionComparison) -> Iterator[VerdictReason]:
    """Name two motions of which no quantity rises and falls together, at the shift that fits best."""
    known = [row.correlation for row in result.agreements if row.frames and np.isfinite(row.correlation)]
    if np.isfinite(result.alignment.shift_sd_s) and known and max(known) < NO_CORRELATION:
        what = f"No quantity of the two motions rises and falls together (highest correlation {max(known):.2f})."
        yield VerdictReason.failure(what, "Give two recordings of the same motion.")
