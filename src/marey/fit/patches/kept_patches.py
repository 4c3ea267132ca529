"""Patches of all frames of a take in little memory: what is constant along a track is kept once."""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from marey.arrays import Floats, Integers
from marey.body.articulation.pose import SkinPoints
from marey.cameras.camera import Camera
from marey.observations.surface_tracks import TrackedPatches

_FIRST_TRACKS = 1024
"""Number of tracks for which there is space at first; it doubles."""


class _Seen(NamedTuple):
    """The patches of a frame in one camera."""

    camera: Camera
    tracks: Integers
    pixels: Floats
    information: Floats


class KeptPatches(Mapping[int, Sequence[TrackedPatches]]):
    """Patches by frame, one batch per camera, to which frames are added.

    A track has the same number in all frames, and no other camera has it. Its point of the surface, its segment and the
    directions of its offset are kept once, not in each frame.
    """

    def __init__(self) -> None:
        self._frames: dict[int, list[_Seen]] = {}
        self._row = np.full(_FIRST_TRACKS, -1, np.int32)
        """Row of the tables by the number of the track; -1 of tracks that were not added yet."""
        self._constant = _Constant(rows=_FIRST_TRACKS)
        self._count = 0

    def add(self, frame: int, batches: Sequence[TrackedPatches]) -> None:
        """Add the patches of a frame."""
        self._frames[frame] = [self._kept(batch) for batch in batches]

    def __getitem__(self, frame: int) -> Sequence[TrackedPatches]:
        return [self._batch(seen) for seen in self._frames[frame]]

    def __iter__(self) -> Iterator[int]:
        return iter(self._frames)

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self._frames)

    def _kept(self, batch: TrackedPatches) -> _Seen:
        self._row = _longer(self._row, int(batch.tracks.max(initial=0)) + 1, -1)
        new = self._row[batch.tracks] < 0
        first, self._count = self._count, self._count + int(new.sum())
        self._row[batch.tracks[new]] = np.arange(first, self._count)
        self._constant.put(first, batch, new)
        return _Seen(batch.camera, batch.tracks.astype(np.int32), batch.pixels, batch.information)

    def _batch(self, seen: _Seen) -> TrackedPatches:
        rows, constant = self._row[seen.tracks], self._constant
        return TrackedPatches(
            camera=seen.camera, tracks=seen.tracks.astype(int), segments=constant.segments[rows].astype(int),
            where=SkinPoints(face=constant.face[rows].astype(int), barycentric=constant.barycentric[rows]),
            directions=constant.directions[rows], pixels=seen.pixels, information=seen.information,
        )  # fmt: skip


class _Constant:
    """What is constant along each track, by row; the tables grow."""

    def __init__(self, rows: int) -> None:
        self.face, self.segments = np.zeros(rows, np.int32), np.zeros(rows, np.int32)
        self.barycentric, self.directions = np.zeros((rows, 3)), np.zeros((rows, 3, 3))

    def put(self, first: int, batch: TrackedPatches, new: np.ndarray) -> None:
        """Write the tracks of a batch that are new from a row on."""
        place = slice(first, first + int(new.sum()))
        for name, values in (
            ("face", batch.where.face), ("barycentric", batch.where.barycentric), ("segments", batch.segments),
            ("directions", batch.directions),
        ):  # fmt: skip
            table = _longer(getattr(self, name), place.stop, 0)
            table[place] = values[new]
            setattr(self, name, table)


def _longer(table: np.ndarray, rows: int, fill: int) -> np.ndarray:
    """Return a table with at least a number of rows: the same one, or one of twice the length or more."""
    if rows <= len(table):
        return table
    longer = np.full((max(rows, 2 * len(table)), *table.shape[1:]), fill, table.dtype)
    longer[: len(table)] = table
    return longer
