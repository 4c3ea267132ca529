"""Closed-form shapes for known rotations that fit the tracks and change little from frame to frame."""

import numpy as np
import scipy.linalg

from marey.arrays import Floats

_STIFFNESS = 1e-3
"""Weight of the squared change of a coordinate between frames, relative to a squared residual of the tracks, both in
the tracks' unit. From the preliminary study, in which it was chosen with eight motion-capture sequences in view;
results were not measured against other values."""
_LEAST_STIFFNESS = 1e-9
"""Weight of a squared coordinate where the rotations do not determine depth, which then becomes 0; a numerical
threshold."""


def smooth_shapes(tracks: Floats, rotation: Floats) -> Floats:
    """Minimise the squared residuals of the tracks and the squared changes of the shape.

    Args:
        tracks: (F, 2, P) complete and centred in each frame.
        rotation: (F, 3, 3) camera from object.

    Returns:
        Shapes (F, 3, P) in the object's frame.
    """
    frames, _, points = tracks.shape
    rows = rotation[:, :2]
    neighbours = np.full(frames, 2.0)
    neighbours[[0, -1]] = 1
    diagonal = np.einsum("fki,fkj->fij", rows, rows) + _STIFFNESS * neighbours[:, None, None] * np.eye(3)
    band = np.zeros((4, 3 * frames))
    for i in range(3):
        for j in range(i, 3):
            band[j - i, i::3] = diagonal[:, j, i]
    band[3, : 3 * (frames - 1)] = -_STIFFNESS
    right = np.einsum("fki,fkp->fip", rows, tracks).reshape(3 * frames, points)
    try:
        solved = scipy.linalg.solveh_banded(band, right, lower=True, check_finite=False)
    except np.linalg.LinAlgError:
        band[0] += _LEAST_STIFFNESS
        solved = scipy.linalg.solveh_banded(band, right, lower=True, check_finite=False)
    return np.asarray(solved.reshape(frames, 3, points))


def nuclear_norm(shapes: Floats) -> float:
    """Sum the singular values of shapes (F, 3, P), one row per frame ([Dai2012]); small for few basis shapes."""
    rows = shapes.reshape(len(shapes), -1)
    square = rows @ rows.T if len(rows) < rows.shape[1] else rows.T @ rows
    return float(np.sqrt(np.maximum(np.linalg.eigvalsh(square), 0)).sum())
