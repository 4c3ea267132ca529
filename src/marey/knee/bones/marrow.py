"""Preparation of an MR image: body, air, and whether marrow is dark (fat suppressed) or bright."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy import ndimage

from marey.arrays import Floats, Integers, Mask
from marey.errors import MareyError
from marey.knee.space.bias_field import between_two_classes, bias_field
from marey.knee.space.distances import distance_within
from marey.knee.space.resampling import extrapolated, on_grid, reach, upright_grid
from marey.knee.space.volume import Volume, VoxelGrid

WORK_MM = 1.0
"""Spacing [mm] of the upright grid on which bones are segmented, in all directions; chosen by hand."""


@dataclass(frozen=True, kw_only=True)
class MarrowSettings:
    """Settings for preparing an image and finding thick marrow in it.

    Values without a stated source were chosen by hand.
    """

    smoothing_mm: float = 0.7
    """Standard deviation [mm] of the smoothing before an image is resampled."""
    closing_voxels: int = 5
    """Iterations of the closing, in voxels of 1 mm, by which gaps in the skin are closed in axial slices."""
    least_depth_mm: float = 20.0
    """Least distance [mm] from the skin, in an axial slice, of the middle of femur and tibia."""
    least_radius_mm: float = 11.0
    """Radius [mm] of the ball that must fit into the marrow of femur and tibia."""
    height_difference_mm: tuple[float, float] = (35.0, 115.0)
    """Least and largest height [mm] of the femur's middle above the tibia's."""
    largest_offset_mm: float = 50.0
    """Largest horizontal distance [mm] between the middles of femur and tibia."""
    air_from_skin_voxels: int = 3
    """Distance from the skin, in voxels of 1 mm, beyond which voxels outside the body count as air."""
    least_air_voxels: int = 1000
    """Least number of such voxels from which the level of air is measured."""


MARROW_DEFAULTS = MarrowSettings()
"""Default settings for preparing an image and finding thick marrow in it."""

Kind = Literal["dark", "bright"]


@dataclass(frozen=True, kw_only=True)
class PerKind:
    """A value for each kind of marrow."""

    dark: float
    bright: float

    def of(self, kind: Kind) -> float:
        """Return the value for one kind."""
        return self.dark if kind == "dark" else self.bright


class NoPairFound(MareyError):
    """An image shows no femur above a tibia: no knee, an unknown sequence, or one of the two only."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PreparedImage:
    """An image without bias, smoothed, on an upright grid of 1 mm, with the body in it."""

    intensity: np.ndarray
    """(k, j, i) without bias; outside the image the value of the nearest voxel in it."""
    body: Mask
    """(k, j, i) true in the body, including bones."""
    depth_mm: Floats
    """(k, j, i) distance to the skin, or the image's end, within the axial slice."""
    within: Mask
    """(k, j, i) true within the image. A rotated image does not reach the corners of the upright grid, which are
    neither body nor air."""
    grid: VoxelGrid


@dataclass(frozen=True, eq=False, kw_only=True)
class Blob:
    """A thick piece of what may be marrow."""

    voxel: Integers
    """(3,) k, j, i of its middle in the upright grid."""
    radius_mm: float


@dataclass(frozen=True, eq=False, kw_only=True)
class LongBoneMarrow:
    """The kind of marrow in an image, and the thickest marrow of femur and tibia."""

    kind: Kind
    femur: Blob
    tibia: Blob


def prepare(
    volume: Volume, grid: VoxelGrid | None = None, *, settings: MarrowSettings = MARROW_DEFAULTS
) -> PreparedImage:
    """Correct an image's bias, resample it to an upright grid, and find the body in it.

    Args:
        volume: As it came from the scanner.
        grid: The upright grid of another image of the same knee, which is used for this one as well.
        settings: Tuned constants of the algorithm.
    """
    grid = upright_grid(volume.grid, WORK_MM) if grid is None else grid
    within = reach(volume.grid, grid)
    intensity = extrapolated(on_grid(volume, grid, settings.smoothing_mm) / bias_field(volume).on(grid), within)
    body = _body(ndimage.gaussian_filter(intensity, 1.0), within, settings=settings)
    depth = np.stack([distance_within(np.pad(each, 1))[1:-1, 1:-1] for each in body])
    return PreparedImage(intensity=intensity, body=body, depth_mm=depth * WORK_MM, within=within, grid=grid)


def air_level(knee: PreparedImage, *, settings: MarrowSettings = MARROW_DEFAULTS) -> float | None:
    """Return the level of air, where nothing gives a signal; None where the image shows no air.

    Args:
        knee: The prepared image.
        settings: Tuned constants of the algorithm.
    """
    air = knee.within & ~ndimage.binary_dilation(knee.body, iterations=settings.air_from_skin_voxels)
    return float(np.median(knee.intensity[air])) if air.sum() >= settings.least_air_voxels else None


def marrow_of(knee: PreparedImage, *, settings: MarrowSettings = MARROW_DEFAULTS) -> LongBoneMarrow:
    """Determine whether marrow is dark or bright by its thick, deep pieces: two, one above the other.

    Args:
        knee: The prepared image.
        settings: Tuned constants of the algorithm.

    Raises:
        NoPairFound: Neither kind shows a femur above a tibia.
    """
    pairs = {
        kind: _best_pair(_thick_blobs(knee, kind, settings=settings), settings=settings) for kind in ("dark", "bright")
    }
    found: list[tuple[float, Kind, tuple[Blob, Blob]]] = []
    for kind, pair in pairs.items():
        if pair is not None:
            found.append((pair[0].radius_mm + pair[1].radius_mm, kind, pair))  # type: ignore[arg-type]
    if not found:
        raise NoPairFound(
            "No femur above a tibia is found: the image shows no knee, or it is of an unknown sequence."
            " Marrow must be clearly darker (fat suppressed) or brighter than muscle; seeds (--seed) may help."
        )
    _, kind, (femur, tibia) = max(found, key=lambda each: each[0])
    return LongBoneMarrow(kind=kind, femur=femur, tibia=tibia)


def candidates(knee: PreparedImage, kind: Kind) -> Mask:
    """(k, j, i) what may be marrow of this kind by the image's histogram alone."""
    values = ndimage.gaussian_filter(knee.intensity, 1.0)
    middle = between_two_classes(values[knee.body & (knee.depth_mm > 4)])
    if kind == "bright":
        return np.asarray(knee.body & (values > middle))
    lower = values[knee.body & (values < middle)]
    return np.asarray(knee.body & (values < between_two_classes(lower)))


def _body(values: np.ndarray, within: Mask, *, settings: MarrowSettings) -> Mask:
    """(k, j, i) true in the body: what is brighter than air, and what it encloses in axial slices."""
    known = values[within]
    lower = known[known < between_two_classes(known)]
    air = float(np.exp(between_two_classes(np.log(np.maximum(lower, lower.max() / 200)))))
    body = values > air
    rim = settings.closing_voxels + 1
    for index, each in enumerate(body):
        closed = ndimage.binary_closing(np.pad(each, rim), iterations=settings.closing_voxels)
        body[index] = ndimage.binary_fill_holes(closed[rim:-rim, rim:-rim])
    return np.asarray(ndimage.binary_opening(body, iterations=3) & within)


def _thick_blobs(knee: PreparedImage, kind: Kind, *, settings: MarrowSettings) -> list[Blob]:
    likely = candidates(knee, kind)
    # A bone continues beyond the end of the image, as it does beyond the end of the grid.
    radius = np.where(likely, distance_within(likely | ~knee.within) * WORK_MM, 0.0)
    peaks = (
        (ndimage.maximum_filter(radius, 15) == radius)
        & (radius >= settings.least_radius_mm)
        & (knee.depth_mm >= settings.least_depth_mm)
    )
    return [Blob(voxel=each, radius_mm=float(radius[tuple(each)])) for each in np.argwhere(peaks)]


def _best_pair(blobs: list[Blob], *, settings: MarrowSettings) -> tuple[Blob, Blob] | None:
    """Return the thickest two of which one lies above the other as femur and tibia do."""
    pairs = []
    for upper in blobs:
        for lower in blobs:
            apart = (upper.voxel - lower.voxel) * WORK_MM
            if (
                settings.height_difference_mm[0] <= apart[0] <= settings.height_difference_mm[1]
                and np.hypot(apart[1], apart[2]) <= settings.largest_offset_mm
            ):
                pairs.append((upper, lower))
    return max(pairs, key=lambda pair: pair[0].radius_mm + pair[1].radius_mm, default=None)
