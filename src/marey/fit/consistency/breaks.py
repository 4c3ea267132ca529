"""A camera whose pictures agree with those of the others in one part of a take only.

Pictures are lost while a camera records, two recordings are joined in one file, or the camera is knocked during the
take: its silhouettes agree with those of all others before an instant and contradict them after it, or the other way
round, while the others agree among themselves all the time.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Floats
from marey.cameras.camera import Camera
from marey.fit.consistency.cut_outlines import cut_cameras
from marey.fit.consistency.explanations import CLEARLY_SMALLER, CONTRADICTION_PX, ShownOutlines
from marey.fit.consistency.tangents import LARGEST_DIFFERENCE_PX, differences_px

LEAST_PART = 5
"""Least number of compared frames in each part. Chosen by hand."""


@dataclass(frozen=True, kw_only=True)
class Break:
    """Where the pictures of one camera begin or cease to agree with those of the others."""

    number: int
    """The camera."""
    first: int
    """Index of the first compared frame of the second part."""
    after: bool
    """Whether the second part contradicts the other cameras; otherwise the first part does."""
    level_px: float
    """Least median difference of the camera's pairs in the contradicting part [px]."""
    delay: int = 0
    """Number of frames by which the pictures of that part are late; 0 if no delay explains it."""


def find_break(
    cameras: Sequence[Camera], frames: Sequence[int], shown: ShownOutlines, *, longest_delay: int = 0
) -> Break | None:
    """Find a camera that contradicts all others in one part of a take, and agrees with them in the other.

    With two cameras only, it is unknown which of them has changed, and none is returned. None is returned either if one
    delay explains all of the take, or if something in front of the person may explain the contradicting part.

    Args:
        cameras: C cameras.
        frames: F compared frames, in their order.
        shown: The outlines in these frames.
        longest_delay: Largest delay of the contradicting part that is tried [frames].

    Returns:
        The break with the largest contradiction; None if there is none.
    """
    outlines = [shown(c) for c in range(len(cameras))]
    found = differences_px(cameras, outlines)
    tried = [_break_of(c, found) for c in range(len(cameras))]
    best = max((each for each in tried if each is not None), key=lambda each: each.level_px, default=None)
    if best is None:
        return None
    wrong = np.arange(len(frames)) >= best.first
    wrong = wrong if best.after else ~wrong
    if cut_cameras({pair: each[wrong] for pair, each in found.items()}):
        return None
    return _with_delay(best, wrong, cameras, np.asarray(frames), shown, longest_delay)


def _break_of(camera: int, found: Mapping[tuple[int, int], Floats]) -> Break | None:
    """Return the break of one camera, if its pairs contradict in one part, and no pair does otherwise."""
    own = {pair: each for pair, each in found.items() if camera in pair}
    others = {pair: each for pair, each in found.items() if camera not in pair}
    if len(own) < 2 or not others:
        return None
    first = _change(np.array([_sizes(each) for each in own.values()]))
    if first is None:
        return None
    parts = slice(first), slice(first, None)
    before, after = (np.array([_median(each[part]) for each in own.values()]) for part in parts)
    low, high = (before, after) if before.min() < after.min() else (after, before)
    rest = np.max([_median(each[part]) for each in others.values() for part in parts])
    # A pair that is unknown in one part makes its level NaN, and nothing is concluded.
    clear = low.max() <= CONTRADICTION_PX < high.min() and high.min() > CLEARLY_SMALLER * low.max()
    if not clear or not rest <= CONTRADICTION_PX:
        return None
    wrong = parts[1] if high is after else parts[0]
    if not any(_moves(each[wrong]) for each in own.values()):
        return None
    return Break(number=camera, first=first, after=high is after, level_px=float(high.min()))


def _change(sizes: Floats) -> int | None:
    """Return where the median of P pairs' differences (P, F) begins or ceases to be a contradiction.

    Two constant levels are no model of it: the difference grows with the speed of the motion.
    """
    with np.errstate(all="ignore"):
        series = np.full(sizes.shape[1], np.nan)
        known = np.isfinite(sizes).any(axis=0)
        series[known] = np.nanmedian(sizes[:, known], axis=0)
    where = np.flatnonzero(np.isfinite(series))
    if len(where) < 2 * LEAST_PART:
        return None
    large = series[where] > CONTRADICTION_PX
    ends = np.arange(LEAST_PART, len(large) - LEAST_PART + 1)
    before = np.cumsum(large)[ends - 1]
    wrong = before + np.count_nonzero(~large) - (ends - before)
    return int(where[ends[np.argmin(np.minimum(wrong, len(large) - wrong))]])


def _sizes(difference: Floats) -> Floats:
    """Return the larger one of the two differences (F, 2) of each frame; NaN where none is known [px]."""
    sizes = np.minimum(np.abs(difference), LARGEST_DIFFERENCE_PX)
    return np.asarray(np.fmax(sizes[:, 0], sizes[:, 1]))


def _moves(difference: Floats) -> bool:
    """Return whether both ends (F, 2) of a silhouette are elsewhere: what cuts or adds to it changes one of them."""
    return all(_median(end) > CONTRADICTION_PX for end in difference.T)


def _median(difference: Floats) -> float:
    """Return the median of differences [px]; NaN if too few are known."""
    known = np.abs(difference[np.isfinite(difference)])
    return float(np.median(np.minimum(known, LARGEST_DIFFERENCE_PX))) if len(known) >= LEAST_PART else float("nan")


def _with_delay(
    found: Break, wrong: np.ndarray, cameras: Sequence[Camera], frames: np.ndarray, shown: ShownOutlines, longest: int
) -> Break | None:
    """Add the delay that explains the contradicting part; return None if it explains the other part as well."""
    outlines = [shown(c) for c in range(len(cameras))]
    levels = {}
    for delay in (each for each in range(-longest, longest + 1) if each):
        outlines[found.number] = shown(found.number, delay)
        again = differences_px(cameras, outlines, [found.number]).values()
        own = frames + delay
        # Pictures of the other part of this camera show other instants.
        inside = wrong & (own >= frames[found.first] if found.after else own < frames[found.first])
        levels[delay] = tuple(
            np.max([_median(each[part]) for each in again], initial=0.0) if again else np.nan
            for part in (inside, ~wrong)
        )
    known = {delay: level for delay, level in levels.items() if level[0] <= CONTRADICTION_PX}
    if not known:
        return found
    best = min(known, key=lambda delay: known[delay][0])
    return None if known[best][1] <= CONTRADICTION_PX else replace(found, delay=best)
