"""How many basis shapes points in space need: by points held back, which [Alexander2003] leaves open."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Integers, Mask, freeze_fields
from marey.nonrigid.in_space.errors import pose_variance, shape_covariance
from marey.nonrigid.in_space.measured_places import MeasuredPlaces, PointsInSpace
from marey.nonrigid.in_space.model import HomogeneousModel, improve, with_more_modes
from marey.nonrigid.in_space.start import most_shapes, start

HELD_BACK = 0.1
"""Share of the points that a round holds back."""
LONGEST_RUN = 30
"""Of frames in which a point is hidden, or a tenth of all frames."""
ROUNDS = 3
MOST = 30
MOST_FRAMES = 400
"""Of more frames, so many are judged, evenly spread."""
HOPELESS = 4
"""After so many numbers in succession that foretell worse than the best, no larger one is tried."""
KEPT_IN_FRAME = 4
"""A frame keeps so many points, or what it has."""
OUTLIER = 25.0
"""A point held back whose squared distance is more than so many times the usual one says nothing of the others."""
_SOLVES, _STILL = 20, 0.02
"""How well the model is solved before it is judged."""


@dataclass(frozen=True, eq=False, kw_only=True)
class RankChoice:
    """The number of basis shapes chosen, and the curve it was chosen by."""

    rank: int
    """K, with the mean."""
    ranks: Integers
    """(N,) the numbers that were tried."""
    held_out_rms: Floats
    """(N,) root mean square distance of what was held back from what the rest foretells, in its unit: that of the
    points, or pixels where points are measured in pictures."""
    held_out_sd: Floats
    """(N,) standard deviation of that over the rounds."""
    farther: float
    """How many times farther off than the model states points lie that were hidden for a while, at the chosen rank; at
    least 1."""

    def __post_init__(self) -> None:
        freeze_fields(self, "ranks", dtype=np.int64)
        freeze_fields(self, "held_out_rms", "held_out_sd")


@dataclass
class _Round:
    """A model that has not seen what is held back, and how well it foretells that."""

    whole: MeasuredPlaces
    """Frames and points of the model, with what is held back."""
    rest: MeasuredPlaces
    gone: Mask
    model: HomogeneousModel

    def grow(self, count: int) -> None:
        """Give the model more modes, and solve it well enough to be judged."""
        self.model = with_more_modes(self.model, self.rest, count)
        improve(self.model, self.rest, rounds=_SOLVES, still=_STILL)

    def error(self) -> float:
        """Give the root mean square distance of what was held back; outliers count as five times the usual one."""
        squares = self.whole.squares(self.model.places)[self.gone]
        return float(np.sqrt(np.nanmean(np.minimum(squares, OUTLIER * np.nanmedian(squares)))))

    def farther(self) -> tuple[Floats, Floats]:
        """Give the squared distances in space of points held back beyond noise and pose, and the stated variances."""
        squares = ((self.whole.known - self.model.places) ** 2).sum(-1)[self.gone]
        stated = np.trace(shape_covariance(self.model, self.rest), axis1=2, axis2=3)[self.gone]
        noise = 3 * self.model.variance + self.whole.known_variance + pose_variance(self.model)
        known = noise[self.gone]
        usual = squares < OUTLIER * np.nanmedian(squares / (known + stated)) * (known + stated)
        return (squares - known)[usual], stated[usual]


def choose_rank(points: Floats, *, most: int = MOST, seed: int = 0) -> RankChoice:
    """Choose the number of basis shapes that foretells held-back points best; of equals the smallest.

    Args:
        points: (F, P, 3); NaN where missing.
        most: the largest number tried.
        seed: of the choice of what is held back.

    Raises:
        MareyError: There are too few frames or points for the rigid fit, once some are held back.
    """
    return choose_rank_of(PointsInSpace(points), most=most, seed=seed)


def choose_rank_of(places: MeasuredPlaces, *, most: int = MOST, seed: int = 0) -> RankChoice:
    """Choose the number of basis shapes as `choose_rank` does, for places however they are measured."""
    rng = np.random.default_rng(seed)
    places = _thinned(places)
    rounds = [_begin(places, _hidden(places.seen, rng)) for _ in range(ROUNDS)]
    if any(not one.gone.any() for one in rounds):  # too few points to do without any: a rigid shape is all they tell
        nothing = np.full(1, np.nan)
        return RankChoice(rank=1, ranks=np.ones(1, np.int64), held_out_rms=nothing, held_out_sd=nothing, farther=1.0)
    most = min(most, *(most_shapes(one.rest) for one in rounds))
    ranks, errors = [1], [[one.error() for one in rounds]]
    while ranks[-1] < most and ranks[-1] - ranks[int(np.mean(errors, 1).argmin())] < HOPELESS:
        for one in rounds:
            one.grow(1)
        ranks.append(ranks[-1] + 1)
        errors.append([one.error() for one in rounds])
    rms, sd = np.mean(errors, 1), np.std(errors, 1, ddof=1)
    best = int(rms.argmin())
    rank = ranks[int((rms <= rms[best] + sd[best] / np.sqrt(ROUNDS)).argmax())]
    farther = _farther([_begin(places, _hidden_runs(places.seen, rng)) for _ in range(ROUNDS)], rank)
    return RankChoice(rank=rank, ranks=np.array(ranks), held_out_rms=rms, held_out_sd=sd, farther=farther)


def _thinned(places: MeasuredPlaces) -> MeasuredPlaces:
    """Keep so many frames, evenly spread, as suffice to judge."""
    frames, points = places.seen.shape
    if frames <= MOST_FRAMES:
        return places
    chosen = np.zeros(frames, bool)
    chosen[np.linspace(0, frames - 1, MOST_FRAMES).astype(int)] = True
    return places.among(chosen, np.ones(points, bool))


def _begin(places: MeasuredPlaces, gone: Mask) -> _Round:
    """Fit the rigid shape to what is not held back."""
    rest = places.without(gone)
    model, frames, points = start(rest)
    one = _Round(places.among(frames, points), rest.among(frames, points), gone[np.ix_(frames, points)], model)
    one.grow(0)
    return one


def _hidden(seen: Mask, rng: np.random.Generator) -> Mask:
    """Hold places back, each for itself."""
    return _enough_left(seen, rng.random(seen.shape) < HELD_BACK)


def _hidden_runs(seen: Mask, rng: np.random.Generator) -> Mask:
    """Hold places back in runs of frames, as gaps come."""
    frames, points = seen.shape
    gone = np.zeros(seen.shape, bool)
    longest = min(LONGEST_RUN, max(frames // 10, 1))
    for _ in range(int(2 * HELD_BACK * frames * points / (1 + longest)) + 1):
        begin, length, point = rng.integers(frames), rng.integers(1, longest + 1), rng.integers(points)
        gone[begin : begin + length, point] = True
    return _enough_left(seen, gone)


def _enough_left(seen: Mask, gone: Mask) -> Mask:
    gone = seen & gone
    gone[(seen & ~gone).sum(1) < KEPT_IN_FRAME] = False
    return np.asarray(gone)


def _farther(rounds: list[_Round], rank: int) -> float:
    """Say how many times farther off than stated points are that were hidden in runs; at least 1.

    Gaps hide whole postures, and a model knows its errors only where it has seen them.
    """
    for one in rounds:
        if 1 < rank <= most_shapes(one.rest):
            one.grow(rank - 1)
    beyond, stated = (np.concatenate(values) for values in zip(*(one.farther() for one in rounds), strict=True))
    return float(np.sqrt(max(beyond.sum() / stated.sum(), 1.0))) if len(stated) else 1.0


def significant_singular_values(values: Floats, shape: tuple[int, int]) -> int:
    """Count the singular values that white noise of unknown size does not explain ([Gavish2014], their polynomial).

    Args:
        values: all singular values of a matrix, in falling order.
        shape: of the matrix.
    """
    ratio = min(shape) / max(shape)
    factor = 0.56 * ratio**3 - 0.95 * ratio**2 + 1.82 * ratio + 1.43
    return int((values > factor * np.median(values)).sum())
