"""Tracks of all points in all frames solved together from the grey values, under a low rank."""

from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Floats, Mask, freeze_fields
from marey.errors import SettingProblem
from marey.images.matching.feature_tracks import (
    DEFAULT,
    FeatureTracks,
    FollowedPoints,
    FollowSettings,
    Pictures,
    extrapolated,
    follow_points,
    said_by_others,
)
from marey.images.matching.features import edge_features, good_features
from marey.images.matching.splines import SplinePicture, spline_of
from marey.nonrigid.tracking.weighted_factorisation import (
    LEAST_SEEN,
    LowRankTracks,
    PlaceEquations,
    factorise,
    inverse_of_symmetric,
    times,
)

_RANKS = (2, 3, 4, 5, 6, 7, 8, 9, 10, 12, 14)
"""Ranks that are tried, beside the translation."""
_MORE_RANKS = (*_RANKS, 17, 20, 24, 28, 34, 40)
"""Ranks for one video, whose lens and whose surface bend the tracks beyond what few shapes do."""
_PAST_BEST = 3
"""So many ranks after the best one no further are tried."""
_ASTRAY = 3.0
"""A place that only a younger reference gave is no good where it lies farther from what its neighbours say than this
many times the distance below which 95 % of all places lie."""
_HELD_OUT = 0.1
"""Share of the well-known places that are hidden to choose the rank."""
_CLUMP = 0.1
"""Share of the points, and of the frames, that are hidden together."""
_FIRM = 4.0
"""A place is well known where its weakest direction has a standard deviation below 1 / sqrt of this [1/px2]."""
_AS_GOOD = 1.02
"""The least rank whose held-out error is within this factor of the best is taken."""
_LEAST_SD = 0.05
"""No place is trusted more than this [px]: what patches that bend, blur and compress leave."""
_USUAL = 1.96
"""Deviations within which 95 % of the places held out shall lie."""
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
        freeze_fields(self, "curve")


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
    followed = _without_strays(followed)
    places = _complete(followed)
    rank = settings.rank
    curve: Floats = np.empty((0, 2))
    for _ in range(settings.passes):
        equations = _equations(pictures, followed, places, settings, patches)
        if rank is None:
            rank, curve = choose_rank(equations, places, ranks=_MORE_RANKS)
        _require_enough(equations, rank)
        model = factorise(equations, places, rank)
        refined, covariance = combined(equations, model)
        lost = ~np.all(np.isfinite(refined), axis=2)
        before, places = places, np.where(lost[..., None], places, refined)
    assert rank is not None
    doubt = _doubt(equations, before, rank)
    return RankTracks(
        tracks=_tracks(followed, equations, model, refined, covariance, doubt),
        rank=rank,
        curve=curve,
        spread=model.spread,
    )


def track_features(
    pictures: Pictures,
    *,
    frame: int = 0,
    corners: int = 30,
    edges: int = 80,
    within: Mask | None = None,
    settings: RankSettings | None = None,
    patches: FollowSettings = DEFAULT,
) -> RankTracks:
    """Choose corners and places along edges in one frame and track them through a video.

    The numbers are those of [Alexander2003] section 3.2.

    Args:
        pictures: The video's grey pictures.
        frame: The frame in which points are chosen.
        corners: How many corners at most.
        edges: How many places along edges at most.
        within: (H, W) where points may lie; everywhere when None.
        settings: Rank and passes.
        patches: How corners are followed.

    Returns:
        The refined tracks, corners first.

    Raises:
        SettingProblem: There are too few corners to hold the rest.
    """
    strong = good_features(pictures[frame], count=corners, size=patches.size, within=within)
    weak = edge_features(pictures[frame], count=edges, taken=strong, size=patches.size, within=within)
    followed = follow_points(pictures, np.concatenate([strong, weak]), frame=frame, settings=patches)
    return refine_tracks(pictures, followed, settings=settings, patches=patches)


def _require_enough(equations: PlaceEquations, rank: int) -> None:
    known = equations.known
    frames, points = int((known.sum(axis=1) >= LEAST_SEEN).sum()), int(known.any(axis=0).sum())
    if points <= rank + 1 or 2 * frames <= rank + 1:
        raise SettingProblem(
            f"{points} points seen in {frames} frames are too few for tracks of rank {rank}: more points than "
            f"{rank + 1} and more frames than {(rank + 1) // 2} are needed."
        )


def _without_strays(followed: FollowedPoints) -> FollowedPoints:
    """Leave out places that a younger reference gave and that jumped away from all neighbours.

    Whoever is compared with yesterday's patch alone slides on to what looks like it; neighbours tell.
    """
    found, first = np.swapaxes(followed.found.tracks, 1, 2), followed.guesses[followed.start].T
    away = np.stack([np.linalg.norm(now - said_by_others(first, now), axis=1) for now in found])
    if not np.isfinite(away).any():
        return followed
    stray = np.nan_to_num(away) > _ASTRAY * np.nanpercentile(away, 95)
    stray &= followed.used >= found.shape[1]
    places = np.swapaxes(np.where(stray[..., None], np.nan, found), 1, 2)
    deviations = np.where(stray[:, None], np.nan, followed.found.tracks_sd)
    marks = replace(followed.found, tracks=places, tracks_sd=deviations, visible=followed.found.visible & ~stray)
    return replace(followed, found=marks, used=np.where(stray, -1, followed.used))


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
    """Put together what the grey values and the other points say about each place; outliers among the first are left.

    Args:
        equations: What the grey values say.
        model: What the other points say.

    Returns:
        Places (F, P, 2) [px] and their covariance (F, P, 2, 2) [px2].
    """
    places, prior = model.places(), model.place_covariance()
    weight = np.where(model.weight > _UNUSUAL, model.weight, 0)[..., None, None]
    information = equations.information * weight
    pull = equations.right * weight[..., 0] - times(information, places)
    finite = np.all(np.isfinite(prior), axis=(2, 3))
    prior = np.where(finite[..., None, None], prior, np.eye(2))
    covariance = inverse_of_symmetric(inverse_of_symmetric(prior) + information)
    refined = places + times(covariance, np.nan_to_num(pull))
    covariance = np.where(finite[..., None, None], covariance, np.nan)
    return refined, covariance


def choose_rank(equations: PlaceEquations, places: Floats, *, ranks: tuple[int, ...] = _RANKS) -> tuple[int, Floats]:
    """Choose the rank by hiding well-known places and seeing how far from the model comes.

    Args:
        equations: What the grey values say.
        places: (F, P, 2) to begin with [px].
        ranks: The ranks to try, from the least on, until they have long been past the best.

    Returns:
        The least rank whose error is within 2 % of the best, and the curve (n, 2) of ranks and errors [px].

    Raises:
        SettingProblem: There are too few points or frames for any rank.
    """
    _require_enough(equations, ranks[0])
    hidden, kept, truth = _held_out(equations, places)
    points = int((kept.known.sum(axis=0) > 0).sum())
    curve: list[tuple[int, float]] = []
    for rank in ranks:
        if curve and len(curve) - 1 - int(np.argmin([error for _, error in curve])) >= _PAST_BEST:
            break
        if points <= 2 * rank or len(places) <= rank:
            break
        model = factorise(kept, places, rank, rounds=15)
        away = np.sum((model.places()[hidden] - truth) ** 2, axis=1)
        away = away[np.isfinite(away)]
        # A few hidden places are wrong themselves: the largest do not count.
        curve.append((rank, float(np.sqrt(np.mean(np.sort(away)[: max(1, int(0.95 * len(away)))])))))
    if not curve:
        raise SettingProblem(f"{points} points in {len(places)} frames are too few to choose a rank.")
    errors = np.array(curve)
    return int(errors[np.argmax(errors[:, 1] <= _AS_GOOD * errors[:, 1].min()), 0]), errors


def _held_out(equations: PlaceEquations, places: Floats) -> tuple[Mask, PlaceEquations, Floats]:
    """Hide well-known places: which (F, P), the equations of the rest, and where the hidden ones (n, 2) are."""
    weakest = np.linalg.eigvalsh(equations.information)[..., 0]
    hidden = (weakest > _FIRM) & _clumps(places)
    if not hidden.any():
        raise SettingProblem("No point is known well enough to judge a rank by it.")
    truth = times(inverse_of_symmetric(equations.information[hidden]), equations.right[hidden])
    return hidden, equations.without(hidden), truth


def _doubt(equations: PlaceEquations, places: Floats, rank: int) -> float:
    """Say by how much predicted places are less certain than the model states, from places held out.

    What the rank leaves of a deformation is alike in neighbours; the model takes each point's share for its own.
    """
    hidden, kept, truth = _held_out(equations, places)
    model = factorise(kept, places, rank, rounds=15)
    covariance = model.place_covariance()[hidden] + inverse_of_symmetric(equations.information[hidden])
    sd = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2) + _LEAST_SD**2)
    away = np.abs(model.places()[hidden] - truth) / sd
    return max(1.0, float(np.nanpercentile(away, 95)) / _USUAL)


def _clumps(places: Floats) -> Mask:
    """Choose places (F, P) to hide as things before the surface would: neighbours together, for some frames."""
    frames, count = places.shape[:2]
    random, hidden = np.random.default_rng(0), np.zeros(places.shape[:2], bool)
    near, length = max(1, round(_CLUMP * count)), max(1, round(_CLUMP * frames))
    while hidden.mean() < _HELD_OUT:
        start = random.integers(frames)
        away = np.linalg.norm(places[start] - places[start, random.integers(count)], axis=1)
        hidden[start : start + length, np.argsort(away)[:near]] = True
    return hidden


def _tracks(
    followed: FollowedPoints,
    equations: PlaceEquations,
    model: LowRankTracks,
    refined: Floats,
    covariance: Floats,
    doubt: float,
) -> FeatureTracks:
    """Give the result; places that are no good against the model are predicted by it instead."""
    known = np.all(np.isfinite(refined), axis=2) & equations.known.any(axis=0)
    seen: Mask = equations.known & (model.weight > _UNUSUAL) & known
    variance = np.diagonal(covariance, axis1=2, axis2=3) + _LEAST_SD**2
    variance = np.where(seen[..., None], variance, doubt**2 * variance)
    places = np.where(known[..., None], refined, np.nan)
    sd = np.where(known[..., None], np.sqrt(variance), np.nan)
    # The points are what they were given as: there they are certain.
    start, given = followed.start, followed.used[followed.start] >= 0
    places[start, given], sd[start, given] = followed.guesses[start].T[given], 0.0
    seen[start], known[start] = given, known[start] | given
    return FeatureTracks(
        tracks=np.swapaxes(places, 1, 2), tracks_sd=np.swapaxes(sd, 1, 2), visible=seen, predicted=known & ~seen
    )
