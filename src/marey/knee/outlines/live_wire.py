"""Live wire: outlines through a few anchors, between which a wire follows the clearest edge."""

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from marey.arrays import Floats, Integers, Mask, freeze_fields
from marey.errors import MareyError
from marey.knee.outlines.boundary_elements import BoundaryElements, LearnedCosts, boundary_elements, step_costs
from marey.knee.outlines.outlines import edge_image, filled
from marey.knee.outlines.wire_tree import WireTree, reversed_costs

_TREES_KEPT = 8
"""Number of trees that are cached, some megabytes each; chosen by hand."""
_FEWEST_PIXELS = 4
"""Fewest rows and columns of a slice."""
Corner = tuple[int, int]


@dataclass(frozen=True, eq=False, kw_only=True)
class ClosedWire:
    """A closed outline, counter-clockwise with rows downward and columns to the right."""

    anchors: Integers
    """(A, 2) rows and columns of corners: corner (0, 0) is the upper left one of pixel (0, 0)."""
    sides: tuple[Integers, ...]
    """(n, 2) corners from each anchor to the next, and from the last to the first, including both ends."""

    def __post_init__(self) -> None:
        freeze_fields(self, "anchors", dtype=np.int64)

    @cached_property
    def corners(self) -> Integers:
        """(N, 2) all corners in order, each once."""
        return np.concatenate([side[:-1] for side in self.sides])

    @property
    def outline(self) -> Floats:
        """(N, 2) x and y of the corners in pixels."""
        return points_of(self.corners)

    def mask(self, shape: tuple[int, int]) -> Mask:
        """Return the mask (rows, columns) of the enclosed pixels."""
        return filled(self.outline, shape)


class LiveWire:
    """The live wire of [Falcao1998] in one slice, with paths found on the fly as in [Falcao2000].

    Points are x and y in pixels, integers at the pixels' centres; the wire runs on the edges between pixels, so that an
    outline encloses whole pixels. Outlines are counter-clockwise.

    Args:
        image: (rows, columns).
        spacing_mm: Spacing of rows and of columns; the cost of a step is proportional to its length.
        learned: Costs learned from examples; without them all clear edges are equal.

    Raises:
        MareyError: The image is too small, or contains values that are not finite.
    """

    def __init__(self, image: Floats, spacing_mm: tuple[float, float], learned: LearnedCosts | None = None):
        if np.ndim(image) != 2 or min(np.shape(image)) < _FEWEST_PIXELS:
            raise MareyError(f"A slice of {' x '.join(map(str, np.shape(image)))} pixels is too small for a live wire.")
        if not np.isfinite(image).all() or not min(spacing_mm) > 0:
            raise MareyError("A slice for a live wire needs finite values, and distances above 0 between its pixels.")
        self.shape = (int(np.shape(image)[0]), int(np.shape(image)[1]))
        self.elements: BoundaryElements = boundary_elements(image, spacing_mm)
        self.edges = edge_image(image)
        """(rows, columns) the smoothed image in which `on_the_edge` finds the edge of an outline."""
        self._trees: OrderedDict[tuple[Corner, bool], WireTree] = OrderedDict()
        self._anchor: Corner | None = None
        self.learn(learned)

    def learn(self, learned: LearnedCosts | None) -> None:
        """Replace the costs; an anchor is kept."""
        self._costs = step_costs(self.elements, learned)
        self._turned = reversed_costs(self._costs)
        self.forget()

    def anchor(self, point: Sequence[float]) -> Floats:
        """Set the anchor where the wire begins, and return the point (2,) to which it snapped."""
        self._anchor = self.corner(point)
        return points_of(np.array(self._anchor))

    def path_to(self, point: Sequence[float]) -> Floats:
        """Return the wire (n, 2) from the anchor to a point; further points are fast.

        Raises:
            MareyError: No anchor was set.
        """
        if self._anchor is None:
            raise MareyError("A live wire needs an anchor first.")
        return points_of(self.side(self._anchor, self.corner(point)))

    def corner(self, point: Sequence[float]) -> Corner:
        """Return the corner next to a point; beyond the slice the nearest one on its border."""
        rows, columns = self.shape
        column, row = np.floor(np.asarray(point, float) + 1).astype(int)
        return int(np.clip(row, 0, rows)), int(np.clip(column, 0, columns))

    def side(self, start: Corner, end: Corner, *, keep_end: bool = False) -> Integers:
        """Return the corners (n, 2) of the cheapest path; the tree at its start, or at its end, is cached."""
        tree = self._tree(end if keep_end else start, keep_end)
        return tree.path(start)[::-1] if keep_end else tree.path(end)

    def cost(self, start: Corner, end: Corner, *, keep_end: bool = False) -> int:
        """Return the sum of the costs of that path."""
        tree = self._tree(end if keep_end else start, keep_end)
        return tree.cost(start if keep_end else end)

    def closed(self, points: Sequence[Sequence[float]]) -> ClosedWire:
        """Close an outline through anchors (x, y) in order, in either orientation.

        Raises:
            MareyError: There are fewer than two different anchors, or the outline encloses nothing.
        """
        corners = list(dict.fromkeys(self.corner(point) for point in points))
        if len(corners) < 2:
            raise MareyError("An outline needs at least two anchors, at different points.")
        ways = [self._round(corners), self._round(corners[::-1])]
        ways = [way for way in ways if _twice_area(way.corners) > 0] or ways
        best = min(ways, key=self._cost_of)
        if not best.mask(self.shape).any():
            raise MareyError("The outline encloses nothing: set another anchor on the far side.")
        return best

    def moved(self, wire: ClosedWire, index: int, point: Sequence[float]) -> ClosedWire:
        """Move one anchor of a closed outline: only its two sides are recomputed.

        The trees of the anchors before and after it are cached, so that it can be dragged.
        """
        corner = self.corner(point)
        anchors = [tuple(anchor) for anchor in wire.anchors.tolist()]
        before, after = anchors[index - 1], anchors[(index + 1) % len(anchors)]
        anchors[index], sides = corner, list(wire.sides)
        sides[index - 1] = self.side(before, corner)
        sides[index] = self.side(corner, after, keep_end=True)
        return ClosedWire(anchors=np.array(anchors), sides=tuple(sides))

    def forget(self) -> None:
        """Remove the cached trees, some megabytes each."""
        self._trees.clear()

    def _round(self, corners: Sequence[Corner]) -> ClosedWire:
        pairs = zip(corners, [*corners[1:], corners[0]], strict=True)
        return ClosedWire(anchors=np.array(corners), sides=tuple(self.side(*pair) for pair in pairs))

    def _cost_of(self, wire: ClosedWire) -> int:
        return sum(self.cost(tuple(side[0].tolist()), tuple(side[-1].tolist())) for side in wire.sides)

    def _tree(self, root: Corner, towards: bool) -> WireTree:
        key = (root, towards)
        if key not in self._trees:
            self._trees[key] = WireTree(self._turned if towards else self._costs, root)
            while len(self._trees) > _TREES_KEPT:
                self._trees.popitem(last=False)
        self._trees.move_to_end(key)
        return self._trees[key]


def points_of(corners: Integers) -> Floats:
    """Return x and y (..., 2) in pixels of the rows and columns of corners."""
    return corners[..., ::-1] - 0.5


def _twice_area(corners: Integers) -> int:
    """Return twice the enclosed area, positive if counter-clockwise."""
    row, column = corners.T
    return int(np.sum(row * np.roll(column, -1) - np.roll(row, -1) * column))
