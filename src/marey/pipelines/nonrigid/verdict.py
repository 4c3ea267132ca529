"""The verdict on recovered shapes: what the tracks do not determine, and standard deviations beside sizes."""

from collections.abc import Iterator, Sequence

import numpy as np

from marey.arrays import Mask
from marey.nonrigid.core.track_checks import RIGID
from marey.nonrigid.in_space.factorisation import RIGID_POINTS
from marey.nonrigid.many_cameras.view_checks import UNRELIABLE
from marey.nonrigid.recovered import HELD_SIZE, RecoveredShapes
from marey.pipelines.verdict import Verdict, VerdictReason, without_result

_PLAIN = (RIGID, RIGID_POINTS, HELD_SIZE.partition("{")[0])
"""Beginnings of the notes that describe a result and do not limit it."""


def shapes_verdict(
    found: RecoveredShapes, wanted: Mask, matching: Sequence[str] = (), causes: Sequence[VerdictReason] = ()
) -> Verdict:  # fmt: skip
    """Return the verdict on recovered shapes.

    Args:
        found: The shapes of all F frames and P points; NaN where there is no result.
        wanted: (F,) true for the frames that were to be used.
        matching: What limits the correspondence of the points between cameras, one sentence each.
        causes: What is probably wrong in the given tracks.
    """
    limits = map(VerdictReason.limit, matching)
    return Verdict.of([*causes, *_missing(found, wanted), *limits, *_noted(found), *_sizes(found)])


def _missing(found: RecoveredShapes, wanted: Mask) -> Iterator[VerdictReason]:
    empty = int((wanted & ~found.answered).sum())
    remedy = "Follow more points, or leave these frames out (--frames)."
    yield from without_result(empty, int(wanted.sum()), "have too few points and no result", remedy)
    lost = ~np.isfinite(found.basis[0]).all(0)
    if lost.any():
        what = f"{int(lost.sum())} of {len(lost)} points are seen in too few frames and have no result."
        yield VerdictReason.limit(what, "Leave them out (--only), or follow them longer.")


def _noted(found: RecoveredShapes) -> Iterator[VerdictReason]:
    """Name what the factorisation itself has found to be undetermined or contradictory."""
    for note in found.notes:
        if not note.startswith(_PLAIN):
            yield VerdictReason.failure(note) if UNRELIABLE in note else VerdictReason.limit(note)


def _sizes(found: RecoveredShapes) -> Iterator[VerdictReason]:
    """Compare the stated standard deviation of a point with the size of the object, and with its deformation."""
    sd = float(np.nanmedian(np.sqrt((found.shape_sd**2).sum(1))))
    radius = float(np.sqrt(np.nanmean((found.basis[0] ** 2).sum(0))))
    known = found.shape[found.answered][:, :, np.isfinite(found.basis[0]).all(0)]
    moved = float(np.sqrt(np.nanmean(((known - np.nanmean(known, axis=0)) ** 2).sum(1))))
    stated = f"The standard deviation of a point is {found.length_text(sd)} (median)"
    if sd > radius:
        what = f"{stated}, more than half the size of the object, {found.length_text(2 * radius)}."
        yield VerdictReason.failure(what, "Film the object from more sides, or give more points and frames.")
    elif found.basis_shapes > 1 and sd > moved:
        what = f"{stated}, more than its deformation, {found.length_text(moved)} (RMS): only the mean shape is known."
        yield VerdictReason.limit(what, "Give more points or frames, or a second camera.")
