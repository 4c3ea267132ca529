"""Causes of tracks that jump, each tested by trying its repair."""

from collections.abc import Sequence

import numpy as np

from marey.arrays import Floats, Integers
from marey.nonrigid.core.track_faults import ALL_BY_NAME, TrackFault, track_faults
from marey.pipelines.verdict import VerdictReason
from marey.view.pages.problems import frames_text
from marey.wording import count_of, listed

_MOST_NAMED = 6
"""Largest number of points that a sentence names; chosen by hand."""
_MOST_ZEROS = 0.01
"""Share of the places above which zeros make a result not usable; chosen by hand. Fewer are named as a limit."""


def track_reasons(
    places: Floats, frames: Integers, labels: Sequence[str], *, views: int = 1, unit: str = ""
) -> tuple[VerdictReason, ...]:  # fmt: skip
    """Explain jumps of given tracks by what is probably wrong in their file.

    Args:
        places: (F, K, P) coordinates of P points, those of all views one after the other; NaN where a point is missing.
        frames: (F,) numbers of the frames.
        labels: P names.
        views: Number of views.
        unit: Unit of the coordinates, for the sentences.

    Returns:
        One reason per fault, with how much its repair explains; the tracks are not changed.
    """
    if len(places) < 4:
        return ()
    count = len(places) * places.shape[2] * views
    return tuple(
        _reason(fault, frames, labels, unit, places=count) for fault in track_faults(places, views=views)
    )  # fmt: skip


def _reason(
    fault: TrackFault, frames: Integers, labels: Sequence[str], unit: str, *, places: int
) -> VerdictReason:  # fmt: skip
    """Describe a fault with what its repair achieves."""
    change = " ".join(f"{fault.after:.3g} instead of {fault.before:.3g} {unit}".split())
    shown = _frames(fault, frames)
    points = listed([labels[p] for p in fault.points], most=_MOST_NAMED)
    if fault.kind == "zeros":
        what = (
            f"{count_of(fault.count, 'place')} of the points {points}: exactly zero, far from where the points are "
            "otherwise. Missing places were probably written as zeros; without them the largest step between frames is "
            f"{change}."
        )
        make = VerdictReason.failure if fault.count > _MOST_ZEROS * places else VerdictReason.limit
        return make(what, "Write NaN where a point is missing.", cause="zeros")
    if fault.kind == "repeated":
        what = f"{shown}: all points are exactly where they are in the frame before."
        return VerdictReason.limit(what, "Leave them out, and check the frame rate.", cause="repeated frames")
    if fault.kind == "order" and fault.count == ALL_BY_NAME:
        what = (
            "The frames are in the order of names without leading zeros (1, 10, 11, 2): in the order of their numbers, "
            f"the steps between them add up to {change}."
        )
        return VerdictReason.failure(what, "Sort the frames by their numbers.", cause="order of frames")
    if fault.kind == "order":
        what = f"{shown}: not in the order of the motion. In another place the steps beside them add up to {change}."
        return VerdictReason.limit(what, "Put them in the right order.", cause="order of frames")
    first = int(frames[fault.frames[0]])
    what = (
        f"The tracks of the points {points} are exchanged from frame {first} on: exchanged back, "
        f"they are {change} from where the frames before lead."
    )
    return VerdictReason.limit(what, "Exchange them in the file.", cause="exchanged tracks")


def _frames(fault: TrackFault, frames: Integers) -> str:
    chosen = np.zeros(int(frames.max()) + 1, bool)
    chosen[frames[list(fault.frames)]] = True
    text = frames_text(chosen)
    return text[:1].upper() + text[1:]
