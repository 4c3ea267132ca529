"""Which voxels may be marrow: the body without the air, and whether marrow is dark (fat suppressed) or bright."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy import ndimage

from marey.arrays import Floats, Integers, Mask
from marey.errors import MareyError
from marey.knee.space.bias_field import between_two_classes, bias_field
from marey.knee.space.distances import distance_within
from marey.knee.space.resampling import on_grid, onward, reach, upright_grid
from marey.knee.space.volume import Grid, Volume

WORK_MM = 1.0
_SMOOTHING_MM = 0.7
_CLOSING_MM = 5
_DEEP_MM = 20.0
"""How far below the skin, in an axial slice, the middle of femur and tibia lies at least."""
_THICK_MM = 11.0
"""Radius of the ball that must fit into the marrow of femur and tibia."""
_APART_MM = (35.0, 115.0)
_ASIDE_MM = 50.0
_FROM_SKIN, _AIR_VOXELS = 3, 1000
"""Air counts as seen from so many voxels before the skin, when there are so many voxels of it."""

Kind = Literal["dark", "bright"]


class NoPairFound(MareyError):
    """An image shows no femur above a tibia: no knee, an unknown sequence, or one of the two only."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Knee:
    """An image at work: corrected, smoothed, on an upright grid of 1 mm, with the body in it."""

    intensity: np.ndarray
    """(k, j, i) without bias; outside the image as it is at the nearest place in it."""
    body: Mask
    """(k, j, i) the body, bones and all."""
    depth_mm: Floats
    """(k, j, i) distance to the skin, or the image's end, within the axial slice."""
    within: Mask
    """(k, j, i) where the image reaches: a turned one leaves corners of the upright grid, neither body nor air."""
    grid: Grid


@dataclass(frozen=True, eq=False, kw_only=True)
class Blob:
    """A thick piece of what may be marrow."""

    voxel: Integers
    """(3,) k, j, i of its middle in the upright grid."""
    radius_mm: float


@dataclass(frozen=True, eq=False, kw_only=True)
class Marrow:
    """How marrow looks in an image."""

    kind: Kind
    femur: Blob
    tibia: Blob


def prepare(volume: Volume, grid: Grid | None = None) -> Knee:
    """Correct an image's bias, lay it on an upright grid and find the body in it.

    Args:
        volume: As it came from the scanner.
        grid: The upright grid of another image of the same knee, to be used for this one, too.
    """
    grid = upright_grid(volume.grid, WORK_MM) if grid is None else grid
    within = reach(volume.grid, grid)
    intensity = onward(on_grid(volume, grid, _SMOOTHING_MM) / bias_field(volume).on(grid), within)
    body = _body(ndimage.gaussian_filter(intensity, 1.0), within)
    depth = np.stack([distance_within(np.pad(each, 1))[1:-1, 1:-1] for each in body])
    return Knee(intensity=intensity, body=body, depth_mm=depth * WORK_MM, within=within, grid=grid)


def air_level(knee: Knee) -> float | None:
    """Give the level of air, where nothing gives a signal; None where the image shows no air.

    Args:
        knee: The prepared image.
    """
    air = knee.within & ~ndimage.binary_dilation(knee.body, iterations=_FROM_SKIN)
    return float(np.median(knee.intensity[air])) if air.sum() >= _AIR_VOXELS else None


def marrow_of(knee: Knee) -> Marrow:
    """Tell dark marrow from bright by where thick, deep, even pieces are: two, one above the other.

    Args:
        knee: The prepared image.

    Raises:
        NoPairFound: Neither kind shows a femur above a tibia.
    """
    pairs = {kind: _best_pair(_thick_blobs(knee, kind)) for kind in ("dark", "bright")}
    found: list[tuple[float, Kind, tuple[Blob, Blob]]] = []
    for kind, pair in pairs.items():
        if pair is not None:
            found.append((pair[0].radius_mm + pair[1].radius_mm, kind, pair))  # type: ignore[arg-type]
    if not found:
        raise NoPairFound(
            "No femur above a tibia is found: the image shows no knee, or it is of an unknown sequence."
            " Marrow must be clearly darker (fat suppressed) or brighter than muscle; --seed may help."
        )
    _, kind, (femur, tibia) = max(found, key=lambda each: each[0])
    return Marrow(kind=kind, femur=femur, tibia=tibia)


def candidates(knee: Knee, kind: Kind) -> Mask:
    """(k, j, i) what may be marrow of this kind by the image's histogram alone."""
    values = ndimage.gaussian_filter(knee.intensity, 1.0)
    middle = between_two_classes(values[knee.body & (knee.depth_mm > 4)])
    if kind == "bright":
        return knee.body & (values > middle)
    lower = values[knee.body & (values < middle)]
    return knee.body & (values < between_two_classes(lower))


def _body(values: np.ndarray, within: Mask) -> Mask:
    """The body: what is brighter than air, with what it encloses in axial slices; it goes on to the image's end."""
    known = values[within]
    lower = known[known < between_two_classes(known)]
    air = float(np.exp(between_two_classes(np.log(np.maximum(lower, lower.max() / 200)))))
    body = values > air
    rim = _CLOSING_MM + 1
    for index, each in enumerate(body):
        closed = ndimage.binary_closing(np.pad(each, rim), iterations=_CLOSING_MM)
        body[index] = ndimage.binary_fill_holes(closed[rim:-rim, rim:-rim])
    return np.asarray(ndimage.binary_opening(body, iterations=3) & within)


def _thick_blobs(knee: Knee, kind: Kind) -> list[Blob]:
    likely = candidates(knee, kind)
    # As at the grid's own end, a bone goes on where the image ends.
    radius = np.where(likely, distance_within(likely | ~knee.within) * WORK_MM, 0.0)
    peaks = (ndimage.maximum_filter(radius, 15) == radius) & (radius >= _THICK_MM) & (knee.depth_mm >= _DEEP_MM)
    return [Blob(voxel=each, radius_mm=float(radius[tuple(each)])) for each in np.argwhere(peaks)]


def _best_pair(blobs: list[Blob]) -> tuple[Blob, Blob] | None:
    """Give the thickest two of which one lies above the other as femur and tibia do."""
    pairs = []
    for upper in blobs:
        for lower in blobs:
            apart = (upper.voxel - lower.voxel) * WORK_MM
            if _APART_MM[0] <= apart[0] <= _APART_MM[1] and np.hypot(apart[1], apart[2]) <= _ASIDE_MM:
                pairs.append((upper, lower))
    return max(pairs, key=lambda pair: pair[0].radius_mm + pair[1].radius_mm, default=None)
