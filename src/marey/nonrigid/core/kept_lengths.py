"""Distances between points of a deforming object that stay nearly constant, as additional observations.

Where the camera rotates slowly, only the smoothness of the model constrains depth. Points of one limb, or neighbours on
skin, keep their distance; which pairs do, and how well, is estimated with the shapes. A small number of basis shapes
does not imply this: a deformation mode that rotates a limb also stretches it.
"""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Integers, freeze_fields

_LEAST_LENGTH = 1e-12
"""Added to distances before division by them; keeps coinciding points harmless."""


@dataclass(frozen=True, kw_only=True)
class KeptLengthSettings:
    """Settings of the distances that are taken to be constant."""

    neighbours: int = 6
    """Number of distances selected for each point: those that vary least. Chosen by hand; results were not measured
    against other values."""
    least_sd: float = 0.01
    """Least standard deviation of a distance, as a fraction of the object's size. Without it the weight of a wrong
    distance grows with each round (docs/explanation/nonrigid.md, "What was tried")."""
    correlated_frames: float = 20
    """Number of frames over which departures from a distance are correlated; so many frames count as one observation.
    With 5 depth improved by a third before slow cameras, but was worse for `pickup` (docs/explanation/nonrigid.md)."""


@dataclass(frozen=True, eq=False, kw_only=True)
class KeptLengths:
    """Pairs of points with their mean distance and its variance, as fractions of the object's size."""

    pairs: Integers
    """(Q, 2) indices of points."""
    lengths: Floats
    """(Q,) mean distances."""
    variances: Floats
    """(Q,) variance of each distance over the frames."""
    settings: KeptLengthSettings = KeptLengthSettings()
    """Settings with which the distances were selected."""

    def __post_init__(self) -> None:
        freeze_fields(self, "pairs", dtype=np.int64)
        freeze_fields(self, "lengths", "variances")

    @property
    def precisions(self) -> Floats:
        """(Q,) weight of a squared departure in one frame."""
        return np.asarray(1 / (self.variances * self.settings.correlated_frames))

    def incidence(self, points: int) -> Floats:
        """Compute the incidence matrix (Q, P): 1 at the first point of a pair, -1 at the second."""
        matrix, rows = np.zeros((len(self.pairs), points)), np.arange(len(self.pairs))
        matrix[rows, self.pairs[:, 0]], matrix[rows, self.pairs[:, 1]] = 1, -1
        return matrix


def choose_lengths(shapes: Floats, settings: KeptLengthSettings = KeptLengthSettings()) -> KeptLengths:
    """Select for each point the distances that vary least over the frames.

    Args:
        shapes: (F, 3, P), of size 1.
        settings: Number of distances per point and their variance.
    """
    points = shapes.shape[2]
    sd = np.full((points, points), np.inf)
    for i in range(points - 1):
        away = np.linalg.norm(shapes[:, :, i + 1 :] - shapes[:, :, i : i + 1], axis=1)
        sd[i, i + 1 :] = sd[i + 1 :, i] = away.std(0)
    near = np.argsort(sd, 1)[:, : min(settings.neighbours, points - 1)]
    ends = np.stack([np.repeat(np.arange(points), near.shape[1]), near.ravel()], 1)
    return estimated_lengths(np.unique(np.sort(ends, 1), axis=0), shapes, settings=settings)


def estimated_lengths(
    pairs: Integers,
    shapes: Floats,
    uncertainty: Floats | float = 0.0,
    *,
    settings: KeptLengthSettings = KeptLengthSettings(),
) -> KeptLengths:
    """Estimate the mean and the variance of distances.

    Args:
        pairs: (Q, 2) indices of points.
        shapes: (F, 3, P).
        uncertainty: (Q,) mean variance of the distances' estimates, added to that over the frames.
        settings: Least variance.
    """
    away = np.linalg.norm(shapes[:, :, pairs[:, 0]] - shapes[:, :, pairs[:, 1]], axis=1)
    variances = away.var(0) + uncertainty + settings.least_sd**2
    return KeptLengths(pairs=pairs, lengths=away.mean(0), variances=variances, settings=settings)


def departures(kept: KeptLengths, shapes: Floats) -> tuple[Floats, Floats]:
    """Compute the excess length of each pair (F, Q) and its direction (F, 3, Q), from the second point to the first."""
    apart = shapes[:, :, kept.pairs[:, 0]] - shapes[:, :, kept.pairs[:, 1]]
    away = np.linalg.norm(apart, axis=1) + _LEAST_LENGTH
    return away - kept.lengths, apart / away[:, None]


def derivatives(kept: KeptLengths, along: Floats, modes: Floats) -> Floats:
    """Compute the derivatives (F, Q, M) of distances by the weights of the modes (M, 3, P)."""
    apart = modes[:, :, kept.pairs[:, 0]] - modes[:, :, kept.pairs[:, 1]]
    return np.asarray(np.swapaxes(along.transpose(2, 0, 1) @ apart.transpose(2, 1, 0), 0, 1))


def weight_equations(kept: KeptLengths, shapes: Floats, modes: Floats) -> tuple[Floats, Floats]:
    """Compute normal matrices (F, M, M) and right-hand sides (F, M) of the weights."""
    longer, along = departures(kept, shapes)
    by_weight = derivatives(kept, along, modes)
    weighed = np.swapaxes(by_weight * kept.precisions[:, None], 1, 2)
    return weighed @ by_weight, -(weighed @ longer[:, :, None])[..., 0]


def point_equations(kept: KeptLengths, shapes: Floats) -> tuple[Floats, Floats]:
    """Compute normal matrices (F, P, 3, 3) and right-hand sides (F, 3, P) of each point, the others being fixed."""
    longer, along = departures(kept, shapes)
    ends = kept.incidence(shapes.shape[2])
    right = -((kept.precisions * longer)[:, None] * along) @ ends
    squares = (along[:, :, None] * along[:, None] * kept.precisions).reshape(len(shapes), 9, -1) @ np.abs(ends)
    return np.moveaxis(squares, 1, 2).reshape(*squares.shape[::2], 3, 3), right


def cost(kept: KeptLengths, shapes: Floats) -> float:
    """Compute minus the log-probability of the distances, up to a constant."""
    longer, _ = departures(kept, shapes)
    observations = len(shapes) / kept.settings.correlated_frames
    return float((longer**2 * kept.precisions).sum() + observations * np.log(kept.variances).sum()) / 2
