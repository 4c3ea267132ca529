"""B-spline patches: smooth sheets, closed or open, through a grid of points."""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import make_interp_spline

from marey.arrays import Floats, freeze_fields


@dataclass(frozen=True, eq=False, kw_only=True)
class SplinePatch:
    """A bicubic B-spline through a grid of points, twice continuously differentiable.

    Unlike [Plaenkers1999] section 3.1, whose samples are control points, the samples are interpolated: a B-spline of
    control points lies inside a convex surface by a sixth of its curvature times the squared distance of the samples.
    """

    around: Floats
    """(A + 1,) parameter of each column, ascending; at the last one the patch closes at its first column."""
    along: Floats
    """(B,) parameter of each row, ascending."""
    points: Floats
    """(B, A, 3) [m], at the parameters `along` and the first A of `around`."""

    def __post_init__(self) -> None:
        freeze_fields(self, "around", "along", "points")

    def at(self, around: Floats, along: Floats) -> Floats:
        """Return the points (b, a, 3) at parameters around (a,) and along (b,)."""
        closed = np.concatenate([self.points, self.points[:, :1]], axis=1)
        rows = make_interp_spline(self.around, closed, k=3, axis=1, bc_type="periodic")(around)
        return np.asarray(make_interp_spline(self.along, rows, k=3, axis=0)(along))


def curve_at(parameter: Floats, points: Floats, wanted: Floats) -> Floats:
    """Return points (b, 3) of the cubic spline curve through points (B, 3) at ascending parameters (B,)."""
    return np.asarray(make_interp_spline(parameter, points, k=3, axis=0)(wanted))


def chord_lengths(points: Floats) -> Floats:
    """Return each row's distance (B,) from the first one along the patch: the mean of its columns' chords [m]."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=2).mean(1)
    return np.concatenate([[0.0], np.cumsum(steps)])
