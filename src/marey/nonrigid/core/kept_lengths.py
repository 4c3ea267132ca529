"""Distances between points of a deforming object that hardly change: what limbs and skin tell beside the tracks.

Where the camera goes round slowly, depth is told by little but the model's own smoothness. Points of one limb, or next
to each other on skin, keep their distance; which do, and how well, is learned with the shapes. Few basis shapes do not
say this: a displacement that turns a limb also stretches it.
"""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Integers

NEIGHBOURS = 6
"""Distances of each point that are believed to be kept: those that change least, in its own row of distances."""
STIFFEST = 0.01
"""Least standard deviation of a kept distance that is believed, as a share of the object's size: without it a distance
that is wrong would be believed the more the longer it is held."""
LIKE_FRAMES = 20
"""Frames over which departures from a distance are alike: so many say as much as one."""
LEAST = 1e-12


@dataclass(frozen=True, eq=False, kw_only=True)
class KeptLengths:
    """Pairs of points and how well their distance is kept; lengths in the unit of the object's size."""

    pairs: Integers
    """(Q, 2)."""
    lengths: Floats
    """(Q,)."""
    variances: Floats
    """(Q,) of the distance over the frames."""

    @property
    def precisions(self) -> Floats:
        """(Q,) weight of a squared departure in one frame."""
        return np.asarray(1 / (self.variances * LIKE_FRAMES))

    def incidence(self, points: int) -> Floats:
        """Give (Q, P): 1 at the first point of a pair, -1 at the second."""
        matrix, rows = np.zeros((len(self.pairs), points)), np.arange(len(self.pairs))
        matrix[rows, self.pairs[:, 0]], matrix[rows, self.pairs[:, 1]] = 1, -1
        return matrix


def choose_lengths(shapes: Floats) -> KeptLengths:
    """Take of each point the distances that change least over the frames of the shapes (F, 3, P)."""
    points = shapes.shape[2]
    spread = np.full((points, points), np.inf)
    for i in range(points - 1):
        away = np.linalg.norm(shapes[:, :, i + 1 :] - shapes[:, :, i : i + 1], axis=1)
        spread[i, i + 1 :] = spread[i + 1 :, i] = away.std(0)
    near = np.argsort(spread, 1)[:, : min(NEIGHBOURS, points - 1)]
    ends = np.stack([np.repeat(np.arange(points), near.shape[1]), near.ravel()], 1)
    return learned(np.unique(np.sort(ends, 1), axis=0), shapes)


def learned(pairs: Integers, shapes: Floats, doubt: Floats | float = 0.0) -> KeptLengths:
    """Learn lengths and variances; `doubt` (Q,) is the mean variance of what is not known of the distances."""
    away = np.linalg.norm(shapes[:, :, pairs[:, 0]] - shapes[:, :, pairs[:, 1]], axis=1)
    return KeptLengths(pairs=pairs, lengths=away.mean(0), variances=away.var(0) + doubt + STIFFEST**2)


def departures(kept: KeptLengths, shapes: Floats) -> tuple[Floats, Floats]:
    """Give how much too long each pair is (F, Q), and its direction (F, 3, Q), from the second point to the first."""
    apart = shapes[:, :, kept.pairs[:, 0]] - shapes[:, :, kept.pairs[:, 1]]
    away = np.linalg.norm(apart, axis=1) + LEAST
    return away - kept.lengths, apart / away[:, None]


def derivatives(kept: KeptLengths, along: Floats, modes: Floats) -> Floats:
    """Give the distances' derivatives (F, Q, M) by the weights of the modes (M, 3, P)."""
    apart = modes[:, :, kept.pairs[:, 0]] - modes[:, :, kept.pairs[:, 1]]
    return np.asarray(np.swapaxes(along.transpose(2, 0, 1) @ apart.transpose(2, 1, 0), 0, 1))


def weight_equations(kept: KeptLengths, shapes: Floats, modes: Floats) -> tuple[Floats, Floats]:
    """Give normal matrices (F, M, M) and right sides (F, M) of the weights."""
    longer, along = departures(kept, shapes)
    by_weight = derivatives(kept, along, modes)
    weighed = np.swapaxes(by_weight * kept.precisions[:, None], 1, 2)
    return weighed @ by_weight, -(weighed @ longer[:, :, None])[..., 0]


def point_equations(kept: KeptLengths, shapes: Floats) -> tuple[Floats, Floats]:
    """Give normal matrices (F, P, 3, 3) and right sides (F, 3, P) of every point's place, the others held."""
    longer, along = departures(kept, shapes)
    ends = kept.incidence(shapes.shape[2])
    right = -((kept.precisions * longer)[:, None] * along) @ ends
    squares = (along[:, :, None] * along[:, None] * kept.precisions).reshape(len(shapes), 9, -1) @ np.abs(ends)
    return np.moveaxis(squares, 1, 2).reshape(*squares.shape[::2], 3, 3), right


def cost(kept: KeptLengths, shapes: Floats) -> float:
    """Give minus the logarithm of the distances' probability, up to a constant."""
    longer, _ = departures(kept, shapes)
    return float((longer**2 * kept.precisions).sum() + len(shapes) / LIKE_FRAMES * np.log(kept.variances).sum()) / 2
