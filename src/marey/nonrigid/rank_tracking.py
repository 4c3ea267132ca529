"""Tracks of all points in all frames solved together from the grey values, under a low rank."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Mask, frozen
from marey.errors import SettingProblem
from marey.images.feature_tracks import (
    DEFAULT,
    FeatureTracks,
    FollowedPoints,
    FollowSettings,
    Pictures,
    extrapolated,
)
from marey.images.splines import SplinePicture, spline_of
from marey.nonrigid.weighted_factorisation import LEAST_SEEN, LowRankTracks, PlaceEquations, factorise

_RANKS = (2, 3, 4, 5, 6, 7, 8, 9, 10, 12, 14)
"""Ranks that are tried, beside the translation."""
_HELD_OUT = 0.1
"""Share of the well-known places that are hidden to choose the rank."""
_FIRM = 4.0
"""A place is well known where its weakest direction has a standard deviation below 1 / sqrt of this [1/px2]."""
_AS_GOOD = 1.02
"""The least rank whose held-out error is within this factor of the best is taken."""
_LEAST_SD = 0.05
"""No place is trusted more than this [px]: what patches that bend, blur and compress leave."""
_UNUSUAL = 0.25
"""A place with less weight than this was an outlier, and is not called visible."""


@dataclass(frozen=True, kw_only=True)
class RankSettings:
    """How tracks are refined.

    Raises:
        SettingProblem: A value is impossible.
    """

    rank: int | None = None
    """Rank beside the translation; None chooses it by places held out."""
    passes: int = 4
    """How often the grey values are compared anew at the places that were found."""
    alike: float = 0.7
    """Least correlation with the reference at a place that counts."""

    def __post_init__(self) -> None:
        if (self.rank is not None and self.rank < 1) or self.passes < 1 or not 0 < self.alike < 1:
            raise SettingProblem(
                f"Tracks cannot be refined with rank {self.rank}, {self.passes} passes and a correlation of "
                f"{self.alike:g}: rank and passes are at least 1, the correlation between 0 and 1."
            )


@dataclass(frozen=True, eq=False, kw_only=True)
class RankTracks:
    """Refined tracks, and how their rank was chosen."""

    tracks: FeatureTracks
    rank: int
    """Beside the translation."""
    curve: Floats
    """(n, 2) ranks tried and the root mean square distance of the places held out from the model [px]; empty where the
    rank was given."""
    spread: float
    """Standard deviation of a coordinate about the low rank [px]."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "curve", frozen(self.curve))


def refine_tracks(
    pictures: Pictures,
    followed: FollowedPoints,
    *,
    settings: RankSettings | None = None,
    patches: FollowSettings = DEFAULT,
) -> RankTracks:
    """Solve the tracks of all points in all frames together from the grey values ([Torresani2001]).

    Args:
        pictures: The video's grey pictures.
        followed: What single points gave; those along edges start where the others carry them.
        settings: Rank and passes.
        patches: What the points were followed with.

    Returns:
        Places in all frames in which at least three points are seen, `predicted` where the point itself is not; NaN in
        the others. Points that never could be compared are predicted by nothing and stay NaN.

    Raises:
        SettingProblem: Fewer points or frames than the least rank needs.
    """
    settings = settings or RankSettings()
    places = _complete(followed)
    rank = settings.rank
    curve: Floats = np.empty((0, 2))
    for _ in range(settings.passes):
        equations = _equations(pictures, followed, places, settings, patches)
        if rank is None:
            rank, curve = choose_rank(equations, places)
        _require_enough(equations, rank)
        model = factorise(equations, places, rank)
        refined, covariance = combined(equations, model)
        lost = ~np.all(np.isfinite(refined), axis=2)
        places = np.where(lost[..., None], places, refined)
    assert rank is not None
    return RankTracks(
        tracks=_tracks(followed, equations, model, refined, covariance), rank=rank, curve=curve, spread=model.spread
    )


def _require_enough(equations: PlaceEquations, rank: int) -> None:
    known = equations.known
    frames, points = int((known.sum(axis=1) >= LEAST_SEEN).sum()), int(known.any(axis=0).sum())
    if points <= rank + 1 or 2 * frames <= rank + 1:
        raise SettingProblem(
            f"{points} points seen in {frames} frames are too few for tracks of rank {rank}: more points than "
            f"{rank + 1} and more frames than {(rank + 1) // 2} are needed."
        )


def _complete(followed: FollowedPoints) -> Floats:
    """Give places (F, P, 2) to begin with: where points were not seen, their neighbours carry them."""
    found = np.swapaxes(followed.found.tracks, 1, 2)
    guesses = np.swapaxes(followed.guesses, 1, 2)
    first = guesses[followed.start]
    return np.stack([extrapolated(first, now, guess)[0] for now, guess in zip(found, guesses, strict=True)])


def _equations(
    pictures: Pictures, followed: FollowedPoints, places: Floats, settings: RankSettings, patches: FollowSettings
) -> PlaceEquations:
    """Compare all points with the pictures: with the first reference, or with the one they were followed with."""
    frames, count = places.shape[:2]
    information, right = np.zeros((frames, count, 2, 2)), np.zeros((frames, count, 2))
    maps = _maps(followed, places)
    usable = followed.used[followed.start] >= 0
    first = np.where(usable, np.arange(count), -1)
    for t in range(frames):
        spline = spline_of(pictures[t])
        younger = np.where(followed.used[t] >= count, followed.used[t], -1)
        for chosen in (first, younger):
            _compare(spline, followed, chosen, places, maps[t], t, settings, patches, information[t], right[t])
    return PlaceEquations(information=information, right=right)


def _compare(
    spline: SplinePicture,
    followed: FollowedPoints,
    chosen: np.ndarray,
    places: Floats,
    maps: Floats,
    frame: int,
    settings: RankSettings,
    patches: FollowSettings,
    information: Floats,
    right: Floats,
) -> None:
    """Write the equations of the points of a frame that nothing is known of yet and that look like their reference."""
    references, everyone = followed.references, np.arange(len(chosen))
    taken = references.frames[chosen]
    ahead = followed.maps[taken, everyone]
    own = np.where((chosen >= len(chosen))[:, None, None], maps @ np.linalg.inv(ahead), maps)
    # A younger reference shows the point where it is thought to have been then: its drift goes as that place improves.
    pixels = places[taken, everyone]
    new, side, alike = references.equations(spline, chosen, pixels, places[frame], own, patches.noise)
    good = (alike >= settings.alike) & (np.trace(information, axis1=1, axis2=2) == 0)
    information[good], right[good] = new[good], side[good]


def _maps(followed: FollowedPoints, places: Floats) -> Floats:
    """Give the affine maps (F, P, 2, 2) from the start's frame: as matched, or as the places about a point say."""
    seen = followed.found.visible
    maps = followed.maps.copy()
    first = places[followed.start]
    distance = np.linalg.norm(first[:, None] - first, axis=2)
    nearest = np.argsort(distance, axis=1)[:, 1:9]
    if nearest.shape[1] < 4:
        return maps
    offsets = first[nearest] - first[:, None]
    pull = 0.05 * np.mean(offsets**2, axis=(1, 2))[:, None, None] * len(nearest[0]) * np.eye(2)
    solver = np.linalg.solve(np.einsum("pki,pkj->pij", offsets, offsets) + pull, np.swapaxes(offsets, 1, 2))
    for t in range(len(maps)):
        shifts = places[t][nearest] - places[t][:, None] - offsets
        near = np.eye(2) + np.swapaxes(solver @ shifts, 1, 2)
        maps[t] = np.where(seen[t][:, None, None], maps[t], near)
    return maps


def combined(equations: PlaceEquations, model: LowRankTracks) -> tuple[Floats, Floats]:
    """Put together what the grey values and the other points say about each place.

    Args:
        equations: What the grey values say.
        model: What the other points say.

    Returns:
        Places (F, P, 2) [px] and their covariance (F, P, 2, 2) [px2].
    """
    places, prior = model.places(), model.place_covariance()
    weight = model.weight[..., None, None]
    information = equations.information * weight
    pull = equations.right * weight[..., 0] - np.einsum("fpij,fpj->fpi", information, places)
    finite = np.all(np.isfinite(prior), axis=(2, 3))
    prior = np.where(finite[..., None, None], prior, np.eye(2))
    covariance = prior @ np.linalg.inv(np.eye(2) + information @ prior)
    refined = places + np.einsum("fpij,fpj->fpi", covariance, np.nan_to_num(pull))
    covariance = np.where(finite[..., None, None], covariance, np.nan)
    return refined, covariance


def choose_rank(equations: PlaceEquations, places: Floats) -> tuple[int, Floats]:
    """Choose the rank by hiding well-known places and seeing how far from them the model comes.

    Args:
        equations: What the grey values say.
        places: (F, P, 2) to begin with [px].

    Returns:
        The least rank whose error is within 2 % of the best, and the curve (n, 2) of ranks and errors [px].

    Raises:
        SettingProblem: There are too few points or frames for any rank.
    """
    _require_enough(equations, _RANKS[0])
    weakest = np.linalg.eigvalsh(equations.information)[..., 0]
    hidden = (weakest > _FIRM) & (np.random.default_rng(0).random(weakest.shape) < _HELD_OUT)
    kept = equations.without(hidden)
    if not hidden.any():
        raise SettingProblem("No point is known well enough to choose a rank; give the rank.")
    truth = np.linalg.solve(equations.information[hidden], equations.right[hidden][..., None])[..., 0]
    points = int((kept.known.sum(axis=0) > 0).sum())
    curve = []
    for rank in _RANKS:
        if points <= 2 * rank or len(places) <= rank:
            break
        model = factorise(kept, places, rank, rounds=15)
        away = np.sum((model.places()[hidden] - truth) ** 2, axis=1)
        away = away[np.isfinite(away)]
        # A few hidden places are wrong themselves: the largest do not count.
        curve.append((rank, np.sqrt(np.mean(np.sort(away)[: max(1, int(0.95 * len(away)))]))))
    if not curve:
        raise SettingProblem(f"{points} points in {len(places)} frames are too few to choose a rank.")
    errors = np.array(curve)
    return int(errors[np.argmax(errors[:, 1] <= _AS_GOOD * errors[:, 1].min()), 0]), errors


def _tracks(
    followed: FollowedPoints, equations: PlaceEquations, model: LowRankTracks, refined: Floats, covariance: Floats
) -> FeatureTracks:
    """Give the result; places that are no good against the model are predicted by it instead."""
    known = np.all(np.isfinite(refined), axis=2)
    ever = equations.known.any(axis=0)
    known &= ever
    seen: Mask = equations.known & (model.weight > _UNUSUAL) & known
    variance = np.diagonal(covariance, axis1=2, axis2=3) + _LEAST_SD**2
    hidden = ~known[..., None]
    places, sd = np.where(hidden, np.nan, refined), np.where(hidden, np.nan, np.sqrt(variance))
    start = followed.start
    given = followed.used[start] >= 0
    places[start] = np.where(given[:, None], followed.guesses[start].T, places[start])
    return FeatureTracks(
        tracks=np.swapaxes(places, 1, 2), tracks_sd=np.swapaxes(sd, 1, 2), visible=seen, predicted=known & ~seen
    )
