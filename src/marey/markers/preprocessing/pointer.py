"""Landmarks that the tip of a pointer shows, in the frame of a cluster of markers ([Cappozzo1995])."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, freeze_fields
from marey.errors import MareyError
from marey.geometry.vectors import products, unit
from marey.markers.data.clusters import MINIMUM_MARKERS
from marey.markers.data.rigid_fit import EQUAL_SD_M, fit_rigid, in_cluster_frame, mean_shape

_LEAST_TURN = 0.05
"""Smallest ratio of the singular values of the equations of the tip: below it some direction of the tip is not
determined. Turning by 8 degrees to both sides about two axes reaches it; about one axis it is zero. Chosen by hand."""
_MOST_MOTION_M = 0.01
"""RMS motion of the tip relative to the cluster above which the pointer does not rest on a landmark [m]. Chosen by
hand."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PointerTip:
    """The tip of a pointer in the frame of its markers."""

    shape: Floats
    """(M, 3) positions of the markers in their frame [m]."""
    place: Floats
    """(3,) the tip in that frame [m]."""
    residual_m: float
    """RMS distance of the tip from its place in the laboratory in the pivot trial [m]."""

    def __post_init__(self) -> None:
        freeze_fields(self, "shape", "place")


@dataclass(frozen=True, eq=False, kw_only=True)
class PointedPlace:
    """A place on a segment that a pointer showed."""

    shape: Floats
    """(M, 3) positions of the segment's markers in their frame [m]."""
    place: Floats
    """(3,) the place in that frame [m]."""
    motion_m: float
    """RMS distance of the tip from it over the frames [m]."""

    def __post_init__(self) -> None:
        freeze_fields(self, "shape", "place")


def tip_on_line(points: Floats, distance_m: float) -> Floats:
    """Return the tip of a pointer that lies on the line of its markers.

    Args:
        points: (F, M, 3) two or more markers on the line, the last one nearest to the tip [m]; NaN where missing.
        distance_m: Distance of the tip from the last marker [m].

    Returns:
        (F, 3) the tip [m]; NaN where the first or the last marker is missing.
    """
    return np.asarray(points[:, -1] + distance_m * unit(points[:, -1] - points[:, 0]))


def tip_by_pivot(points: Floats) -> PointerTip:
    """Find the tip of a pointer that was turned about it while it rested in one place.

    In every frame R p + t = q, with the pose R, t of the markers, the tip p in their frame and its place q: linear in
    p and q.

    Args:
        points: (F, M, 3) three or more markers off one line [m]; NaN where missing.

    Returns:
        The tip.

    Raises:
        MareyError: Fewer than three markers, or the pointer turned too little.
    """
    if points.shape[1] < MINIMUM_MARKERS:
        raise MareyError(f"A pivot trial needs {MINIMUM_MARKERS} markers on the pointer.")
    local, rotation, translation = in_cluster_frame(points)
    known = np.isfinite(translation).all(-1)
    if not known.any():
        raise MareyError(f"No frame shows {MINIMUM_MARKERS} markers of the pointer off one line.")
    rotation, translation = rotation[known], translation[known]
    rows = np.concatenate([rotation, np.broadcast_to(-np.eye(3), rotation.shape)], -1).reshape(-1, 6)
    values = np.linalg.svd(rows, compute_uv=False)
    if len(values) < 6 or values[-1] < _LEAST_TURN * values[0]:
        raise MareyError("The pointer turns too little about its tip.")
    found = np.linalg.lstsq(rows, -translation.ravel(), rcond=None)[0]
    off = products(rotation, found[:3]) + translation - found[3:]
    residual = float(np.sqrt((off**2).sum(-1).mean()))
    return PointerTip(shape=mean_shape(local), place=found[:3], residual_m=residual)


def tip_of_shape(points: Floats, tip: PointerTip) -> Floats:
    """Return the tip of a pointer whose shape is known.

    Args:
        points: (F, M, 3) the markers in the order of the shape [m]; NaN where missing.
        tip: The tip in the frame of the markers.

    Returns:
        (F, 3) the tip [m]; NaN where fewer than three markers are visible.
    """
    fit = fit_rigid(tip.shape, points, EQUAL_SD_M)
    return np.asarray(products(fit.rotation, tip.place) + fit.translation)


def pointed_place(points: Floats, tip: Floats) -> PointedPlace:
    """Find the place on a segment on which the tip of a pointer rests: the median over the frames.

    Args:
        points: (F, M, 3) the segment's markers [m]; NaN where missing.
        tip: (F, 3) the tip [m]; NaN where unknown.

    Returns:
        The place in the frame of the markers.

    Raises:
        MareyError: No frame shows the tip and three markers of the segment, or the tip does not rest.
    """
    local, rotation, translation = in_cluster_frame(points)
    places = products(np.swapaxes(rotation, -1, -2), tip - translation)
    places = places[np.isfinite(places).all(-1)]
    if not len(places):
        raise MareyError(f"No frame shows the pointer and {MINIMUM_MARKERS} markers of the segment.")
    place = np.median(places, 0)
    motion = float(np.sqrt(((places - place) ** 2).sum(-1).mean()))
    if motion > _MOST_MOTION_M:
        raise MareyError(
            f"The tip moves by {1e3 * motion:.0f} mm (RMS) relative to the segment: it does not rest on a landmark."
        )
    return PointedPlace(shape=mean_shape(local), place=place, motion_m=motion)
