"""Contradictions between cameras that something in front of the person explains.

What hides a part of the person moves one of the two outermost planes that a camera finds, and always inwards: a camera
with another direction, place, focal length or clock moves both of them, or now inwards and now outwards.
"""

from collections.abc import Mapping

import numpy as np

from marey.arrays import Floats
from marey.fit.consistency.explanations import CONTRADICTION_PX

LEAST_CUT_PX = 8.0
"""Least median difference at one end of one pair of cameras that is explained [px]. With 4, a camera of `stealth` that
is 4 frames late is taken for one with something in front."""
MOST_OUTWARD = 0.1
"""Largest share of the frames in which a cut outline may lie outside of that of the other camera. Of 768 faults planted
in the first silhouettes of four rendered takes (cameras turned by 1 to 5 degrees, with another focal length, or up to
30 frames late), two changes of a camera of `reach` are taken for something in front. Other values were not measured."""


def cut_cameras(differences: Mapping[tuple[int, int], Floats]) -> tuple[int, ...]:
    """Return the cameras in which something hides a part of the person, if that explains all contradictions.

    At least two cameras must be without such a thing: otherwise it might be the last one that is wrong.

    Args:
        differences: By pair of cameras, the differences (F, 2) of their outermost planes, see `differences_px` [px].

    Returns:
        The numbers of the cameras; none if something else is wrong, or nothing.
    """
    cut, undecided, largest = set[int](), list[tuple[int, int]](), 0.0
    for pair, difference in differences.items():
        known = [np.abs(each[np.isfinite(each)]) for each in difference.T]
        sizes = [float(np.median(each)) if len(each) else 0.0 for each in known]
        if min(sizes) > CONTRADICTION_PX:
            return ()
        if max(sizes) <= CONTRADICTION_PX:
            continue
        end, largest = int(np.argmax(sizes)), max(largest, *sizes)
        inner = _inner_cameras(pair, difference[:, end] if end == 0 else -difference[:, end])
        cut.update(inner)
        undecided += [] if inner else [pair]
    explained = all(set(pair) <= cut for pair in undecided) and largest >= LEAST_CUT_PX
    clear = {c for pair in differences for c in pair} - cut
    return tuple(sorted(cut)) if explained and len(clear) >= 2 else ()


def _inner_cameras(pair: tuple[int, int], inward: Floats) -> tuple[int, ...]:
    """Return which camera of a pair has the inner outline in nearly all frames; none if neither has.

    Args:
        pair: The cameras.
        inward: (F,) by how much the first one's plane is inside of the second one's; NaN where that is not known [px].
    """
    known = inward[np.isfinite(inward)]
    if np.mean(known < -CONTRADICTION_PX) <= MOST_OUTWARD:
        return pair[:1]
    return pair[1:] if np.mean(known > CONTRADICTION_PX) <= MOST_OUTWARD else ()
