"""What is measured of the places of points in space: the places themselves, or what tells as much about them."""

from typing import Protocol, Self

import numpy as np

from marey.arrays import Floats, Mask


class MeasuredPlaces(Protocol):
    """P points over F frames, of which something is measured."""

    @property
    def seen(self) -> Mask:
        """(F, P) whether anything is measured."""
        ...

    @property
    def coordinates(self) -> int:
        """How many coordinates are measured; more than three of one place count as three."""
        ...

    @property
    def known(self) -> Floats:
        """(F, P, 3) the places that the measurements tell by themselves; NaN elsewhere."""
        ...

    def equations(self, model: Floats, variance: float) -> tuple[Floats, Floats]:
        """Say what the measurements want of the model.

        Args:
            model: (F, P, 3) the model's places.
            variance: of a coordinate of a point about its place by the model.

        Returns:
            Information (F, P, 3, 3) about the model's places, never more than 1 / variance, or (F, P, 1, 1) where it is
            the same in all directions, and the pull (F, P, 3), information times measured less model; zero where
            nothing is measured.
        """
        ...

    def placed(self, mean: Floats, rotation: Floats, translation: Floats) -> tuple[Floats, Floats, Floats]:
        """Give places and poses to what the known places alone leave without.

        Args:
            mean: (P, 3) the mean shape; NaN where not known.
            rotation: (F, 3, 3) laboratory from object; NaN where not known.
            translation: (F, 3).

        Returns:
            The three, with as many more as can be begun with.
        """
        ...

    @property
    def known_variance(self) -> Floats:
        """(F, P) sum of the three variances that the known places have of their own."""
        ...

    def squares(self, model: Floats) -> Floats:
        """Give the squared distance (F, P) of what is measured from the model's, in its own unit; NaN elsewhere."""
        ...

    def without(self, hidden: Mask) -> Self:
        """Take what is measured of some places (F, P) out."""
        ...

    def among(self, frames: Mask, points: Mask) -> Self:
        """Keep some frames (F,) and points (P,) alone."""
        ...


class PointsInSpace:
    """Places that are measured whole, all equally well.

    Args:
        points: (F, P, 3); NaN where missing.
    """

    def __init__(self, points: Floats) -> None:
        self._seen: Mask = np.asarray(np.isfinite(points).all(-1))
        self._filled = np.where(self._seen[..., None], points, 0.0)

    @property
    def seen(self) -> Mask:
        """(F, P)."""
        return self._seen

    @property
    def coordinates(self) -> int:
        """Three a point."""
        return 3 * int(self._seen.sum())

    @property
    def known(self) -> Floats:
        """(F, P, 3) the points."""
        return np.where(self._seen[..., None], self._filled, np.nan)

    def equations(self, model: Floats, variance: float) -> tuple[Floats, Floats]:
        """Give 1 / variance as information (F, P, 1, 1), and the pull (F, P, 3)."""
        information = self._seen[..., None] / variance
        return information[..., None], (self._filled - model) * information

    def placed(self, mean: Floats, rotation: Floats, translation: Floats) -> tuple[Floats, Floats, Floats]:
        """Give all as it is: what has no place among the points has none."""
        return mean, rotation, translation

    @property
    def known_variance(self) -> Floats:
        """(F, P) none."""
        return np.zeros(self._seen.shape)

    def squares(self, model: Floats) -> Floats:
        """Give the squared distances in space (F, P)."""
        return np.asarray(((self.known - model) ** 2).sum(-1))

    def without(self, hidden: Mask) -> "PointsInSpace":
        """Take points out."""
        return PointsInSpace(np.where(hidden[..., None], np.nan, self.known))

    def among(self, frames: Mask, points: Mask) -> "PointsInSpace":
        """Keep some frames and points."""
        return PointsInSpace(self.known[np.ix_(frames, points)])


def departures(places: MeasuredPlaces, model: Floats, variance: float) -> tuple[Floats, Floats]:
    """Say where measured points lie by model and measurements together.

    Args:
        places: What is measured.
        model: (F, P, 3).
        variance: of a coordinate about the model.

    Returns:
        How far from the model (F, P, 3), and the sum of its three variances (F, P); zero where not measured.
    """
    information, pull = places.equations(model, variance)
    told = np.trace(information, axis1=2, axis2=3) * (3 if information.shape[-1] == 1 else 1)
    return variance * pull, np.where(places.seen, variance * (3 - variance * told), 0.0)
