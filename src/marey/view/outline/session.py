"""State of the page of `marey knee outline`: slices, live wires, and stored and interpolated outlines."""

from collections import OrderedDict
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from threading import RLock
from typing import Any

import numpy as np

from marey.arrays import Floats, Integers
from marey.errors import FileProblem, MareyError
from marey.io.mr.contours import read_contours, same_grid, write_contours
from marey.knee.outlines.boundary_elements import BoundaryElements, LearnedCosts, boundary_elements, learned_costs
from marey.knee.outlines.contours import (
    AXES,
    Contour,
    outlined_mask,
    slice_count,
    slice_distance,
    slice_of,
    slice_shape,
    slice_spacing_mm,
)
from marey.knee.outlines.live_wire import Corner, LiveWire, points_of
from marey.knee.outlines.outlining import anchor_inserted, anchor_moved, anchor_removed, drawn
from marey.knee.space.structures import LABELS
from marey.knee.space.volume import Volume
from marey.view.pictures.knee_maps import STRUCTURE_COLOURS
from marey.view.pictures.slice_display import displayed

_WIRES_KEPT = 4
"""Number of slices whose live wires are kept in memory. Chosen by hand."""
_EXAMPLE_SLICES = 3
"""Number of outlined slices, the nearest ones, from which the edge costs of a structure are learned. Chosen by hand."""
_UNDO_LIMIT = 100
"""Number of changes that can be undone. Chosen by hand."""
_LARGEST_GREY = 65535
"""Largest grey value of 16 bits, sent for the maximum of the volume."""
_ACCEPTED_ANCHORS = 8
"""Number of anchors of an accepted interpolated outline, which must have more points. Chosen by hand."""
Reply = dict[str, Any]


class OutlineSession:
    """One volume, its outlines, and the live wire in the displayed slice.

    Args:
        volume: The volume to outline.
        path: The file of the outlines; read if it exists, and written after each change.
        name: Name of the volume, for the file and the page.

    Raises:
        FileProblem: The file is damaged or belongs to another volume.
    """

    def __init__(self, volume: Volume, path: Path, name: str):
        self.volume, self.path, self.name = volume, path, name
        self.contours: tuple[Contour, ...] = ()
        if path.exists():
            kept = read_contours(path)
            if not same_grid(kept.grid, volume.grid):
                raise FileProblem(
                    path, f"has the outlines of another volume than {name}", "Choose another file (--out)."
                )
            self.contours = kept.contours
        self._version = 0
        self._before: list[tuple[Contour, ...]] = []
        self._wires: OrderedDict[tuple[str, int], LiveWire] = OrderedDict()
        self._examples: dict[tuple[str, int], tuple[str, tuple[Contour, ...]]] = {}
        self._sides: dict[tuple[Corner, Corner], tuple[Integers, int]] = {}
        self._current: tuple[str, int, str, int] | None = None
        self._lock = RLock()
        low, high = float(volume.intensity.min()), float(volume.intensity.max())
        self._range = low, max(high, low + 1e-6)

    def about(self) -> Reply:
        """Return the properties of the volume that the page needs at its start."""
        grid = self.volume.grid
        window = np.percentile(self.volume.intensity, [1.0, 99.5])
        views = {axis: displayed(grid, axis) for axis in AXES}
        count = {axis: slice_count(grid, axis) for axis in AXES}
        thickest = AXES[int(np.argmax(grid.spacing_mm))]
        return {
            "name": self.name, "file": str(self.path), "structures": list(LABELS),
            "colours": STRUCTURE_COLOURS, "axes": views, "counts": count,
            "axis": self.contours[-1].axis if self.contours else thickest, "range": self._range,
            "index": self.contours[-1].index if self.contours else count[thickest] // 2, "window": window.tolist(),
        }  # fmt: skip

    def greys(self, axis: str, index: int) -> bytes:
        """Return a slice by rows as little-endian 16-bit numbers, scaled to the range of the volume."""
        self._check(axis, index)
        low, high = self._range
        part = slice_of(self.volume.intensity, axis, index)
        return np.rint((part - low) / (high - low) * _LARGEST_GREY).astype("<u2").tobytes()

    def state(self, axis: str, index: int) -> Reply:
        """Return the outlines in a slice, and the outlined slices of each structure."""
        self._check(axis, index)
        with self._lock:
            here = [(n, each) for n, each in enumerate(self.contours) if (each.axis, each.index) == (axis, index)]
            slices = {name: sorted({each.index for each in self.contours if each.structure == name}) for name in LABELS}
            axes = {each.structure: each.axis for each in self.contours}
            return {
                "version": self._version,
                "contours": [_contour_reply(number, each) for number, each in here],
                "slices": {name: found for name, found in slices.items() if found},
                "axes": axes,
                "undo": bool(self._before),
            }

    def interpolated(self, axis: str, index: int) -> Reply:
        """Return the outlines by structure that are interpolated in a slice between outlined ones."""
        self._check(axis, index)
        found = {}
        contours = self.contours
        for structure in LABELS:
            own = [each for each in contours if each.structure == structure]
            if not own or own[0].axis != axis or any(each.index == index for each in own):
                continue
            distance = slice_distance(own, self.volume.grid, structure, index)
            if distance is not None:
                found[structure] = _level_lines(distance)
        return found

    def prepare(self, axis: str, index: int, structure: str) -> Reply:
        """Compute the live wire of a slice in advance, so that the pointer is followed without delay."""
        with self._lock:
            self._wire(axis, index, structure)
            return {}

    def wire(
        self, axis: str, index: int, structure: str, anchors: Sequence[Sequence[float]], pointer: Sequence[float]
    ) -> Reply:
        """Return the live wire through the anchors to the pointer, in the direction with the lower cost."""
        with self._lock:
            wire = self._wire(axis, index, structure)
            corners = [wire.corner(anchor) for anchor in anchors]
            end = wire.corner(pointer)
            sides = [self._side(wire, *pair) for pair in pairwise(corners)]
            turned = [self._side(wire, *pair[::-1]) for pair in pairwise(corners)]
            there = sum(cost for _, cost in sides) + wire.cost(corners[-1], end)
            back = sum(cost for _, cost in turned) + wire.cost(end, corners[-1], keep_end=True)
            if there <= back:
                fixed, live = [side for side, _ in sides], wire.side(corners[-1], end)
            else:
                fixed = [side[::-1] for side, _ in turned]
                live = wire.side(end, corners[-1], keep_end=True)[::-1]
            done = [points_of(side).tolist() for side in fixed]
            return {"fixed": [point for side in done for point in side], "live": points_of(live).tolist(),
                    "anchors": points_of(np.array(corners)).tolist()}  # fmt: skip

    def close(self, axis: str, index: int, structure: str, anchors: Sequence[Sequence[float]]) -> Reply:
        """Close an outline and store it.

        Raises:
            MareyError: There are too few anchors, the outline is empty, or the structure is outlined across another
                axis.
        """
        with self._lock:
            self._one_axis(structure, axis)
            wire = self._wire(axis, index, structure)
            contour = drawn(wire, anchors, structure=structure, axis=axis, index=index)
            return self._keep((*self.contours, contour), axis, index)

    def move(self, version: int, number: int, anchor: int, point: Sequence[float], keep: bool) -> Reply:
        """Move an anchor of an outline, and store the change or only return it."""

        def changed(contour: Contour, wire: LiveWire) -> Contour:
            return anchor_moved(contour, wire, anchor, point)

        return self._change(version, number, changed, keep)

    def insert(self, version: int, number: int, point: Sequence[float]) -> Reply:
        """Insert an anchor in an outline; its number is returned as `anchor`."""
        with self._lock:
            found: list[int] = []

            def changed(contour: Contour, wire: LiveWire) -> Contour:
                more, place = anchor_inserted(contour, wire, point)
                found.append(place)
                return more

            return self._change(version, number, changed, True) | {"anchor": found[0]}

    def remove_anchor(self, version: int, number: int, anchor: int) -> Reply:
        """Remove an anchor."""
        return self._change(version, number, lambda contour, wire: anchor_removed(contour, wire, anchor), True)

    def remove(self, version: int, number: int) -> Reply:
        """Remove an outline."""
        with self._lock:
            contour = self._numbered(version, number)
            rest = tuple(each for each in self.contours if each is not contour)
            return self._keep(rest, contour.axis, contour.index)

    def accept(self, axis: str, index: int, structure: str) -> Reply:
        """Store the interpolated outlines of a structure.

        Raises:
            MareyError: There are no interpolated outlines.
        """
        with self._lock:
            outlines = self.interpolated(axis, index).get(structure, [])
            if not outlines:
                raise MareyError("This slice has no interpolated outline. Outline a slice on either side first.")
            made = [_accepted(np.array(each), structure, axis, index) for each in outlines]
            return self._keep((*self.contours, *made), axis, index)

    def undo(self, axis: str, index: int) -> Reply:
        """Undo the last change."""
        with self._lock:
            if self._before:
                before = self._before.pop()
                write_contours(self.path, before, self.volume.grid, self.name)
                self.contours, self._version = before, self._version + 1
            return self.state(axis, index)

    def _change(self, version: int, number: int, changed: Callable[[Contour, LiveWire], Contour], keep: bool) -> Reply:
        with self._lock:
            old = self._numbered(version, number)
            new = changed(old, self._wire(old.axis, old.index, old.structure))
            if not keep:
                return {"contour": _contour_reply(number, new)}
            kept = tuple(new if each is old else each for each in self.contours)
            return self._keep(kept, old.axis, old.index)

    def _keep(self, contours: tuple[Contour, ...], axis: str, index: int) -> Reply:
        write_contours(self.path, contours, self.volume.grid, self.name)
        self._before = [*self._before, self.contours][-_UNDO_LIMIT:]
        self.contours, self._version = contours, self._version + 1
        return self.state(axis, index)

    def _numbered(self, version: int, number: int) -> Contour:
        if version != self._version or not 0 <= number < len(self.contours):
            raise MareyError("The outlines have been changed, perhaps in another window. Reload the page.")
        return self.contours[number]

    def _one_axis(self, structure: str, axis: str) -> None:
        other = {each.axis for each in self.contours if each.structure == structure} - {axis}
        if other:
            raise MareyError(
                f"The {structure.replace('_', ' ')} is outlined in slices across {other.pop()}. Continue there, or"
                " remove those outlines first."
            )

    def _check(self, axis: str, index: int) -> None:
        if axis not in AXES or not 0 <= index < slice_count(self.volume.grid, axis):
            raise MareyError(f"There is no slice {index} across {axis}.")

    def _wire(self, axis: str, index: int, structure: str) -> LiveWire:
        """Return the live wire of a slice, with costs learned from the nearest outlines of the structure."""
        self._check(axis, index)
        if structure not in LABELS:
            raise MareyError(f"The structure '{structure}' is unknown. The structures are {', '.join(LABELS)}.")
        current = (axis, index, structure, self._version)
        wire = self._wires.get((axis, index))
        if wire is not None and self._current == current:
            return wire
        if wire is None:
            part = slice_of(self.volume.intensity, axis, index)
            wire = LiveWire(part, slice_spacing_mm(self.volume.grid, axis))
            self._wires[axis, index] = wire
        examples = self._nearest_outlines(axis, index, structure)
        learned_from = structure, examples
        if self._examples.get((axis, index), (structure, ())) != learned_from:
            wire.learn(self._learned(examples, axis))
        self._examples[axis, index] = learned_from
        self._sides.clear()
        self._current = current
        self._release_others(axis, index)
        return wire

    def _release_others(self, axis: str, index: int) -> None:
        self._wires.move_to_end((axis, index))
        while len(self._wires) > _WIRES_KEPT:
            old, _ = self._wires.popitem(last=False)
            self._examples.pop(old, None)
        for place, each in self._wires.items():
            if place != (axis, index):
                each.forget()

    def _nearest_outlines(self, axis: str, index: int, structure: str) -> tuple[Contour, ...]:
        own = [each for each in self.contours if (each.structure, each.axis) == (structure, axis)]
        nearest = sorted({each.index for each in own} - {index}, key=lambda each: abs(each - index))[:_EXAMPLE_SLICES]
        return tuple(each for each in own if each.index in nearest)

    def _learned(self, outlines: Sequence[Contour], axis: str) -> LearnedCosts | None:
        shape = slice_shape(self.volume.grid, axis)
        examples = []
        for index in sorted({each.index for each in outlines}):
            mask = outlined_mask([each for each in outlines if each.index == index], shape)
            examples.append((self._elements(axis, index), mask))
        return learned_costs(examples)

    def _elements(self, axis: str, index: int) -> BoundaryElements:
        if (axis, index) in self._wires:
            return self._wires[axis, index].elements
        spacing = slice_spacing_mm(self.volume.grid, axis)
        return boundary_elements(slice_of(self.volume.intensity, axis, index), spacing)

    def _side(self, wire: LiveWire, start: Corner, end: Corner) -> tuple[Integers, int]:
        if (start, end) not in self._sides:
            self._sides[start, end] = wire.side(start, end), wire.cost(start, end)
        return self._sides[start, end]


def _level_lines(distance: Floats) -> list[list[list[float]]]:
    from skimage.measure import find_contours

    lines = find_contours(np.pad(distance, 1, constant_values=-1.0), 0.0)
    return [(line[:-1, ::-1] - 1).round(2).tolist() for line in lines if len(line) > _ACCEPTED_ANCHORS]


def _accepted(outline: Floats, structure: str, axis: str, index: int) -> Contour:
    # Counterclockwise, like the live wire.
    x, y = outline.T
    if np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) > 0:
        outline = outline[::-1]
    places = np.linspace(0, len(outline), _ACCEPTED_ANCHORS, endpoint=False).astype(int)
    return Contour(structure=structure, axis=axis, index=index, anchors=outline[places], outline=outline)


def _contour_reply(number: int, contour: Contour) -> Reply:
    return {
        "number": number,
        "structure": contour.structure,
        "anchors": contour.anchors.round(2).tolist(),
        "outline": contour.outline.round(2).tolist(),
    }
