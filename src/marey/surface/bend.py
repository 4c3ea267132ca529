"""Bent patches: an affine map cannot follow a curved surface, and what it makes of the middle is taken back."""

import numpy as np

from marey.arrays import Floats, Mask
from marey.surface.field import Field, Grid

_MOST = 0.3
"""A correction beyond this is none: the maps belong to different surfaces [px]."""


def unbent(field: Field, grid: Grid) -> Field:
    """Correct matches for the bend of the surface under their patches.

    Ours. Where the displacement u of the search picture bends, u = u0 + A x + x'Q x / 2, the best affine map puts the
    middle of the patch at u0 + s (Q_xx + Q_yy) / 2, s being the mean square of its pixels' x. How the maps A change
    from patch to patch tells Q.

    Args:
        field: What was found.
        grid: Its nodes.

    Returns:
        The same with places corrected, where maps on both sides, in x and in y, are known.
    """
    maps = field.maps.reshape(grid.rows, grid.columns, 2, 2)
    away = np.full((len(grid), 2), np.nan)
    for size in np.unique(field.size[field.found]):
        half, some = (size - 1) / 2, field.size == size
        # Larger patches stand where maps are uncertain; theirs change over a longer way.
        pairs = max(1, round(half / grid.spacing))
        bend = _slope(maps[..., 0], grid.spacing, pairs, axis=1) + _slope(maps[..., 1], grid.spacing, pairs, axis=0)
        away[some] = 0.5 * half * (half + 1) / 3 * bend.reshape(-1, 2)[some]
    usable = np.linalg.norm(np.nan_to_num(away, nan=np.inf), axis=1) <= _MOST
    return Field(
        there=field.there - np.where(usable[:, None], away, 0.0), maps=field.maps, covariance=field.covariance,
        correlation=field.correlation, size=field.size,
    )  # fmt: skip


def _slope(values: Floats, spacing: int, pairs: int, *, axis: int) -> Floats:
    """Differentiate a grid (R, C, 2) along an axis, by as many pairs of nodes about each as there are [1/px]."""
    values = np.moveaxis(values, axis, 0)
    total, weight = np.zeros(values.shape), np.zeros(values.shape[:2])
    for k in range(1, pairs + 1):
        if len(values) <= 2 * k:
            break
        step = values[2 * k :] - values[: -2 * k]
        known: Mask = np.asarray(np.isfinite(step).all(axis=-1))
        # The slope's variance falls with the square of the distance.
        total[k:-k] += np.where(known[..., None], 2 * k / spacing * step, 0.0)
        weight[k:-k] += np.where(known, (2.0 * k) ** 2, 0.0)
    slope = np.divide(total, weight[..., None], out=np.full(values.shape, np.nan), where=weight[..., None] > 0)
    return np.moveaxis(slope, 0, axis)
