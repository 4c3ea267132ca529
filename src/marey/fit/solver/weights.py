"""Robust weights of residuals, and the standard deviations of kinds of observations estimated from their residuals.

The a priori standard deviations of [Plaenkers1999] eq. (10)-(12) weigh kinds of observations against each other. Ours:
as in geodesy they are then estimated from the residuals ([Foerstner1979]): each kind's sum of squares is compared with
its redundancy.
"""

import numpy as np
import scipy.optimize

from marey.arrays import Floats
from marey.compiled.kernels import kernel

SCALE_IN_SD = 4.0
"""Robust scale in standard deviations of an observation: one twice as far has almost no weight. Chosen by hand."""


def geman_mcclure(residual: Floats, scale: float) -> Floats:
    """Weigh residuals by (1 + (r / scale)^2)^-2, so that distant ones have almost no weight.

    Args:
        residual: (n,) or (n, r); the length of a row counts.
        scale: Residual of weight 1/4, in the residual's unit.
    """
    squared = residual**2 if residual.ndim == 1 else (residual**2).sum(1)
    return 1.0 / (1.0 + squared / scale**2) ** 2


# Short: see `marey.compiled.kernels.kernel`.
@kernel(nogil=False)
def match_weights(rows, offsets, vertices, faces, face, barycentric, counts, scale):
    """Return the weights (n,) of `geman_mcclure` for residuals of points on faces, times counts.

    Args:
        rows: (n, r, 3), so that the residuals are rows p - offsets.
        offsets: (n, r).
        vertices: (V, 3) of the posed mesh.
        faces: (T, 3).
        face: (n,) face of each point.
        barycentric: (n, 3).
        counts: (n,).
        scale: Residual of weight 1/4, in the residual's unit.
    """
    out = np.empty(len(counts))
    for i in range(len(counts)):
        a, b, c = faces[face[i], 0], faces[face[i], 1], faces[face[i], 2]
        u, v, w = barycentric[i, 0], barycentric[i, 1], barycentric[i, 2]
        x = u * vertices[a, 0] + v * vertices[b, 0] + w * vertices[c, 0]
        y = u * vertices[a, 1] + v * vertices[b, 1] + w * vertices[c, 1]
        z = u * vertices[a, 2] + v * vertices[b, 2] + w * vertices[c, 2]
        square = 0.0
        for r in range(rows.shape[1]):
            square += (rows[i, r, 0] * x + rows[i, r, 1] * y + rows[i, r, 2] * z - offsets[i, r]) ** 2
        out[i] = counts[i] / (1.0 + square / scale**2) ** 2
    return out


def component_sd(residual: Floats, known: Floats, weight: Floats | None = None, *, left: float = 1.0) -> float:
    """Estimate a standard deviation that all observations of a kind have in addition to a known one each.

    It is the maximum-likelihood estimate under normal deviations, at which the weighted squares equal their
    expectation.

    Args:
        residual: (n,) in any unit.
        known: (n,) variances that are known beforehand, in the unit squared.
        weight: (n,) robust weights, all one if None.
        left: Redundancy as a share of the observations ([Foerstner1979]): one minus the parameters per observation.

    Returns:
        The standard deviation in the residuals' unit; zero if the known variances explain the residuals.
    """
    weight = np.ones(len(residual)) if weight is None else weight
    square = residual**2 / left
    total = float(np.sum(weight))
    if total == 0.0:
        return float("nan")

    def slope(variance: float) -> float:
        whole = known + variance
        return float(np.sum(weight * (whole - square) / whole**2))

    least, greatest = 0.0, float(np.max(square)) + 1e-30
    if np.min(known) <= 0.0:
        least = 1e-12 * greatest
    if slope(least) >= 0.0:
        return 0.0
    return float(np.sqrt(scipy.optimize.brentq(slope, least, greatest, rtol=1e-6)))
