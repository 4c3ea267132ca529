"""The verdict on a comparison of two motions: whether their clocks are known, and whether they move alike."""

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from marey.motion.anatomical import segments_of_angle
from marey.motion.comparison import WITHOUT_MEAN, Agreement, MotionComparison
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

_MOST_BY_ORIENTATIONS = 2.0
"""Largest standard deviation of the differences of an angle that the segments' orientations explain, as a multiple of
theirs. Equal axes give at most 1, divided by the cosine of the adduction. Chosen by hand."""
_LEAST_BY_DEFINITION = float(np.radians(5))
"""Least standard deviation of the differences of an angle that counts as one of definition [rad]. Chosen by hand."""
LEAST_WITHIN = 0.8
"""Share of the differences of all angles within the stated 95 % intervals below which it limits the comparison. Errors
persist over frames, so that the share of sound intervals scatters about 0.95. Chosen by hand."""
_MOST_BEYOND = 0.5
"""The same share of one angle below which a note names it. Chosen by hand."""
_MOST_NAMES = 8
"""Names that a sentence lists at most."""


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


def definition_reasons(result: MotionComparison) -> tuple[VerdictReason, ...]:
    """Name the angles that the two motions define with different axes.

    An angle between two segments can differ about its mean by no more than the orientations of both segments do, if the
    motions define it by the same axes. Angles of the shoulder, which two sequences of rotations describe and which are
    ambiguous at some elevations, are not tested.

    Args:
        result: The comparison.

    Returns:
        One reason, or none.
    """
    steady = {row.name: row.rms for row in result.agreements if row.kind == "rotation" and row.frames}
    angles: dict[tuple[str, str], list[Agreement]] = {}
    for row in result.agreements:
        pair = segments_of_angle(row.name) if row.kind == "angle" and row.frames else None
        if pair and not pair[1].endswith("upperarm") and all(f"{each}{WITHOUT_MEAN}" in steady for each in pair):
            angles.setdefault(pair, []).append(row)
    found = []
    for pair, rows in angles.items():
        parent, child = (steady[f"{each}{WITHOUT_MEAN}"] for each in pair)
        explained = float(_MOST_BY_ORIENTATIONS * np.hypot(parent, child))
        if max(row.sd for row in rows) > max(explained, _LEAST_BY_DEFINITION):
            found.append(pair)
    if not found:
        return ()
    named = [row for pair in found for row in angles[pair]]
    segments = list(dict.fromkeys(each for pair in found for each in pair))
    apart = max(steady[f"{each}{WITHOUT_MEAN}"] for each in segments)
    what = (
        f"The two motions define joint angles by different axes of the segments. The orientations of "
        f"{_plain(segments)} agree to {np.degrees(apart):.1f} degrees (RMS without constant offset), but the angles "
        f"between them ({_plain(row.name for row in named)}) differ by up to "
        f"{np.degrees(max(row.sd for row in named)):.0f} degrees about their bias (standard deviation)."
    )
    remedy = (
        "Do not compare these angles. Compare the orientations in the table, or give both motions the same axes of the "
        "bones: X forward, Y up, Z to the right, as from a static trial with landmarks (marey markers --static)."
    )
    return (VerdictReason.limit(what, remedy, cause="joint axes"),)


def _plain(names: Iterable[str]) -> str:
    return listed((name.replace("_", " ") for name in names), most=_MOST_NAMES)


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
