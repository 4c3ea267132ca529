"""Rigid alignment of many frames at once, with missing points, and their mean shape."""

import numpy as np

from marey.arrays import Floats, Mask
from marey.geometry import rotations

_COLLINEAR = 1e-6
"""Ratio of the second to the first singular value of the cross-covariance below which points count as collinear and
determine no rotation; a numerical threshold."""
_ROUNDS = 100
"""Largest number of iterations of the generalised Procrustes analysis; a limit on time."""
_TOLERANCE = 1e-10
"""Iterations end when the sum of squares changes by less than this fraction; a numerical tolerance."""


def rigid_fits(shape: Floats, points: Floats, present: Mask) -> tuple[Floats, Floats]:
    """Find the rotation and translation that map a shape onto the points of each frame by least squares.

    Closed form by singular value decomposition, the same motion as that of Spoor and Veldpaus.

    Args:
        shape: (P, 3), or (F, P, 3) with one shape per frame; finite wherever a point is present.
        points: (F, P, 3).
        present: (F, P) mask of the points used.

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
    rotation[~(enough & (extent[:, 1] > _COLLINEAR * extent[:, 0]))] = np.nan
    return rotation, centre - np.einsum("fij,fj->fi", rotation, middle)


def mean_shape(points: Floats, present: Mask) -> tuple[Floats, Floats, Floats]:
    """Compute the mean shape of all frames after rigid alignment (generalised Procrustes analysis, [Gower1975]).

    Args:
        points: (F, P, 3).
        present: (F, P) mask of the points used.

    Returns:
        Shape (P, 3), centred, NaN for points that no chain of common points connects to the others; rotation
        (F, 3, 3) and translation (F, 3) of the shape in each frame, NaN where a frame has too few points.
    """
    first = int(present.sum(1).argmax())
    shape = np.where(present[first][:, None], points[first], np.nan)
    before = np.inf
    for _ in range(_ROUNDS):
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
        if abs(before - distance) <= _TOLERANCE * max(distance, 1e-300):
            break
        before = distance
    known = present & np.isfinite(shape).all(-1)
    return shape, *rigid_fits(np.nan_to_num(shape), points, known)
