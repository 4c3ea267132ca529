"""The verdict on a comparison of two motions: whether their clocks are known, and whether they move alike."""

from collections.abc import Iterator, Sequence
from contextlib import suppress

import numpy as np

from marey.errors import MareyError
from marey.motion.comparison import Agreement, MotionComparison, compare
from marey.motion.recording import Recording
from marey.pipelines.causes.angle_axes import definition_reasons
from marey.pipelines.verdict import Verdict, VerdictReason
from marey.wording import listed

POOR_SHIFT_S = 0.05
"""Standard deviation of the time shift above which it is named [s].

Chosen by hand: about the time in which a knee turns by 20 degrees in walking.
"""
NO_CORRELATION, FULL_CORRELATION = 0.5, 0.9
"""Correlation of all angles together, or of all points together, below which two recordings do not show the same
motion, and from which on they do. Chosen on captures of four rendered takes: points of one take by two ways of capture
have 0.998, angles 0.92 to 0.96; different takes have 0.31 at most, and 0.81 if two people reach about."""
LEAST_WITHIN = 0.8
"""Share of the differences of all angles within the stated 95 % intervals below which it limits the comparison. Errors
persist over frames, so that the share of sound intervals scatters about 0.95. Chosen by hand."""
_MOST_BEYOND = 0.5
"""The same share of one angle below which a note names it. Chosen by hand."""


def compare_defined(
    first: Recording, second: Recording, *, shift_s: float | None, same_laboratory: bool, free_rate: bool
) -> MotionComparison:  # fmt: skip
    """Compare two motions, also where they define joint angles by different axes.

    Such angles may fit best at a wrong time shift. If the orientations of the segments agree at the shift that they and
    the points show without the angles, that shift is used.

    Args:
        first: A motion.
        second: Another one, with the same names for the same quantities.
        shift_s: Shift of the second clock [s]; None to estimate it.
        same_laboratory: Whether both motions are in one laboratory.
        free_rate: Whether the rate of the second clock is estimated too.

    Returns:
        The aligned motions and their agreement.

    Raises:
        MareyError: They have no quantity or no time in common.
    """
    result = compare(first, second, shift_s=shift_s, same_laboratory=same_laboratory, free_rate=free_rate)
    correlations = {each.kind: each.correlation for each in result.together}
    if shift_s is not None or free_rate or not correlations.get("orientations", np.inf) < FULL_CORRELATION:
        return result
    if not correlations.get("angles", np.inf) < FULL_CORRELATION:
        return result
    with suppress(MareyError):
        found = compare(first, second, same_laboratory=same_laboratory, by_angles=False)
        if definition_reasons(found):
            return found
    return result


def comparison_verdict(result: MotionComparison, causes: Sequence[VerdictReason] = ()) -> Verdict:
    """Return the verdict on a comparison.

    Args:
        result: Both motions over common times, their alignment and agreement.
        causes: Why the motions do not agree, if it is known.
    """
    alignment = result.alignment
    defined = () if causes else definition_reasons(result)
    reasons = [*causes, *defined, *(VerdictReason.limit(note) for note in alignment.notes)]
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
    if not causes:
        unlike = list(_unlike(result, but_angles=bool(defined)))
        reasons += unlike if unlike or defined else _too_narrow(result)
    return Verdict.of(reasons)


def _unlike(result: MotionComparison, *, but_angles: bool) -> Iterator[VerdictReason]:
    """Name two motions whose quantities do not rise and fall together, at the shift that fits best.

    Args:
        result: The comparison.
        but_angles: Leave out the angles, because the motions define them otherwise.
    """
    known = [
        each for each in result.together
        if np.isfinite(each.correlation) and not (but_angles and each.kind == "angles")
    ]  # fmt: skip
    best = max(known, key=lambda each: each.correlation, default=None)
    if best is None or not np.isfinite(result.alignment.shift_sd_s) or best.correlation >= FULL_CORRELATION:
        return
    poor = best.correlation < NO_CORRELATION
    often = "do not" if poor else "only partly"
    values = listed(f"{each.correlation:.2f} for all {each.kind} together" for each in known)
    make = VerdictReason.failure if poor else VerdictReason.limit
    yield make(
        f"The quantities of the two motions {often} rise and fall together (correlation {values}).",
        "Give two recordings of the same motion.",
    )


def beyond_intervals(result: MotionComparison) -> list[Agreement]:
    """Return the quantities of which most differences are larger than the motions' stated intervals."""
    return [row for row in result.agreements if row.within_stated < _MOST_BEYOND]


def _too_narrow(result: MotionComparison) -> Iterator[VerdictReason]:
    """Name stated intervals that hold too few of the differences of all angles together."""
    rows = [row for row in result.agreements if np.isfinite(row.within_stated)]
    if not rows:
        return
    held = float(np.average([row.within_stated for row in rows], weights=[row.frames for row in rows]))
    if held < LEAST_WITHIN:
        yield VerdictReason.limit(
            f"The stated 95 % intervals hold {100 * held:.0f} % of the differences of all angles.",
            "The two motions define angles differently, or state too narrow intervals: do not take a difference beyond "
            "the intervals as a change of the person.",
            cause="narrow intervals",
        )
