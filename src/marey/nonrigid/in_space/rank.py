"""Number of basis shapes of points in space, chosen by cross-validation; [Alexander2003] leaves the choice open."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Integers, Mask, freeze_fields
from marey.nonrigid.in_space.errors import pose_variance, shape_covariance
from marey.nonrigid.in_space.measured_places import MeasuredPlaces
from marey.nonrigid.in_space.model import HomogeneousModel, HomogeneousModelSettings, refine, with_more_modes
from marey.nonrigid.in_space.start import KEPT_IN_FRAME, RigidStartSettings, most_shapes, rigid_start


@dataclass(frozen=True, kw_only=True)
class RankChoiceSettings:
    """Settings of the choice of the number of basis shapes.

    Where nothing else is stated, defaults were chosen by hand, and results were not measured against other values.
    """

    held_out: float = 0.1
    """Fraction of the points that each round holds out."""
    longest_run: int = 30
    """Longest run of frames in which a point is hidden, at most 10 % of all frames."""
    rounds: int = 3
    """Number of rounds with different points held out."""
    most_shapes: int = 30
    """Largest number of basis shapes that is tried."""
    most_frames: int = 400
    """Number of frames, evenly spaced, that are used of longer sequences."""
    past_best: int = 4
    """The search ends after so many successive numbers of basis shapes that predict worse than the best."""
    outlier: float = 25.0
    """Squared distances of held-out points count at most this many times their median. Without a limit, outliers
    dominated the choice (docs/explanation/nonrigid.md)."""
    model_rounds: int = 20
    """Largest number of rounds of the least squares before a model is evaluated."""
    model_tolerance: float = 0.02
    """Tolerance of the least squares before a model is evaluated, see `HomogeneousModelSettings.tolerance`."""


@dataclass(frozen=True, eq=False, kw_only=True)
class RankChoice:
    """Chosen number of basis shapes, and the cross-validation curve."""

    rank: int
    """Number of basis shapes K, including the mean."""
    ranks: Integers
    """(N,) numbers of basis shapes that were tried."""
    held_out_rms: Floats
    """(N,) root mean square distance of held-out measurements from their prediction, in the unit of the points, or in
    pixels where points are measured in images."""
    held_out_sd: Floats
    """(N,) standard deviation of that distance over the rounds."""
    farther: float
    """Ratio of the errors of points hidden for several frames to their stated standard deviations, at the chosen number
    of basis shapes; at least 1."""

    def __post_init__(self) -> None:
        freeze_fields(self, "ranks", dtype=np.int64)
        freeze_fields(self, "held_out_rms", "held_out_sd")


@dataclass
class _Round:
    """A model fitted without the held-out points, and its prediction of these."""

    whole: MeasuredPlaces
    """Measurements of the model's frames and points, including those held out."""
    rest: MeasuredPlaces
    """The same without those held out."""
    hidden: Mask
    """(F, P) mask of the points held out."""
    model: HomogeneousModel
    settings: RankChoiceSettings

    def grow(self, count: int) -> None:
        """Add modes to the model, and fit it well enough to be evaluated."""
        self.model = with_more_modes(self.model, self.rest, count)
        refine(
            self.model, self.rest, rounds=self.settings.model_rounds, tolerance=self.settings.model_tolerance
        )  # fmt: skip

    def error(self) -> float:
        """Compute the root mean square distance of the held-out measurements, with limited outliers."""
        squares = self.whole.squares(self.model.places)[self.hidden]
        return float(np.sqrt(np.nanmean(np.minimum(squares, self.settings.outlier * np.nanmedian(squares)))))

    def farther(self) -> tuple[Floats, Floats]:
        """Compute squared errors of held-out points, less noise and pose, and their stated variances."""
        squares = ((self.whole.known - self.model.places) ** 2).sum(-1)[self.hidden]
        stated = np.trace(shape_covariance(self.model, self.rest), axis1=2, axis2=3)[self.hidden]
        noise = 3 * self.model.variance + self.whole.known_variance + pose_variance(self.model)
        known = noise[self.hidden]
        median = np.nanmedian(squares / (known + stated))
        usual = squares < self.settings.outlier * median * (known + stated)
        return (squares - known)[usual], stated[usual]


def choose_rank(
    places: MeasuredPlaces,
    *,
    settings: RankChoiceSettings = RankChoiceSettings(),
    start: RigidStartSettings | None = None,
    model: HomogeneousModelSettings | None = None,
    seed: int = 0,
) -> RankChoice:
    """Choose the smallest number of basis shapes that predicts held-out points as well as the best, within its error.

    Args:
        places: Measured points.
        settings: Tuned constants.
        start: Settings of the rigid initial solution; the defaults if None.
        model: Settings of the least squares; the defaults if None.
        seed: Seed of the random choice of the held-out points.

    Raises:
        MareyError: There are too few frames or points for the rigid fit once some are held out.
    """
    rng, start, model = np.random.default_rng(seed), start or RigidStartSettings(), model or HomogeneousModelSettings()
    places = _thinned(places, settings.most_frames)

    def rigid_round(hidden: Mask) -> _Round:
        """Fit the rigid shape to the points that are not held out."""
        rest = places.without(hidden)
        rigid, frames, points = rigid_start(rest, start, model)
        kept = hidden[np.ix_(frames, points)]
        one = _Round(places.among(frames, points), rest.among(frames, points), kept, rigid, settings)
        one.grow(0)
        return one

    rounds = [rigid_round(_hidden(places.seen, rng, settings)) for _ in range(settings.rounds)]
    if any(not one.hidden.any() for one in rounds):  # too few points to hold any out: they determine a rigid shape only
        nothing = np.full(1, np.nan)
        return RankChoice(rank=1, ranks=np.ones(1, np.int64), held_out_rms=nothing, held_out_sd=nothing, farther=1.0)
    most = min(settings.most_shapes, *(most_shapes(one.rest) for one in rounds))
    ranks, errors = [1], [[one.error() for one in rounds]]
    while ranks[-1] < most and ranks[-1] - ranks[int(np.mean(errors, 1).argmin())] < settings.past_best:
        for one in rounds:
            one.grow(1)
        ranks.append(ranks[-1] + 1)
        errors.append([one.error() for one in rounds])
    rms, sd = np.mean(errors, 1), np.std(errors, 1, ddof=1)
    best = int(rms.argmin())
    rank = ranks[int((rms <= rms[best] + sd[best] / np.sqrt(settings.rounds)).argmax())]
    farther = _farther([rigid_round(_hidden_runs(places.seen, rng, settings)) for _ in range(settings.rounds)], rank)
    return RankChoice(rank=rank, ranks=np.array(ranks), held_out_rms=rms, held_out_sd=sd, farther=farther)


def _thinned(places: MeasuredPlaces, most: int) -> MeasuredPlaces:
    """Select at most so many frames, evenly spaced."""
    frames, points = places.seen.shape
    if frames <= most:
        return places
    chosen = np.zeros(frames, bool)
    chosen[np.linspace(0, frames - 1, most).astype(int)] = True
    return places.among(chosen, np.ones(points, bool))


def _hidden(seen: Mask, rng: np.random.Generator, settings: RankChoiceSettings) -> Mask:
    """Select points (F, P) to hold out independently of each other."""
    return _enough_left(seen, rng.random(seen.shape) < settings.held_out)


def _hidden_runs(seen: Mask, rng: np.random.Generator, settings: RankChoiceSettings) -> Mask:
    """Select points (F, P) to hold out in runs of frames, as real gaps occur."""
    frames, points = seen.shape
    hidden = np.zeros(seen.shape, bool)
    longest = min(settings.longest_run, max(frames // 10, 1))
    for _ in range(int(2 * settings.held_out * frames * points / (1 + longest)) + 1):
        first, length, point = rng.integers(frames), rng.integers(1, longest + 1), rng.integers(points)
        hidden[first : first + length, point] = True
    return _enough_left(seen, hidden)


def _enough_left(seen: Mask, hidden: Mask) -> Mask:
    hidden = seen & hidden
    hidden[(seen & ~hidden).sum(1) < KEPT_IN_FRAME] = False
    return np.asarray(hidden)


def _farther(rounds: list[_Round], rank: int) -> float:
    """Compute the ratio of the errors of points hidden in runs to their stated standard deviations; at least 1.

    Gaps hide whole postures, and a model's covariance holds only for postures to which it was fitted.
    """
    for one in rounds:
        if 1 < rank <= most_shapes(one.rest):
            one.grow(rank - 1)
    beyond, stated = (np.concatenate(values) for values in zip(*(one.farther() for one in rounds), strict=True))
    return float(np.sqrt(max(beyond.sum() / stated.sum(), 1.0))) if len(stated) else 1.0


def significant_singular_values(values: Floats, shape: tuple[int, int]) -> int:
    """Count the singular values that white noise of unknown variance does not explain ([Gavish2014], their polynomial).

    Args:
        values: All singular values of a matrix, in descending order.
        shape: Shape of the matrix.
    """
    ratio = min(shape) / max(shape)
    factor = 0.56 * ratio**3 - 0.95 * ratio**2 + 1.82 * ratio + 1.43
    return int((values > factor * np.median(values)).sum())
