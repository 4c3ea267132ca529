"""Preparation of an MR image: its body, the level of air, and what may be dark (fat suppressed) or bright marrow."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy import ndimage

from marey.arrays import Floats, Mask
from marey.errors import MareyError
from marey.knee.space.bias_field import BiasField, between_two_classes, bias_field
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
    skin_mm: float = 4.0
    """Depth [mm] below the skin from which tissue is divided into dark and bright."""
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


@dataclass(frozen=True, eq=False, kw_only=True)
class PreparedImage:
    """An image without bias, smoothed, on an upright grid of 1 mm, with the body in it."""

    intensity: np.ndarray
    """(k, j, i) without bias; outside the image the value of the nearest voxel in it."""
    bias: BiasField
    """Factor by which each voxel of the original image is too bright."""
    body: Mask
    """(k, j, i) true in the body, including bones."""
    depth_mm: Floats
    """(k, j, i) distance to the skin, or the image's end, within the axial slice."""
    within: Mask
    """(k, j, i) true within the image. A rotated image does not reach the corners of the upright grid, which are
    neither body nor air."""
    grid: VoxelGrid
    bright_from: float
    """Intensity that divides dark tissue from bright."""
    air_level: float | None
    """Level of air, where nothing gives a signal; None where the image shows no air."""
    candidates: Mapping[Kind, Mask]
    """Kind of marrow to (k, j, i) what may be such marrow by the image's histogram alone."""


def prepare(
    volume: Volume, grid: VoxelGrid | None = None, *, settings: MarrowSettings = MARROW_DEFAULTS
) -> PreparedImage:
    """Correct an image's bias, resample it to an upright grid, and find the body in it.

    Args:
        volume: As it came from the scanner.
        grid: The upright grid of another image of the same knee, which is used for this one as well.
        settings: Tuned constants of the algorithm.

    Raises:
        MareyError: No body is in the image.
    """
    grid = upright_grid(volume.grid, WORK_MM) if grid is None else grid
    within = reach(volume.grid, grid)
    bias = bias_field(volume)
    intensity = extrapolated(on_grid(volume, grid, settings.smoothing_mm) / bias.on(grid), within)
    smooth = ndimage.gaussian_filter(intensity, 1.0)
    body = _body(smooth, within, settings=settings)
    depth_mm = np.stack([distance_within(np.pad(each, 1))[1:-1, 1:-1] for each in body]) * WORK_MM
    deep = body & (depth_mm > settings.skin_mm)
    if not deep.any():
        raise MareyError("No body is found in the image.")
    bright_from = between_two_classes(intensity[deep])
    middle = between_two_classes(smooth[deep])
    darkest = between_two_classes(smooth[body & (smooth < middle)])
    return PreparedImage(
        intensity=intensity,
        bias=bias,
        body=body,
        depth_mm=depth_mm,
        within=within,
        grid=grid,
        air_level=_air_level(intensity, body, within, settings=settings),
        bright_from=bright_from,
        candidates={"dark": body & (smooth < darkest), "bright": body & (smooth > middle)},
    )


def _air_level(intensity: np.ndarray, body: Mask, within: Mask, *, settings: MarrowSettings) -> float | None:
    """Return the level of air, where nothing gives a signal; None where the image shows no air."""
    air = within & ~ndimage.binary_dilation(body, iterations=settings.air_from_skin_voxels)
    return float(np.median(intensity[air])) if air.sum() >= settings.least_air_voxels else None


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
