"""Robust weights of residuals, and the standard deviations of kinds of observations estimated from their residuals.

The a priori standard deviations of [Plaenkers1999] eq. (10)-(12) weigh kinds of observations against each other. Ours:
as in geodesy they are then estimated from the residuals ([Foerstner1979]): each kind's sum of squares is compared with
its redundancy.
"""

import numpy as np
import scipy.optimize

from marey.arrays import Floats

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
