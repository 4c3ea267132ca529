"""Causes of two motions that do not agree, each tested by trying its repair."""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Floats
from marey.errors import MareyError
from marey.markers.preprocessing.posture_repairs import side_pairs
from marey.motion.alignment import ALIGNMENT_DEFAULTS
from marey.motion.comparison import MotionComparison, compare
from marey.motion.recording import Recording
from marey.motion.shift_search import agreement_by_lag
from marey.pipelines.causes.angle_axes import definition_reasons
from marey.pipelines.verdict import VerdictReason

_POOR_POINTS_M, _POOR_ANGLES = 0.06, 0.2
"""Distance of common points (RMS) [m], and RMS difference of angles about their means [rad], above which repairs are
tried. Joint centres of one motion by two systems are 10 to 50 mm apart. Chosen by hand."""
_LARGEST_RATIO = 0.5
"""With a repair, the difference is below this ratio of that without. On joints of the rendered `walk`, `reach` and
`jacks` with errors of 22 mm, planted mirror images and exchanged sides give 0.09 to 0.36, and held out, `stealth`,
`office`, `market` and markers and angles of `gait` 0.07 to 0.51, where the other of the two repairs is lower. Mirror
images and exchanged sides of sound pairs are not below 1.4, and those of 15 pairs of different takes not below 0.6. A
longer delay gives 0.32 to 0.35 where two recordings overlap by 40 %; where the motion is periodic, or the estimated
shift fits too, it is not named."""
_RIVAL_RATIO = 1.5
"""A mirror image and exchanged sides differ by less than this ratio in a symmetric motion such as walking: then either
may be the cause. Chosen by hand."""
_LEAST_OVERLAP = 0.1
"""Least overlap of two recordings at a longer delay, as a share of the shorter one. Chosen by hand."""
_LEAST_OVERLAP_S = 1.0
"""And its least duration [s]: about one stride. Chosen by hand."""
_UNIT_TOLERANCE = 0.1
"""Largest difference between the decimal logarithm of a ratio of sizes and that of two units. Two systems define joint
centres that differ in size by 5 % at most. Chosen by hand."""


@dataclass(frozen=True, eq=False, kw_only=True)
class _TriedMotion:
    second: Recording
    what: str
    """The cause, as the start of a sentence."""
    remedy: str
    shift_s: float | None


def motion_reasons(
    first: Recording, second: Recording, result: MotionComparison, *, shift_s: float | None, same_laboratory: bool
) -> tuple[VerdictReason, ...]:
    """Explain why two motions do not agree.

    Args:
        first: A motion.
        second: Another one, with the same names for the same quantities.
        result: Their comparison.
        shift_s: The given shift of the second clock [s]; None if it was estimated.
        same_laboratory: Whether both motions are in one laboratory.

    Returns:
        The cause whose repair agrees best; empty if they agree, if only their definitions of angles differ, or if
        nothing explains that they do not agree.
    """
    units = _wrong_units(result)
    if units:
        return units
    before, limit, unit = _difference(result)
    if not before > limit or definition_reasons(result):
        return ()
    found: list[tuple[float, _TriedMotion]] = []
    for tried in _repairs(first, second, shift_s):
        with suppress(MareyError):
            repaired = compare(first, tried.second, shift_s=tried.shift_s, same_laboratory=same_laboratory)
            found.append((_difference(repaired)[0], tried))
    found = sorted((each for each in found if each[0] < _LARGEST_RATIO * before), key=lambda each: each[0])
    if not found:
        return ()
    after, best = found[0]
    causes = [tried for difference, tried in found if difference < _RIVAL_RATIO * after]
    factor, name = (1e3, "mm") if unit == "m" else (np.degrees(1.0), "degrees")
    achieved = f"corrected, the motions differ by {factor * after:.1f} {name} instead of {factor * before:.1f} (RMS)"
    return (VerdictReason.failure(f"{' or '.join(each.what for each in causes)}: {achieved}.", best.remedy),)


def _difference(result: MotionComparison) -> tuple[float, float, str]:
    """Return the difference of two motions, the limit above which it is poor, and its unit: of points, or of angles."""
    apart = [row.rms for row in result.agreements if row.kind == "distance" and np.isfinite(row.rms)]
    if apart:
        return float(np.sqrt(np.mean(np.square(apart)))), _POOR_POINTS_M, "m"
    turned = [row.sd for row in result.agreements if row.kind == "angle" and np.isfinite(row.sd)]
    return (float(np.sqrt(np.mean(np.square(turned)))) if turned else float("nan")), _POOR_ANGLES, "rad"


def _wrong_units(result: MotionComparison) -> tuple[VerdictReason, ...]:
    """Name a unit of lengths or of angles that is another one in the two motions."""
    points = _size_ratio(_from_mean(result.first.points), _from_mean(result.second.points))
    power = round(np.log10(points)) if np.isfinite(points) else 0
    if power and abs(np.log10(points) - power) < _UNIT_TOLERANCE:
        what = f"The first motion is {10.0**power:g} times as large as the second: a unit of length is wrong."
        return (VerdictReason.failure(what, "Correct the unit in the file (metres, or as its format states)."),)
    angles = _size_ratio(*(_about_mean(each.angles) for each in (result.first, result.second)))
    for factor, larger, smaller in ((np.degrees(1.0), "first", "second"), (np.radians(1.0), "second", "first")):
        if np.isfinite(angles) and abs(np.log10(angles / factor)) < _UNIT_TOLERANCE:
            what = f"The angles of the {larger} motion are 57 times those of the {smaller}: degrees as radians."
            return (VerdictReason.failure(what, "Correct the unit of angles that the file states (inDegrees)."),)
    return ()


def _from_mean(points: Floats) -> Floats:
    """Return points (N, P, 3) relative to their mean in each frame [m]."""
    return np.asarray(points - points.mean(1, keepdims=True)) if points.shape[1] > 1 else np.zeros((0, 0, 3))


def _about_mean(angles: Floats) -> Floats:
    """Return angles (N, A) about their means over the frames in which all are known [rad]."""
    known = angles[np.isfinite(angles).all(1)] if angles.shape[1] else angles
    return np.asarray(known - known.mean(0)) if len(known) else np.zeros((0, 0))


def _size_ratio(first: Floats, second: Floats) -> float:
    """Return the ratio of the root mean squares of two quantities; NaN if one is unknown or 0."""
    sizes = [np.sqrt(np.nanmean(each**2)) if np.isfinite(each).any() else np.nan for each in (first, second)]
    return float(sizes[0] / sizes[1]) if sizes[1] > 0 and sizes[0] > 0 else float("nan")


def _repairs(first: Recording, second: Recording, shift_s: float | None) -> Iterator[_TriedMotion]:
    """Yield the second motion with each repair."""
    if second.point_names:
        mirrored = replace(second, points=second.points * np.array([1.0, 1.0, -1.0]))
        remedy = "Correct the sign of one axis of one of the motions."
        yield _TriedMotion(second=mirrored, what="One motion is a mirror image", remedy=remedy, shift_s=shift_s)
    exchanged = _with_exchanged_sides(second)
    if exchanged is not None:
        what, remedy = "Left and right are exchanged", "Exchange the sides in the names of one of the motions (--map)."
        yield _TriedMotion(second=exchanged, what=what, remedy=remedy, shift_s=shift_s)
    if shift_s is None:
        yield from _longer_delays(first, second)
    elif shift_s:
        what, remedy = f"The shift of {shift_s:g} s has the wrong sign", f"Give --shift {-shift_s:g}, or leave it out."
        yield _TriedMotion(second=second, what=what, remedy=remedy, shift_s=-shift_s)


def _with_exchanged_sides(recording: Recording) -> Recording | None:
    """Return a motion in which the names of left and right are exchanged; None if no name has a side."""
    lists = recording.angle_names, recording.point_names, recording.segment_names
    pairs = [side_pairs(names) for names in lists]
    if not any(pairs):
        return None
    angles, points, segments = (
        tuple(pair.get(name, name) for name in names) for names, pair in zip(lists, pairs, strict=True)
    )
    return replace(recording, angle_names=angles, point_names=points, segment_names=segments)


def _longer_delays(first: Recording, second: Recording) -> Iterator[_TriedMotion]:
    """Yield the second motion at the best shift at which the recordings overlap by less than half."""
    names = {
        "angles": [name for name in first.angle_names if name in second.angle_names],
        "points": [name for name in first.point_names if name in second.point_names],
    }
    own, other = (each.chosen(**names, segments=()) for each in (first, second))
    step = max(float(np.median(np.diff(each.time))) for each in (own, other))
    grids = [np.arange(each.time[0], each.time[-1] + 0.5 * step, step) for each in (own, other)]
    own, other = (each.at(grid) for each, grid in zip((own, other), grids, strict=True))
    n, m = len(own), len(other)
    lags = np.arange(1 - n, m)
    overlap = np.minimum(n, m - lags) - np.maximum(0, -lags)
    least = max(_LEAST_OVERLAP * min(n, m), _LEAST_OVERLAP_S / step)
    costs, _ = agreement_by_lag(
        (own.angles, other.angles), (own.points, other.points), places=True, least=max(4, int(least))
    )  # fmt: skip
    costs = np.where((overlap >= least) & (overlap < ALIGNMENT_DEFAULTS.least_overlap * min(n, m)), costs, np.inf)
    if not np.isfinite(costs).any():
        return
    best = int(np.argmin(costs))
    shift = float(other.time[0] - own.time[0] + lags[best] * step)
    what = f"The recordings overlap for {overlap[best] * step:.1f} s only, at a shift of about {shift:.2f} s"
    yield _TriedMotion(
        second=second, what=what, remedy=f"If that is so, give --shift {shift:.2f}.", shift_s=shift,
    )  # fmt: skip
