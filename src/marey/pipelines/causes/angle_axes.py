"""Joint angles that two motions define by different axes of the segments."""

from collections.abc import Iterable

import numpy as np

from marey.motion.anatomical import segments_of_angle
from marey.motion.comparison import WITHOUT_MEAN, Agreement, MotionComparison
from marey.pipelines.verdict import VerdictReason
from marey.wording import listed

_MOST_BY_ORIENTATIONS = 2.0
"""Largest standard deviation of the differences of an angle that the segments' orientations explain, as a multiple of
theirs. Equal axes give at most 1, divided by the cosine of the adduction. Chosen by hand."""
_LEAST_BY_DEFINITION = float(np.radians(5))
"""Least standard deviation of the differences of an angle that counts as one of definition [rad]. Chosen by hand."""
_MOST_APART = float(np.radians(10))
"""Largest difference of the orientations of a segment (RMS without constant offset) at which they agree [rad]. Chosen
by hand."""
_MOST_NAMES = 8
"""Names that a sentence lists at most."""


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
        agree = max(parent, child) < _MOST_APART
        if agree and max(row.sd for row in rows) > max(explained, _LEAST_BY_DEFINITION):
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
