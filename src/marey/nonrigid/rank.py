"""How many basis shapes points in space need: by points held back, which [Alexander2003] leaves open."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Integers, Mask, frozen
from marey.errors import MareyError
from marey.nonrigid.homogeneous import factorise_points

HELD_BACK = 0.1
"""Share of the points that a round holds back, each for itself."""
ROUNDS = 3
MOST = 12


@dataclass(frozen=True, eq=False, kw_only=True)
class RankChoice:
    """The number of basis shapes chosen, and the curve it was chosen by."""

    rank: int
    """K, with the mean."""
    ranks: Integers
    """(N,) the numbers that were tried."""
    held_out_rms: Floats
    """(N,) root mean square distance of the points held back from what the others foretell, in their unit."""
    held_out_sd: Floats
    """(N,) standard deviation of that over the rounds."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "ranks", frozen(self.ranks, np.int64))
        for name in ("held_out_rms", "held_out_sd"):
            object.__setattr__(self, name, frozen(getattr(self, name)))


def choose_rank(points: Floats, *, most: int = MOST, seed: int = 0) -> RankChoice:
    """Choose the number of basis shapes that foretells held-back points best; of equals the smallest.

    Args:
        points: (F, P, 3); NaN where missing.
        most: the largest number tried.
        seed: of the choice of what is held back.

    Raises:
        MareyError: There are too few frames or points for the rigid fit, once some are held back.
    """
    points = np.asarray(points, float)
    rng = np.random.default_rng(seed)
    present: Mask = np.asarray(np.isfinite(points).all(-1))
    hidden = [_hidden(present, rng) for _ in range(ROUNDS)]
    ranks, errors = [], []
    for rank in range(1, most + 1):
        try:
            errors.append([_foretold(points, gone, rank) for gone in hidden])
        except MareyError:
            if rank == 1:
                raise
            break
        ranks.append(rank)
    squares = np.sqrt(np.array(errors))
    rms, sd = squares.mean(1), squares.std(1, ddof=1)
    best = int(rms.argmin())
    enough = rms <= rms[best] + sd[best] / np.sqrt(ROUNDS)
    return RankChoice(rank=ranks[int(enough.argmax())], ranks=np.array(ranks), held_out_rms=rms, held_out_sd=sd)


def _hidden(present: Mask, rng: np.random.Generator) -> Mask:
    """Choose what is held back: every frame keeps at least four points, or what it has."""
    gone = present & (rng.random(present.shape) < HELD_BACK)
    gone[(present & ~gone).sum(1) < 4] = False
    return np.asarray(gone)


def _foretold(points: Floats, gone: Mask, rank: int) -> float:
    found = factorise_points(np.where(gone[..., None], np.nan, points), rank)
    wrong = ((found.points - points) ** 2).sum(-1)[gone]
    return float(np.nanmean(wrong))


def significant_singular_values(values: Floats, shape: tuple[int, int]) -> int:
    """Count the singular values that white noise of unknown size does not explain ([Gavish2014], their polynomial).

    Args:
        values: all singular values of a matrix, in falling order.
        shape: of the matrix.
    """
    ratio = min(shape) / max(shape)
    factor = 0.56 * ratio**3 - 0.95 * ratio**2 + 1.82 * ratio + 1.43
    return int((values > factor * np.median(values)).sum())
