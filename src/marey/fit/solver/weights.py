"""Robust weights of residuals, and the uncertainty of each kind of observation estimated from its residuals.

The a priori standard deviations of [Plaenkers1999] eq. (10)-(12) weigh kinds of observations against each other. Ours:
as in geodesy they are then estimated from the residuals ([Foerstner1979]), each kind's sum of squares over what the fit
left it free to have.
"""

import numpy as np
import scipy.optimize

from marey.arrays import Floats


def geman_mcclure(residual: Floats, scale: float) -> Floats:
    """Weigh residuals by (1 + (r / scale)^2)^-2: far ones fade out altogether.

    Args:
        residual: (n,) or (n, r); rows count by their length.
        scale: the length at which an observation counts a quarter, in the residual's unit.
    """
    squared = residual**2 if residual.ndim == 1 else (residual**2).sum(1)
    return 1.0 / (1.0 + squared / scale**2) ** 2


def component(residual: Floats, known: Floats, weight: Floats | None = None, *, left: float = 1.0) -> float:
    """Estimate a standard deviation that all observations of a kind have on top of a known one each.

    The most likely one under normal deviations: what it predicts for the weighted squares is what they are.

    Args:
        residual: (n,) in any unit.
        known: (n,) variances that are known beforehand, in the unit squared.
        weight: (n,) robust weights, all one when None.
        left: share of the observations that the fit left over ([Foerstner1979]), what parameters took taken off.

    Returns:
        In the residuals' unit; zero where the known variances explain them.
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
