"""Corners of a board that were found in the pictures of several cameras."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from marey.arrays import Floats, Integers, Mask, freeze_fields


@dataclass(frozen=True, eq=False, kw_only=True)
class BoardSighting:
    """The corners of the board in one picture of one camera."""

    corner: Integers
    """(n,) index of each corner in `CalibrationBoard.points`."""
    pixels: Floats
    """(n, 2) [px]."""
    covariance: Floats
    """(n, 2, 2) [px2]."""
    motion: Floats | None = None
    """(n, 2) change of the pixels if the camera is later by one picture [px]; None where that is not known."""

    def __post_init__(self) -> None:
        freeze_fields(self, "corner", dtype=np.int64)
        freeze_fields(self, "pixels", "covariance", *(() if self.motion is None else ("motion",)))

    def __len__(self) -> int:
        return len(self.corner)


@dataclass(frozen=True, eq=False, kw_only=True)
class CornerSet:
    """Corners of one board in the pictures of several cameras, ordered by picture and camera."""

    cameras: tuple[str, ...]
    """Names of the C cameras."""
    sizes: tuple[tuple[int, int], ...]
    """Width and height of the images of each camera [px]."""
    pictures: tuple[str, ...]
    """Names of the F instants; all cameras that show one are synchronous."""
    camera: Integers
    """(N,) camera of each corner."""
    picture: Integers
    """(N,) instant of each corner."""
    corner: Integers
    """(N,) index in `CalibrationBoard.points`."""
    pixels: Floats
    """(N, 2) [px]."""
    covariance: Floats
    """(N, 2, 2) [px2]."""
    motion: Floats | None = None
    """(N, 2) change of the pixels if the camera is later by one picture [px]; zero for cameras whose delay is not
    estimated. None if that of no camera is."""

    def __post_init__(self) -> None:
        freeze_fields(self, "camera", "picture", "corner", dtype=np.int64)
        freeze_fields(self, "pixels", "covariance", *(() if self.motion is None else ("motion",)))

    def __len__(self) -> int:
        return len(self.camera)

    @staticmethod
    def gather(
        cameras: tuple[str, ...],
        sizes: tuple[tuple[int, int], ...],
        pictures: tuple[str, ...],
        sightings: Iterable[tuple[int, int, BoardSighting]],
    ) -> "CornerSet":
        """Gather the sightings of a session.

        Args:
            cameras: Names of the cameras.
            sizes: Width and height of the images of each camera [px].
            pictures: Names of the instants.
            sightings: Index of the instant, index of the camera, and the corners found there.

        Returns:
            All corners.
        """
        rows = sorted((row for row in sightings if len(row[2])), key=lambda row: row[:2])
        lengths = [len(found) for _, _, found in rows]
        empty = [BoardSighting(corner=np.zeros(0, int), pixels=np.zeros((0, 2)), covariance=np.zeros((0, 2, 2)))]
        found = [each for _, _, each in rows] or empty
        return CornerSet(
            cameras=cameras, sizes=sizes, pictures=pictures,
            camera=np.repeat(np.array([camera for _, camera, _ in rows], int), lengths),
            picture=np.repeat(np.array([picture for picture, _, _ in rows], int), lengths),
            corner=np.concatenate([each.corner for each in found]),
            pixels=np.concatenate([each.pixels for each in found]),
            covariance=np.concatenate([each.covariance for each in found]),
            motion=_joined_motion(found),
        )  # fmt: skip

    def subset(self, keep: Mask) -> "CornerSet":
        """Keep some corners.

        Args:
            keep: (N,) true for the corners to keep.
        """
        return replace(self, **{name: getattr(self, name)[keep] for name in self._columns})

    def ordered(self, order: Integers) -> "CornerSet":
        """Return the same corners in another order.

        Args:
            order: (N,) indices.
        """
        return replace(self, **{name: getattr(self, name)[order] for name in self._columns})

    @property
    def _columns(self) -> tuple[str, ...]:
        names = ("camera", "picture", "corner", "pixels", "covariance")
        return names if self.motion is None else (*names, "motion")

    def sightings(self) -> list[tuple[int, int, BoardSighting]]:
        """Return what `gather` joins: the index of the instant, that of the camera, and the corners of each view."""
        parts = [self.view_rows(view) for view in range(len(self.view_starts))]
        return [
            (
                int(self.picture[part.start]), int(self.camera[part.start]),
                BoardSighting(
                    corner=self.corner[part], pixels=self.pixels[part], covariance=self.covariance[part],
                    motion=None if self.motion is None else self.motion[part],
                ),
            )
            for part in parts
        ]  # fmt: skip

    def separated(self) -> "CornerSet":
        """Return the same corners with instants of their own for each camera, as of cameras that recorded alone."""
        views = np.unique(np.stack([self.picture, self.camera], axis=-1), axis=0)
        index = {(int(p), int(c)): k for k, (p, c) in enumerate(views)}
        picture = [index[int(p), int(c)] for p, c in zip(self.picture, self.camera, strict=True)]
        names = tuple(f"{self.cameras[int(c)]} {self.pictures[int(p)]}" for p, c in views)
        return replace(self, picture=np.array(picture, np.int64), pictures=names)

    @cached_property
    def view(self) -> Integers:
        """(N,) number of the view, which is one picture of one camera."""
        change = (np.diff(self.camera) != 0) | (np.diff(self.picture) != 0)
        return np.concatenate([[0], np.cumsum(change)]).astype(np.int64) if len(self) else np.zeros(0, np.int64)

    @cached_property
    def view_starts(self) -> Integers:
        """(V,) index of the first corner of each view."""
        return np.asarray(np.unique(self.view, return_index=True)[1], np.int64)

    @property
    def view_camera(self) -> Integers:
        """(V,) camera of each view."""
        return self.camera[self.view_starts]

    @property
    def view_picture(self) -> Integers:
        """(V,) instant of each view."""
        return self.picture[self.view_starts]

    @cached_property
    def view_counts(self) -> Integers:
        """(V,) number of corners of each view."""
        return np.bincount(self.view, minlength=len(self.view_starts)).astype(np.int64)

    def view_rows(self, view: int) -> slice:
        """Return the corners of a view."""
        start = int(self.view_starts[view])
        return slice(start, start + int(self.view_counts[view]))


def _joined_motion(sightings: Sequence[BoardSighting]) -> Floats | None:
    """Return the motions (N, 2) of all corners, zero where they are not known; None if none is."""
    if all(each.motion is None for each in sightings):
        return None
    return np.concatenate([np.zeros_like(each.pixels) if each.motion is None else each.motion for each in sightings])
