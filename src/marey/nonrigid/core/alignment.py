"""Rigid alignment of many frames at once, with points missing, and the mean shape of them all."""

import numpy as np

from marey.arrays import Floats, Mask
from marey.geometry import rotations

FLATTEST = 1e-6
"""A point set whose second extent is below this share of its first lies on a line and tells no rotation."""
ROUNDS = 100
STILL = 1e-10


def rigid_fits(shape: Floats, points: Floats, present: Mask) -> tuple[Floats, Floats]:
    """Find the rotation and translation that carry a shape onto the points of each frame, by least squares.

    The closed form through the singular vectors, the same motion as that of Spoor and Veldpaus.

    Args:
        shape: (P, 3), or (F, P, 3) one a frame; finite wherever a point is present.
        points: (F, P, 3).
        present: (F, P) points that count.

    Returns:
        Rotation (F, 3, 3) and translation (F, 3), NaN in frames with fewer than three points or with points on a line.
    """
    weight = present.astype(float)[..., None]
    count = weight.sum(1)
    enough = count[:, 0] >= 3
    count = np.maximum(count, 1)
    source = np.where(present[..., None], shape, 0)
    target = np.where(present[..., None], points, 0)
    middle, centre = source.sum(1) / count, target.sum(1) / count
    source, target = (source - middle[:, None]) * weight, (target - centre[:, None]) * weight
    moment = np.einsum("fpi,fpj->fij", target, source)
    extent = np.linalg.svd(moment, compute_uv=False)
    rotation = rotations.nearest(moment)
    rotation[~(enough & (extent[:, 1] > FLATTEST * extent[:, 0]))] = np.nan
    return rotation, centre - np.einsum("fij,fj->fi", rotation, middle)


def mean_shape(points: Floats, present: Mask) -> tuple[Floats, Floats, Floats]:
    """Find the shape to which all frames lie nearest after rigid alignment (generalised Procrustes, [Gower1975]).

    Args:
        points: (F, P, 3).
        present: (F, P) points that count.

    Returns:
        Shape (P, 3), centred, NaN for points that no chain of common points ties to the others; rotation (F, 3, 3) and
        translation (F, 3) of it in each frame, NaN where a frame has too few points.
    """
    first = int(present.sum(1).argmax())
    shape = np.where(present[first][:, None], points[first], np.nan)
    before = np.inf
    for _ in range(ROUNDS):
        known = present & np.isfinite(shape).all(-1)
        rotation, translation = rigid_fits(np.nan_to_num(shape), points, known)
        carried = np.einsum("fji,fpj->fpi", rotation, points - translation[:, None])
        used = present & np.isfinite(rotation[:, 0, 0])[:, None]
        carried = np.where(used[..., None], carried, 0)
        times = used.sum(0)[:, None]
        shape = np.where(times > 0, carried.sum(0) / np.maximum(times, 1), np.nan)
        if not used.any():
            break
        shape = shape - np.nanmean(shape, 0)
        distance = float(np.where(used[..., None], (carried - np.nan_to_num(shape)) ** 2, 0).sum())
        if abs(before - distance) <= STILL * max(distance, 1e-300):
            break
        before = distance
    known = present & np.isfinite(shape).all(-1)
    return shape, *rigid_fits(np.nan_to_num(shape), points, known)
