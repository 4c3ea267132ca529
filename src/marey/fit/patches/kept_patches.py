"""Patches of all frames of a take in little memory: the frames in a log, and what is constant along a track once."""

from collections.abc import Iterator, Mapping, Sequence
from copy import copy
from typing import NamedTuple, Protocol

import numpy as np

from marey.arrays import Integers, Mask
from marey.body.articulation.pose import SkinPoints
from marey.cameras.camera import Camera
from marey.observations.surface_tracks import TrackedPatches

_FIRST_TRACKS = 1024
"""Number of tracks for which there is space at first; it doubles."""


class PatchLog(Protocol):
    """Arrays by name, appended in order: a list, or a log on disk, with which memory does not grow with the frames."""

    def append(self, arrays: dict[str, np.ndarray], /) -> None:
        """Append the arrays of a frame."""

    def __getitem__(self, place: int, /) -> dict[str, np.ndarray]: ...

    def __len__(self) -> int: ...


class _Seen(NamedTuple):
    """Where the patches of a frame are."""

    place: int
    """Place in the log."""
    cameras: tuple[Camera, ...]
    """Camera of each batch."""
    ends: tuple[int, ...]
    """End of each batch in the arrays of the log."""


class KeptPatches(Mapping[int, Sequence[TrackedPatches]]):
    """Patches by frame, one batch per camera, to which frames are added.

    A track has the same number in all frames, and no other camera has it. Its point of the surface, its segment and the
    directions of its offset are kept once, not in each frame. The numbers, positions and information of the patches of
    a frame are in a log, from which they are read when they are needed.

    Args:
        log: Receives the frames after those that it holds, which are left alone; by default a list.
    """

    def __init__(self, log: PatchLog | None = None) -> None:
        self._log: PatchLog = [] if log is None else log
        self._frames: dict[int, _Seen] = {}
        self._row = np.full(_FIRST_TRACKS, -1, np.int32)
        """Row of the tables by the number of the track; -1 of tracks that were not added yet."""
        self._constant = _Constant(rows=_FIRST_TRACKS)
        self._count = 0
        self._chosen: Mask | None = None
        """(T,) the tracks that are returned, by their number; None for all."""

    def add(self, frame: int, batches: Sequence[TrackedPatches]) -> None:
        """Add the patches of a frame."""
        for batch in batches:
            self._keep_constant(batch)
        ends = np.cumsum([len(batch.tracks) for batch in batches]).tolist()
        self._frames[frame] = _Seen(len(self._log), tuple(batch.camera for batch in batches), tuple(ends))
        self._log.append(
            {
                "tracks": np.concatenate([np.zeros(0, int), *(batch.tracks for batch in batches)]).astype(np.int32),
                "pixels": np.concatenate([np.zeros((0, 2)), *(batch.pixels for batch in batches)]),
                "information": np.concatenate([np.zeros((0, 2, 2)), *(batch.information for batch in batches)]),
            }
        )

    def lasting(self, least_frames: int) -> "KeptPatches":
        """Return the tracks of at least a number of frames; the log and the tables are shared."""
        known = self._row >= 0
        lasting = np.zeros(len(self._row), bool)
        lasting[known] = self._constant.frames[self._row[known]] >= least_frames
        other = copy(self)
        other._chosen = lasting
        return other

    def lengths(self) -> tuple[Integers, Integers]:
        """Return the segment (T,) and the number of frames (T,) of each track."""
        chosen = self._row >= 0 if self._chosen is None else (self._row >= 0) & self._chosen
        rows = self._row[chosen]
        return self._constant.segments[rows].astype(int), self._constant.frames[rows].astype(int)

    def __getitem__(self, frame: int) -> Sequence[TrackedPatches]:
        seen = self._frames[frame]
        arrays = self._log[seen.place]
        batches = []
        for camera, begin, end in zip(seen.cameras, (0, *seen.ends), seen.ends, strict=False):
            own = {name: values[begin:end] for name, values in arrays.items()}
            if self._chosen is not None:
                which = self._chosen[own["tracks"]]
                if not which.any():
                    continue
                own = {name: values[which] for name, values in own.items()}
            batches.append(self._batch(camera, own))
        return batches

    def __iter__(self) -> Iterator[int]:
        return iter(self._frames)

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self._frames)

    def _keep_constant(self, batch: TrackedPatches) -> None:
        self._row = _longer(self._row, int(batch.tracks.max(initial=0)) + 1, -1)
        new = self._row[batch.tracks] < 0
        first, self._count = self._count, self._count + int(new.sum())
        self._row[batch.tracks[new]] = np.arange(first, self._count)
        self._constant.put(first, batch, new)
        self._constant.frames[self._row[batch.tracks]] += 1

    def _batch(self, camera: Camera, own: Mapping[str, np.ndarray]) -> TrackedPatches:
        rows, constant = self._row[own["tracks"]], self._constant
        return TrackedPatches(
            camera=camera, tracks=own["tracks"].astype(int), segments=constant.segments[rows].astype(int),
            where=SkinPoints(face=constant.face[rows].astype(int), barycentric=constant.barycentric[rows]),
            directions=constant.directions[rows], pixels=own["pixels"], information=own["information"],
        )  # fmt: skip


class _Constant:
    """What is constant along each track, and its number of frames, by row; the tables grow."""

    def __init__(self, rows: int) -> None:
        self.face, self.segments, self.frames = (np.zeros(rows, np.int32) for _ in range(3))
        self.barycentric, self.directions = np.zeros((rows, 3)), np.zeros((rows, 3, 3))

    def put(self, first: int, batch: TrackedPatches, new: Mask) -> None:
        """Write the tracks of a batch that are new from a row on."""
        place = slice(first, first + int(new.sum()))
        self.frames = _longer(self.frames, place.stop, 0)
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
