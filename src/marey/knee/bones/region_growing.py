"""Bones grown from seeds by threshold, with leaks kept out by openings in millimetres and a regrowth of their width."""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from marey.arrays import Floats, Integers, Mask
from marey.errors import SettingProblem
from marey.knee.bones.marrow import WORK_MM, Kind, Knee
from marey.knee.space.distances import distance_within

_SEED_MM = 8.0
_DEVIATIONS = 5.0
"""Width of the band about the seed's own median, in robust standard deviations of the seed's region."""
_LEAST_DEVIATION = 0.04
"""Standard deviation of marrow at least, as a share of its level: a single quiet place does not speak for a bone."""
_OPENINGS_MM = (2.0, 3.0, 4.0, 5.0, 6.0)
_STEADY = 1.15
_REGROWN_MM = 0.5
_THIN_MM = 6.0
_CORE_MM, _CORNER_MM = 8.0, 6.0
"""A femur or tibia is all within so much of where a ball of such a radius fits into it, but a third of a cm3."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Level:
    """How bright the marrow about a seed is in one image."""

    median: float
    limit: float
    """Where marrow is taken to end: above (dark marrow) or below the median."""

    def likeness(self, intensity: np.ndarray) -> np.ndarray:
        """Give 1 at and beyond the median, falling to 0 at the limit."""
        return np.clip((intensity - self.limit) / (self.median - self.limit), 0, 1).astype(np.float32)


def seed_ball(knee: Knee, voxel: Integers, radius_mm: float = _SEED_MM) -> Mask:
    """(k, j, i) true within a ball about a voxel, and in the body."""
    about = [np.arange(n) - v for n, v in zip(knee.grid.shape, voxel, strict=True)]
    squares = about[0][:, None, None] ** 2 + about[1][None, :, None] ** 2 + about[2][None, None, :] ** 2
    return np.asarray((squares <= (radius_mm / WORK_MM) ** 2) & knee.body)


def marrow_level(knee: Knee, kind: Kind, voxel: Integers, radius_mm: float = _SEED_MM) -> Level:
    """Take the band of marrow from the region of a seed itself.

    Args:
        knee: The prepared image.
        kind: Whether marrow is dark or bright.
        voxel: (3,) k, j, i of the seed.
        radius_mm: Of the ball that is looked at.

    Raises:
        SettingProblem: The seed lies in the air.
    """
    values = knee.intensity[seed_ball(knee, voxel, radius_mm)]
    if not values.size:
        raise SettingProblem("The seed lies in the air, outside the body: choose a place within the bone.")
    median = float(np.median(values))
    deviation = max(1.4826 * float(np.median(np.abs(values - median))), _LEAST_DEVIATION * median)
    return Level(median=median, limit=median + (1 if kind == "dark" else -1) * _DEVIATIONS * deviation)


def grow(likeness: np.ndarray, voxel: Integers, *, keep_out: Mask | None = None) -> Mask:
    """Grow a bone from a seed through all that is like marrow, through necks no narrower than need be.

    What is like marrow is eroded by a ball, the piece of the seed is taken, and grown again by the ball's radius
    within what is like marrow. The smallest ball is taken with which the bone does not become much smaller with the
    next one: a leak through a gap is cut off at once when the ball fits the gap no more, a bone hardly changes.

    Args:
        likeness: (k, j, i) 0 to 1, on the upright grid; NaN outside the image, where the bone may go on.
        voxel: (3,) k, j, i of the seed.
        keep_out: Where the bone cannot be, another bone's middle for one.

    Returns:
        (k, j, i) true in the bone; empty when nothing grows from the seed.
    """
    allowed = (likeness > 0) if keep_out is None else (likeness > 0) & ~keep_out
    inward = np.where(allowed, distance_within(allowed | np.isnan(likeness)) * WORK_MM, 0.0)
    pieces = [_grown(allowed, inward, voxel, radius) for radius in _OPENINGS_MM]
    sizes = [int(piece.sum()) for piece in pieces]
    for piece, size, following in zip(pieces, sizes, sizes[1:], strict=False):
        if size <= _STEADY * following:
            return piece
    whole = [index for index, size in enumerate(sizes) if size]
    return pieces[whole[-1]] if whole else pieces[0]


def _grown(allowed: Mask, inward_mm: Floats, voxel: Integers, radius_mm: float) -> Mask:
    """Give the piece of the opened region that the seed is in, or nearest to within the radius."""
    core = inward_mm > radius_mm
    labels, _ = ndimage.label(core)
    near = np.argwhere(core)
    if not len(near):
        return np.zeros_like(allowed)
    away = np.linalg.norm(near - voxel, axis=1)
    if away.min() * WORK_MM > 2 * radius_mm + _REGROWN_MM:
        return np.zeros_like(allowed)
    piece = labels == labels[tuple(near[int(away.argmin())])]
    return np.asarray(allowed & (distance_within(~piece) * WORK_MM <= radius_mm + _REGROWN_MM))


def outgrowth(mask: Mask) -> Mask:
    """(k, j, i) what of a femur or tibia is too far from its thick part to be bone: a leak through a neck, mostly.

    Args:
        mask: (k, j, i) the bone on the upright grid; beyond the image's end it goes on.
    """
    whole = ndimage.binary_fill_holes(mask)
    core = distance_within(np.pad(whole, 1, mode="edge"))[1:-1, 1:-1, 1:-1] * WORK_MM > _CORE_MM
    if not core.any():
        return np.zeros_like(mask)
    away = distance_within(~core) * WORK_MM
    return np.asarray(mask & (away > _CORE_MM + _CORNER_MM))


def thin_share(mask: Mask) -> float:
    """Give the share of a femur or tibia into which no ball of 6 mm fits: of whole ones 1 to 2 %, more where it leaked.

    Args:
        mask: (k, j, i) the bone on the upright grid; beyond the image's end it goes on.
    """
    whole = np.pad(ndimage.binary_fill_holes(mask), 1, mode="edge")
    core = ndimage.distance_transform_edt(whole) * WORK_MM > _THIN_MM
    if not core.any():
        return 1.0
    thick = ndimage.distance_transform_edt(~core) * WORK_MM <= _THIN_MM + _REGROWN_MM
    return float((whole & ~thick).sum() / whole.sum())
