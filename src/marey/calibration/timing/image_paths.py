"""The paths of a wand's points in the images of each camera, interpolated in time.

A camera that is late by d pictures shows the instant p of the others at p + d on its own clock, between two of its
pictures. There the place of a point is interpolated by a cubic spline through the pictures that follow each other.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline

from marey.arrays import Floats, Integers, Mask
from marey.calibration.boards.corners import CornerSet

LEAST_RUN = 4
"""Least number of consecutive pictures through which a path is interpolated: a cubic has four coefficients."""
_SPLINE_ERROR = 1.0 / 144.0
"""Error of a cubic spline halfway between pictures, as a share of that of a cubic through the neighbours of a picture
at twice the distance: h^4 u''''/384 against 9 (2 h)^4 u''''/384."""
_END_ERROR = 9.0
"""Factor of the error in the first and last interval of a path, where the spline is the cubic of its end."""
_END_DECAY = 2.0 - np.sqrt(3.0)
"""Factor by which a disturbance of a cubic spline falls from one interval to the next."""
_WHOLE = 1e-9
"""Distance from a whole number of pictures up to which nothing is interpolated [pictures]: rounding only."""


@dataclass(frozen=True, eq=False, kw_only=True)
class _Path:
    """A point of the wand in consecutive pictures of one camera."""

    camera: int
    corner: int
    first: int
    """Its first picture."""
    pixels: Floats
    """(n, 2) [px]."""
    covariance: Floats
    """(n, 2, 2) [px2]."""
    bend: Floats
    """(n,) distance of each point from the cubic through its neighbours at twice the distance [px]."""

    @property
    def last(self) -> int:
        return self.first + len(self.pixels) - 1


@dataclass(frozen=True, eq=False)
class ImagePaths:
    """The points of all cameras, and where they are between the pictures."""

    corners: CornerSet
    """The points as they were found; consecutive instants are consecutive pictures of each camera."""
    _paths: tuple[_Path, ...]
    _splines: tuple[CubicSpline, ...]

    @staticmethod
    def through(corners: CornerSet) -> "ImagePaths":
        """Interpolate the paths of all points.

        Args:
            corners: The points of the wand; those of different instants must not be exchanged.
        """
        paths = tuple(_paths_of(corners))
        usual = _usual_bends(paths, len(corners.cameras))
        paths = tuple(
            replace(each, bend=np.where(np.isfinite(each.bend), each.bend, usual[each.camera])) for each in paths
        )
        splines = tuple(CubicSpline(np.arange(len(each.pixels)), each.pixels) for each in paths)
        return ImagePaths(corners, paths, splines)

    def at(self, late: Floats, timed: Mask, drift: Floats | None = None) -> CornerSet:
        """Return the points at the instants of the pictures, if cameras are late.

        Args:
            late: (C,) by how much each camera is late, in the middle of the session [pictures].
            timed: (C,) cameras whose further delays are estimated, for which the motions of their points are needed.
            drift: (C,) by how much each camera becomes later per picture; by default not at all.

        Returns:
            The points. Of a camera that is late by a part of a picture, those between consecutive pictures only.
        """
        drift = np.zeros(len(late)) if drift is None else drift
        whole = (np.abs(late - np.round(late)) < _WHOLE) & (drift == 0.0)
        parts = [self._shifted(np.round(late).astype(int), timed, whole)]
        for path, spline in zip(self._paths, self._splines, strict=True):
            if not whole[path.camera]:
                clock = float(late[path.camera]), float(drift[path.camera])
                parts.append(self._interpolated(path, spline, clock, timed=bool(timed[path.camera])))
        table = [np.concatenate(column) for column in zip(*parts, strict=True)]
        camera, picture, corner, pixels, covariance, motion = table
        found = replace(
            self.corners, camera=camera, picture=picture, corner=corner, pixels=pixels, covariance=covariance,
            motion=motion,
        )  # fmt: skip
        return found.ordered(np.lexsort((found.corner, found.camera, found.picture)))

    def _shifted(self, late: Integers, timed: Mask, whole: Mask) -> tuple[np.ndarray, ...]:
        """Return the points of cameras that are late by whole pictures, where nothing is interpolated."""
        own = self.corners
        motion = self._motions(timed & whole)
        picture = own.picture - late[own.camera]
        keep = whole[own.camera] & (picture >= 0) & (picture < len(own.pictures))
        columns = (own.camera, picture, own.corner, own.pixels, own.covariance, motion)
        return tuple(column[keep] for column in columns)

    def _motions(self, timed: Mask) -> Floats:
        """Return the motion (N, 2) of each point as it was found, zero where it is not known or not needed."""
        own = self.corners
        marks = int(own.corner.max(initial=0)) + 1
        key = (own.camera * marks + own.corner) * len(own.pictures) + own.picture
        order = np.argsort(key)
        motion = np.zeros_like(own.pixels)
        for path, spline in zip(self._paths, self._splines, strict=True):
            if timed[path.camera]:
                start = (path.camera * marks + path.corner) * len(own.pictures) + path.first
                rows = order[np.searchsorted(key[order], start) + np.arange(len(path.pixels))]
                motion[rows] = spline(np.arange(len(rows)), 1)
        return motion

    def _interpolated(
        self, path: _Path, spline: CubicSpline, clock: tuple[float, float], *, timed: bool
    ) -> tuple[np.ndarray, ...]:  # fmt: skip
        (late, drift), count = clock, len(self.corners.pictures)
        middle = middle_of(self.corners)
        first, last = (middle + (end - middle - late) / (1.0 + drift) for end in (path.first, path.last))
        picture = np.arange(max(int(np.ceil(first)), 0), min(int(np.floor(last)), count - 1) + 1)
        at = np.clip(picture + late + drift * (picture - middle) - path.first, 0.0, len(path.pixels) - 1.0)
        before = np.clip(np.floor(at).astype(int), 0, len(path.pixels) - 2)
        share = at - before
        inward = np.minimum(before, len(path.pixels) - 2 - before)
        error = _SPLINE_ERROR * (1.0 + (_END_ERROR - 1.0) * _END_DECAY**inward)
        error = error * np.maximum(path.bend[before], path.bend[before + 1])
        error = error * 16.0 * np.square(share * (1.0 - share))
        mixed = share[:, None, None]
        covariance = (1.0 - mixed) * path.covariance[before] + mixed * path.covariance[before + 1]
        covariance = covariance + np.square(error)[:, None, None] * np.eye(2)
        motion = spline(at, 1) if timed else np.zeros((len(at), 2))
        return (
            np.full(len(at), path.camera), picture, np.full(len(at), path.corner), spline(at), covariance, motion
        )  # fmt: skip


def middle_of(corners: CornerSet) -> float:
    """Return the middle of a session [pictures], where the delay of a clock that drifts is given."""
    return 0.5 * (len(corners.pictures) - 1)


def _paths_of(corners: CornerSet) -> Iterator[_Path]:
    """Iterate over the runs of consecutive pictures that show a point, if they are long enough."""
    order = np.lexsort((corners.picture, corners.corner, corners.camera))
    key = np.stack([corners.camera, corners.corner], axis=-1)[order]
    picture = corners.picture[order]
    new = np.any(np.diff(key, axis=0) != 0, axis=1) | (np.diff(picture) != 1)
    for rows in np.split(order, np.flatnonzero(new) + 1):
        if len(rows) >= LEAST_RUN:
            yield _Path(
                camera=int(corners.camera[rows[0]]), corner=int(corners.corner[rows[0]]),
                first=int(corners.picture[rows[0]]), pixels=corners.pixels[rows], covariance=corners.covariance[rows],
                bend=_bends(corners.pixels[rows]),
            )  # fmt: skip


def _bends(pixels: Floats) -> Floats:
    """Return how far each point (n,) lies from the cubic through its neighbours [px]; NaN near the ends."""
    bend = np.full(len(pixels), np.nan)
    if len(pixels) > 6:
        near = (9.0 * (pixels[2:-4] + pixels[4:-2]) - pixels[:-6] - pixels[6:]) / 16.0
        bend[3:-3] = np.linalg.norm(pixels[3:-3] - near, axis=1)
        bend[:3], bend[-3:] = bend[3], bend[-4]
    return bend


def _usual_bends(paths: tuple[_Path, ...], cameras: int) -> Floats:
    """Return the 90th percentile of the bends (C,) of each camera, for paths too short to have their own [px]."""
    usual = np.zeros(cameras)
    for camera in range(cameras):
        own = np.concatenate([np.zeros(1), *(each.bend for each in paths if each.camera == camera)])
        usual[camera] = np.percentile(own[np.isfinite(own)], 90)
    return usual
