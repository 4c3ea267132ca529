"""Measurements of points in space: their positions, or equations that constrain them."""

from typing import Protocol, Self

import numpy as np

from marey.arrays import Floats, Mask


class MeasuredPlaces(Protocol):
    """Measurements of P points over F frames."""

    @property
    def seen(self) -> Mask:
        """(F, P) mask of the points with a measurement."""
        ...

    @property
    def coordinates(self) -> int:
        """Number of measured coordinates; more than three of one point count as three."""
        ...

    @property
    def known(self) -> Floats:
        """(F, P, 3) positions that the measurements determine by themselves; NaN elsewhere."""
        ...

    def equations(self, model: Floats, variance: float) -> tuple[Floats, Floats]:
        """Compute the normal equations of the measurements for the model's positions.

        Args:
            model: (F, P, 3) positions of the model.
            variance: Variance of a point's coordinate about the model.

        Returns:
            Information (F, P, 3, 3) about the model's positions, never more than 1 / variance, or (F, P, 1, 1) where it
            is isotropic; and the right-hand side (F, P, 3), information times measurement minus model. Zero where
            nothing is measured.
        """
        ...

    def placed(self, mean: Floats, rotation: Floats, translation: Floats) -> tuple[Floats, Floats, Floats]:
        """Initialise positions and poses that the known positions alone do not determine.

        Args:
            mean: (P, 3) mean shape; NaN where unknown.
            rotation: (F, 3, 3) laboratory from object; NaN where unknown.
            translation: (F, 3) object's origin in the laboratory.

        Returns:
            The three arrays with further values filled in.
        """
        ...

    @property
    def known_variance(self) -> Floats:
        """(F, P) trace of the covariance of the known positions."""
        ...

    def squares(self, model: Floats) -> Floats:
        """Compute squared distances (F, P) of measurements from the model, in their own unit; NaN elsewhere."""
        ...

    def without(self, hidden: Mask) -> Self:
        """Return the measurements without those in the mask (F, P)."""
        ...

    def among(self, frames: Mask, points: Mask) -> Self:
        """Return the measurements of some frames (F,) and points (P,)."""
        ...


class PointsInSpace:
    """Fully measured points of equal accuracy.

    Args:
        points: (F, P, 3); NaN where missing.
    """

    def __init__(self, points: Floats) -> None:
        self._seen: Mask = np.asarray(np.isfinite(points).all(-1))
        self._filled = np.where(self._seen[..., None], points, 0.0)

    @property
    def seen(self) -> Mask:
        """(F, P) mask of the points present."""
        return self._seen

    @property
    def coordinates(self) -> int:
        """Three per point."""
        return 3 * int(self._seen.sum())

    @property
    def known(self) -> Floats:
        """(F, P, 3) points; NaN where missing."""
        return np.where(self._seen[..., None], self._filled, np.nan)

    def equations(self, model: Floats, variance: float) -> tuple[Floats, Floats]:
        """Compute the information 1 / variance (F, P, 1, 1) and the right-hand side (F, P, 3)."""
        information = self._seen[..., None] / variance
        return information[..., None], (self._filled - model) * information

    def placed(self, mean: Floats, rotation: Floats, translation: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the arguments: missing points remain without a position."""
        return mean, rotation, translation

    @property
    def known_variance(self) -> Floats:
        """(F, P) zeros."""
        return np.zeros(self._seen.shape)

    def squares(self, model: Floats) -> Floats:
        """Compute the squared distances in space (F, P)."""
        return np.asarray(((self.known - model) ** 2).sum(-1))

    def without(self, hidden: Mask) -> "PointsInSpace":
        """Return the points without those in the mask."""
        return PointsInSpace(np.where(hidden[..., None], np.nan, self.known))

    def among(self, frames: Mask, points: Mask) -> "PointsInSpace":
        """Return some frames and points."""
        return PointsInSpace(self.known[np.ix_(frames, points)])


def departures(places: MeasuredPlaces, model: Floats, variance: float) -> tuple[Floats, Floats]:
    """Estimate the displacement of measured points from the model, given model and measurements.

    Args:
        places: Measured points.
        model: (F, P, 3) positions of the model.
        variance: Variance of a coordinate about the model.

    Returns:
        Displacement from the model (F, P, 3), and the trace of its covariance (F, P); zero where not measured.
    """
    information, pull = places.equations(model, variance)
    total = np.trace(information, axis1=2, axis2=3) * (3 if information.shape[-1] == 1 else 1)
    return variance * pull, np.where(places.seen, variance * (3 - variance * total), 0.0)
