"""Region growing from a seed by threshold, with openings of a radius in millimetres against leaks.

What no opening cuts off, a fibula beside a tibia, is separated by its shape.
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from scipy import ndimage

from marey.arrays import Floats, Integers, Mask
from marey.extras import import_optional
from marey.knee.bones.marrow import WORK_MM
from marey.knee.space.distances import distance_within


@dataclass(frozen=True, kw_only=True)
class GrowingSettings:
    """Settings of region growing from a seed.

    Values without a stated source were chosen by hand.
    """

    seed_radius_mm: float = 8.0
    """Radius [mm] of the ball about a seed in which the level of marrow is measured."""
    deviations: float = 5.0
    """Width of the band about the median of the seed's ball, in robust standard deviations."""
    narrower_deviations: tuple[float, ...] = (4.5, 4.0)
    """Widths that are tried where the bone of one seed leaks into that of another one. `phantom_spl_t1` with further
    noise of 8 or 12 % leaks with 5; with 4.5 and 4 both bones have the volume that they have without noise, within
    4 %, and with 3 the femur lacks 15 to 17 %."""
    least_deviation: float = 0.04
    """Least standard deviation of marrow, as a share of its level: one quiet place does not represent a bone."""
    openings_mm: tuple[float, ...] = (2.0, 3.0, 4.0, 5.0, 6.0)
    """Radii [mm] of the openings that are tried, in this order."""
    steady: float = 1.15
    """An opening is wide enough when the bone is at most this many times as large as with the next one."""
    regrown_mm: float = 0.5
    """Distance [mm] beyond the radius of the opening by which a piece is grown again."""
    thin_mm: float = 6.0
    """Radius [mm] of the ball that fits into parts that are not thin."""
    core_mm: float = 8.0
    """Radius [mm] of the ball that fits into the core of a femur or tibia."""
    corner_mm: float = 6.0
    """Farthest distance [mm] of bone from the balls of the core: of whole femora and tibiae less than a third of a
    cm3 lies farther."""
    fibula_height_mm: float = 10.0
    """Least height [mm] over which the shaft of a fibula is separate from that of the tibia."""
    fibula_area_mm2: tuple[float, float] = (40.0, 700.0)
    """Least and largest mean cross-section [mm2] of this shaft: 320 and 270 mm2 for both images of `phantom_spl`."""
    fibula_filled: float = 0.8
    """Largest share of the convex outline about both shafts that they fill, the median of all slices. It is 0.70 and
    0.71 for both images of `phantom_spl`; two pieces of one shaft fill nearly all of it."""
    fibula_core_mm: float = 2.0
    """Depth [mm] inside a cross-section of either bone below which it is the same bone in the next slice."""


GROWING_DEFAULTS = GrowingSettings()
"""Default settings of region growing from a seed."""


def grow(
    likeness: np.ndarray, voxel: Integers, *, keep_out: Mask | None = None, settings: GrowingSettings = GROWING_DEFAULTS
) -> Mask:
    """Grow a bone from a seed through voxels that resemble marrow, with the smallest opening that removes leaks.

    The voxels that resemble marrow are eroded by a ball, and the piece that contains the seed is grown again by the
    ball's radius within these voxels. The smallest ball is used after which the next larger one hardly changes the
    bone: a leak through a gap is cut off as soon as the ball does not fit through the gap.

    Args:
        likeness: (k, j, i) similarity to marrow, 0 to 1, on the upright grid; NaN outside the image, where the bone may
            continue.
        voxel: (3,) k, j, i of the seed.
        keep_out: (k, j, i) where the bone cannot be, for example in the middle of another bone.
        settings: Tuned constants of the algorithm.

    Returns:
        (k, j, i) true in the bone; empty when nothing grows from the seed.
    """
    allowed = (likeness > 0) if keep_out is None else (likeness > 0) & ~keep_out
    inward = np.where(allowed, distance_within(allowed | np.isnan(likeness)) * WORK_MM, 0.0)
    pieces = [_grown(allowed, inward, voxel, radius, settings=settings) for radius in settings.openings_mm]
    sizes = [int(piece.sum()) for piece in pieces]
    for piece, size, following in zip(pieces, sizes, sizes[1:], strict=False):
        if size <= settings.steady * following:
            return piece
    whole = [index for index, size in enumerate(sizes) if size]
    return pieces[whole[-1]] if whole else pieces[0]


def _grown(allowed: Mask, inward_mm: Floats, voxel: Integers, radius_mm: float, *, settings: GrowingSettings) -> Mask:
    """Return the piece of the opened region that contains the seed, or the nearest one within reach of the opening."""
    core = inward_mm > radius_mm
    labels, _ = ndimage.label(core)
    near = np.argwhere(core)
    if not len(near):
        return np.zeros_like(allowed)
    away = np.linalg.norm(near - voxel, axis=1)
    if away.min() * WORK_MM > 2 * radius_mm + settings.regrown_mm:
        return np.zeros_like(allowed)
    piece = labels == labels[tuple(near[int(away.argmin())])]
    return np.asarray(allowed & (distance_within(~piece) * WORK_MM <= radius_mm + settings.regrown_mm))


def outgrowth(mask: Mask, *, settings: GrowingSettings = GROWING_DEFAULTS) -> Mask:
    """Return the voxels of a femur or tibia that are too far from its core to be bone: mostly leaks.

    Args:
        mask: (k, j, i) the bone on the upright grid; it continues beyond the end of the image.
        settings: Tuned constants of the algorithm.
    """
    whole = ndimage.binary_fill_holes(mask)
    core = distance_within(np.pad(whole, 1, mode="edge"))[1:-1, 1:-1, 1:-1] * WORK_MM > settings.core_mm
    if not core.any():
        return np.zeros_like(mask)
    away = distance_within(~core) * WORK_MM
    return np.asarray(mask & (away > settings.core_mm + settings.corner_mm))


def thin_share(mask: Mask, *, settings: GrowingSettings = GROWING_DEFAULTS) -> float:
    """Return the share of a femur or tibia that is thin: 1 to 2 % of whole bones, more where a bone leaked.

    Args:
        mask: (k, j, i) the bone on the upright grid; it continues beyond the end of the image.
        settings: Tuned constants of the algorithm.
    """
    whole = np.pad(ndimage.binary_fill_holes(mask), 1, mode="edge")
    core = ndimage.distance_transform_edt(whole) * WORK_MM > settings.thin_mm
    if not core.any():
        return 1.0
    thick = ndimage.distance_transform_edt(~core) * WORK_MM <= settings.thin_mm + settings.regrown_mm
    return float((whole & ~thick).sum() / whole.sum())


def joined_fibula(mask: Mask, *, settings: GrowingSettings = GROWING_DEFAULTS) -> Mask:
    """Return the fibula that has grown together with a tibia.

    Some centimetres below the knee the two shafts are separate. From there on upwards, each slice is divided at its
    narrowest place between what belongs to either bone in the slice below (watershed of the distance to the edge).

    Args:
        mask: (k, j, i) the tibia on the upright grid, perhaps with the fibula.
        settings: Tuned constants of the algorithm.

    Returns:
        (k, j, i) true in the fibula; empty where the image does not show two separate shafts.
    """
    fibula = np.zeros_like(mask)
    shafts = _separate_shafts(mask, settings=settings)
    if shafts is None:
        return fibula
    segmentation: Any = import_optional("skimage.segmentation", extra="knee", purpose="The separation of a fibula")
    top = len(shafts)
    fibula[:top] = shafts == 2
    cores = _cores(shafts[-1], settings=settings)
    for own, area in zip(fibula[top:], mask[top:], strict=True):
        cores = np.where(area, cores, 0)
        if not ((cores == 1).any() and (cores == 2).any()):
            break
        divided = segmentation.watershed(-ndimage.distance_transform_edt(area), cores, mask=area)
        own[:] = divided == 2
        cores = _cores(divided, settings=settings)
    return fibula


def _cores(divided: Integers, *, settings: GrowingSettings) -> Integers:
    """Return the bones of a slice without a rim about each, as numbers (j, i): 1 for the tibia, 2 for the fibula."""
    depths = [ndimage.distance_transform_edt(divided == number) * WORK_MM for number in (1, 2)]
    return np.select([depth > settings.fibula_core_mm for depth in depths], [1, 2], 0)


def _separate_shafts(mask: Mask, *, settings: GrowingSettings) -> Integers | None:
    """Return the slices (k, j, i) below the place where both shafts meet: 1 in the tibia, 2 in the fibula, else 0.

    None where there are not two shafts.
    """
    rows = np.flatnonzero(mask.any((1, 2)))
    if not len(rows):
        return None
    height, end = int(np.ceil(settings.fibula_height_mm / WORK_MM)), int(rows[-1]) + 1
    # In the lowest slices, at the end of the image, both may be incomplete.
    first = range(min(rows[0] + height, end), min(rows[0] + 3 * height, end) + 1)
    apart = next((top for top in first if _shafts(mask[:top], height, settings=settings) is not None), None)
    if apart is None:
        return None
    # Above the place where they meet, both are one piece: it is found by bisection.
    joined = end + 1
    while joined - apart > 1:
        middle = (apart + joined) // 2
        if _shafts(mask[:middle], height, settings=settings) is None:
            joined = middle
        else:
            apart = middle
    return _shafts(mask[:apart], height, settings=settings)


def _shafts(mask: Mask, height: int, *, settings: GrowingSettings) -> Integers | None:
    """Return the pieces of some slices (k, j, i): 1 in the largest, 2 in another one that may be a fibula; else 0."""
    labels, count = ndimage.label(mask)
    voxels = np.bincount(labels.ravel(), minlength=count + 1)[1:]
    if count < 2:
        return None
    main = 1 + int(voxels.argmax())
    for piece in 1 + np.argsort(-voxels)[1:]:
        shown = (labels == piece).any((1, 2))
        area = voxels[piece - 1] / shown.sum() * WORK_MM**2
        if shown.sum() >= height and settings.fibula_area_mm2[0] <= area <= settings.fibula_area_mm2[1]:
            both = np.select([labels == main, labels == piece], [1, 2], 0)
            if np.median([_filled_share(each > 0) for each in both[shown]]) < settings.fibula_filled:
                return both
    return None


def _filled_share(area: Mask) -> float:
    """Return the share of its convex outline that an area (j, i) fills."""
    corners = cv2.convexHull(np.argwhere(area).astype(np.int32))
    outline = cv2.fillConvexPoly(np.zeros(area.shape, np.uint8), corners[..., ::-1], 1)
    return float(area.sum() / outline.sum())
