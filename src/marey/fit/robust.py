"""Robust weights: how much an observation counts that lies far from its prediction."""

from marey.arrays import Floats


def geman_mcclure(residual: Floats, scale: float) -> Floats:
    """Weigh residuals by (1 + (r / scale)^2)^-2: far ones fade out altogether.

    Args:
        residual: (n,) or (n, r); rows count by their length.
        scale: the length at which an observation counts a quarter, in the residual's unit.
    """
    squared = residual**2 if residual.ndim == 1 else (residual**2).sum(1)
    return 1.0 / (1.0 + squared / scale**2) ** 2
