"""Outlines drawn in slices with the live wire, and edited by their anchors."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from marey.arrays import Floats, Integers
from marey.errors import MareyError
from marey.knee.outlines.contours import Contour
from marey.knee.outlines.live_wire import LiveWire, points_of
from marey.knee.outlines.outlines import on_the_edge

_FEWEST = 2
"""Fewest anchors of an outline."""


def drawn(wire: LiveWire, points: Sequence[Sequence[float]], *, structure: str, axis: str, index: int) -> Contour:
    """Close an outline through anchors, and move it to where the edge is steepest.

    Args:
        wire: Live wire of the slice.
        points: x and y [px] of the anchors in order, in either orientation.
        structure: Name of the outlined structure.
        axis: One of `AXES`.
        index: Index of the slice.

    Raises:
        MareyError: As `LiveWire.closed`.
    """
    closed = wire.closed(points)
    outline = on_the_edge(closed.outline, wire.edges)
    return Contour(structure=structure, axis=axis, index=index, anchors=points_of(closed.anchors), outline=outline)


def anchor_moved(contour: Contour, wire: LiveWire, number: int, point: Sequence[float]) -> Contour:
    """Move an anchor: only the outline to the anchors before and after it is recomputed."""
    anchors = contour.anchors.copy()
    count = len(anchors)
    anchors[number] = points_of(np.array(wire.corner(point)))
    before, after = (wire.corner(anchors[each % count]) for each in (number - 1, number + 1))
    corner = wire.corner(point)
    sides = [wire.side(before, corner), wire.side(corner, after, keep_end=True)]
    return _spliced(contour, wire, sides, (number - 1) % count, (number + 1) % count, anchors)


def anchor_inserted(contour: Contour, wire: LiveWire, point: Sequence[float]) -> tuple[Contour, int]:
    """Insert an anchor where an outline is nearest to a point, without changing its course; return its number too."""
    places = anchor_places(contour)
    place = int(np.argmin(np.linalg.norm(contour.outline - np.asarray(point, float), axis=1)))
    steps = (places - places[0]) % len(contour.outline)
    number = int(np.searchsorted(steps, (place - places[0]) % len(contour.outline), side="right"))
    anchor = points_of(np.array(wire.corner(contour.outline[place])))
    return replace(contour, anchors=np.insert(contour.anchors, number, anchor, axis=0)), number


def anchor_removed(contour: Contour, wire: LiveWire, number: int) -> Contour:
    """Remove an anchor: the wire then connects the anchors before and after it.

    Raises:
        MareyError: Fewer than two anchors would remain.
    """
    count = len(contour.anchors)
    if count <= _FEWEST:
        raise MareyError("An outline needs at least two anchors: remove the whole outline instead.")
    ends = (number - 1) % count, (number + 1) % count
    side = wire.side(*(wire.corner(contour.anchors[each]) for each in ends))
    return _spliced(contour, wire, [side], *ends, np.delete(contour.anchors, number, axis=0))


def anchor_places(contour: Contour) -> Integers:
    """(A,) index of the point of the outline nearest to each anchor."""
    apart = np.linalg.norm(contour.outline - contour.anchors[:, None], axis=2)
    return np.asarray(np.argmin(apart, axis=1), np.int64)


def _in_order(places: Integers) -> bool:
    """Return whether indices increase around the outline, with one wrap."""
    return int((np.diff(np.append(places, places[0])) < 0).sum()) <= 1


def _spliced(
    contour: Contour, wire: LiveWire, sides: Sequence[Integers], start: int, end: int, anchors: Floats
) -> Contour:
    """Replace the part of an outline from one anchor to another by new sides."""
    if not _in_order(anchor_places(contour)):
        # In a sheet so thin that an anchor is nearest to its other side, the parts cannot be distinguished.
        fresh = drawn(wire, anchors.tolist(), structure=contour.structure, axis=contour.axis, index=contour.index)
        return replace(fresh, anchors=anchors)
    new = points_of(np.concatenate([*(side[:-1] for side in sides), sides[-1][-1:]]))
    places = anchor_places(contour)
    if start == end:
        kept = np.zeros((0, 2))
    else:
        # From the anchor after the new part, around to the one before it.
        count = (places[start] - places[end]) % len(contour.outline)
        kept = contour.outline[(places[end] + np.arange(1, count)) % len(contour.outline)]
    whole = on_the_edge(np.concatenate([new, kept]), wire.edges)
    return replace(contour, anchors=anchors, outline=np.concatenate([whole[: len(new)], kept]))
