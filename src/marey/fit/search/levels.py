"""Silhouettes of a frame, reduced to one size of the images for speed."""

from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from threading import Lock

import cv2
import numpy as np
from numpy.typing import NDArray

from marey.arrays import Floats, Image, Integers, Mask
from marey.cameras.camera import Camera
from marey.images.silhouettes.contours import SilhouetteContour, trace_contour
from marey.images.silhouettes.interior import InteriorEdges
from marey.observations.correspondence import ObservedOutline

_PIXEL_BYTES = 160
"""Memory per contour pixel for its position, normal, plane, scale and cell [bytes]."""
_EDGE_BYTES = 56
"""Memory per pixel of the edges inside a silhouette for its position, normal, limb and cell [bytes]."""


@dataclass(frozen=True, eq=False)
class SilhouetteLevel:
    """One frame's silhouettes at one size of the images."""

    cameras: tuple[Camera, ...]
    masks: tuple[Mask, ...]
    sightings: tuple[ObservedOutline, ...]
    hidden: tuple[Mask, ...] | None = None
    """Where something hides the person; None if it is not known."""

    @staticmethod
    def of(cameras: Sequence[Camera], masks: Sequence[Mask], factor: float) -> "SilhouetteLevel":
        """Reduce silhouettes and cameras by a factor."""
        small = tuple(camera.scaled(factor) for camera in cameras)
        return SilhouetteLevel.at_size(
            small, [shrink(mask, camera.size) for mask, camera in zip(masks, small, strict=True)]
        )

    @staticmethod
    def at_size(
        cameras: Sequence[Camera],
        masks: Sequence[Mask],
        edges: Sequence[InteriorEdges] | None = None,
        hidden: Sequence[Mask] | None = None,
    ) -> "SilhouetteLevel":
        """Trace silhouettes that already have their cameras' size.

        Args:
            cameras: C cameras.
            masks: C silhouettes (height, width).
            edges: Edges inside each silhouette, if they are known.
            hidden: Regions (height, width) in which something hides the person, if they are known.
        """
        inside: Sequence[InteriorEdges | None] = edges or [None] * len(masks)
        covered: Sequence[Mask | None] = hidden or [None] * len(masks)
        seen = zip(cameras, masks, inside, covered, strict=True)
        sightings = tuple(
            ObservedOutline(camera, trace_contour(mask, hidden=behind), interior)
            for camera, mask, interior, behind in seen
        )
        return SilhouetteLevel(tuple(cameras), tuple(masks), sightings, None if hidden is None else tuple(hidden))

    @property
    def size(self) -> int:
        """Approximate memory of masks and contours [bytes]."""
        pixels = sum(len(sighting.contour.pixels) for sighting in self.sightings)
        return sum(mask.nbytes for mask in (*self.masks, *(self.hidden or ()))) + _PIXEL_BYTES * pixels

    def packed(self) -> tuple[Floats, Integers, Integers, Integers]:
        """Return cameras (C, P), widths, heights and kinds of pixels (C, h, w) for the kernels.

        The kinds are padded to a common size: 1 in the silhouette, 0 beside it, and -1 where something hides the
        person.
        """
        widths = np.array([camera.width for camera in self.cameras])
        heights = np.array([camera.height for camera in self.cameras])
        kinds: Integers = np.zeros((len(self.cameras), heights.max(), widths.max()), np.int8)
        for c, mask in enumerate(self.masks):
            kinds[c, : heights[c], : widths[c]] = mask
            if self.hidden is not None:
                kinds[c, : heights[c], : widths[c]][self.hidden[c]] = -1
        return np.array([camera.packed for camera in self.cameras]), widths, heights, kinds


@dataclass(frozen=True, eq=False)
class StoredLevel:
    """A level in about a seventh of its memory: masks as bits, and contours without what is computed from them."""

    cameras: tuple[Camera, ...]
    masks: tuple[Image, ...]
    """Bits of each silhouette."""
    hidden: tuple[Image, ...] | None
    """Bits of the regions in which something hides the person."""
    pixels: tuple[NDArray[np.int32], ...]
    """(n, 2) x, y of each contour's pixels."""
    inward: tuple[Floats, ...]
    """(n, 2) their unit normals."""
    edges: tuple[InteriorEdges | None, ...]
    """Edges inside each silhouette, if they are known."""

    @staticmethod
    def of(level: SilhouetteLevel) -> "StoredLevel":
        """Store a level."""
        return StoredLevel(
            level.cameras, tuple(np.packbits(mask) for mask in level.masks),
            None if level.hidden is None else tuple(np.packbits(mask) for mask in level.hidden),
            tuple(sighting.contour.pixels.astype(np.int32) for sighting in level.sightings),
            tuple(sighting.contour.inward for sighting in level.sightings),
            tuple(sighting.interior for sighting in level.sightings),
        )  # fmt: skip

    @property
    def size(self) -> int:
        """Approximate memory [bytes]."""
        arrays: list[np.ndarray] = [*self.masks, *(self.hidden or ()), *self.pixels, *self.inward]
        edges = sum(len(found) for found in self.edges if found is not None)
        return sum(array.nbytes for array in arrays) + _EDGE_BYTES * edges

    def level(self) -> SilhouetteLevel:
        """Return the level, equal to the one that was stored."""
        masks = self._masks(self.masks)
        seen = zip(self.cameras, masks, self.pixels, self.inward, self.edges, strict=True)
        sightings = tuple(
            ObservedOutline(camera, SilhouetteContour(mask, pixels.astype(float), inward), edges)
            for camera, mask, pixels, inward, edges in seen
        )
        return SilhouetteLevel(
            self.cameras, masks, sightings, None if self.hidden is None else self._masks(self.hidden)
        )

    def mask(self, camera: int) -> Mask:
        """Return the silhouette of one camera."""
        return _unpacked(self.masks[camera], self.cameras[camera])

    def _masks(self, packed: Sequence[Image]) -> tuple[Mask, ...]:
        return tuple(_unpacked(bits, camera) for camera, bits in zip(self.cameras, packed, strict=True))


def _unpacked(bits: Image, camera: Camera) -> Mask:
    size = camera.width * camera.height
    return np.unpackbits(bits, count=size).view(bool).reshape(camera.height, camera.width)


def shrink(mask: Mask, size: tuple[int, int]) -> Mask:
    """Reduce a silhouette; a pixel is inside if more than half of the area it represents is."""
    if (mask.shape[1], mask.shape[0]) == size:
        return mask
    share = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    # At a factor of two, many pixels are half inside; without them the person would be a quarter of a pixel thinner.
    row, column = np.nonzero(share == 0.5)
    inside = np.asarray(share > 0.5)
    inside[row, column] = (row + column) % 2 == 0
    return inside


def level_factor(masks: Sequence[Mask], height: float) -> float:
    """Return the power of two by which silhouettes are reduced to about a height [px]."""
    tallest = max([int(np.count_nonzero(mask.any(1))) for mask in masks] + [1])
    return min(1.0, float(2.0 ** np.round(np.log2(height / tallest))))


KEPT_BYTES = 1 << 28
"""Memory for the levels of one size: three hundred frames of four cameras of 320 x 240 pixels [bytes]. Chosen by
hand."""
_STORED_SHARE = 0.75
"""Share of this memory up to which levels are stored in the form of `StoredLevel`. With the rest, about 85 frames of
these cameras are ready at a time: other answers are followed through 33 frames or less in nine of ten cases."""
_LEAST_READY = 16
"""Number of levels that are ready at a time even if the memory does not suffice. Chosen by hand."""


class FrameLevels:
    """The frames of a take at one size, computed on demand.

    As long as there is room, all frames are kept ready for use, since refinement and the search for other answers visit
    a take many times. In longer takes, those that were used last are ready; of the others, as many as there is room for
    are stored in little memory, the first ones first. Several threads may request frames at the same time.

    Args:
        cameras: Cameras of the full images.
        masks_of: Returns the silhouettes (height, width) of a frame, one per camera.
        factor: New size over old size.
        edges_of: Returns the edges inside a frame's silhouettes, one set per camera, in full images; None if they
            were not extracted.
        hidden_of: Returns the regions in which something hides the person, one per camera, in full images; None if
            they are not known.
        room: Memory for levels that are kept [bytes].
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        masks_of: Callable[[int], Sequence[Mask]],
        factor: float,
        edges_of: Callable[[int], Sequence[InteriorEdges] | None] = lambda frame: None,
        hidden_of: Callable[[int], Sequence[Mask] | None] = lambda frame: None,
        *,
        room: int = KEPT_BYTES,
    ):
        self.factor = factor
        self._room = room
        self._ready = OrderedDict[int, SilhouetteLevel]()
        """Levels by frame, that used last at the end."""
        self._stored: dict[int, StoredLevel] = {}
        self._ready_bytes = self._stored_bytes = 0
        self._counting = Lock()
        """Held while levels are added or removed."""
        small = tuple(camera.scaled(factor) for camera in cameras)

        # A method would refer to this object, whose memory would then be kept until the next garbage collection.
        def made(frame: int) -> SilhouetteLevel:
            shrunk = [shrink(mask, camera.size) for mask, camera in zip(masks_of(frame), small, strict=True)]
            edges, hidden = edges_of(frame), hidden_of(frame)
            return SilhouetteLevel.at_size(
                small,
                shrunk,
                None if edges is None else [each.scaled(factor) for each in edges],
                None if hidden is None else [shrink(h, c.size) for h, c in zip(hidden, small, strict=True)],
            )

        def mask(frame: int, camera: int) -> Mask:
            return shrink(masks_of(frame)[camera], small[camera].size)

        self._made, self._mask = made, mask

    def at(self, frame: int) -> SilhouetteLevel:
        """Return the level of a frame."""
        with self._counting:
            ready, stored = self._ready.get(frame), self._stored.get(frame)
            if ready is not None:
                self._ready.move_to_end(frame)
                return ready
        level = self._made(frame) if stored is None else stored.level()
        with self._counting:
            return self._keep(frame, level)

    def mask(self, frame: int, camera: int) -> Mask:
        """Return the silhouette of one camera; its level is not kept for this."""
        with self._counting:
            ready, stored = self._ready.get(frame), self._stored.get(frame)
        if ready is not None:
            return ready.masks[camera]
        return self._mask(frame, camera) if stored is None else stored.mask(camera)

    def _keep(self, frame: int, level: SilhouetteLevel) -> SilhouetteLevel:
        """Keep a level ready, and return it, or that of another thread that was earlier."""
        known = self._ready.setdefault(frame, level)
        if known is level:
            self._ready_bytes += level.size
        while self._ready_bytes + self._stored_bytes > self._room and len(self._ready) > _LEAST_READY:
            self._store(*self._ready.popitem(last=False))
        return known

    def _store(self, frame: int, level: SilhouetteLevel) -> None:
        """Store a level that is not kept ready any more, if there is room."""
        self._ready_bytes -= level.size
        if frame not in self._stored:
            stored = StoredLevel.of(level)
            if self._stored_bytes + stored.size <= _STORED_SHARE * self._room:
                self._stored[frame] = stored
                self._stored_bytes += stored.size

    def forget(self) -> None:
        """Release all levels; they are computed again on demand."""
        with self._counting:
            self._ready.clear()
            self._stored.clear()
            self._ready_bytes = self._stored_bytes = 0

    def ahead(self, frames: Iterable[int]) -> Iterator[int]:
        """Iterate over frames; a second thread prepares the next one while the caller works on the current one."""
        with ThreadPoolExecutor(1) as helper:
            last: int | None = None
            for frame in frames:
                helper.submit(self._make_ready, frame)
                if last is not None:
                    yield last
                last = frame
            if last is not None:
                yield last

    def _make_ready(self, frame: int) -> None:
        for sighting in self.at(frame).sightings:
            # Accessed once, they are cached.
            _ = sighting.planes, sighting.radians_per_pixel, sighting.contour.cells
