"""Joint solution for the tracks of all points in all frames from grey values, under a low rank."""

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
    predicted_by_neighbours,
)
from marey.images.matching.features import edge_features, good_features
from marey.images.matching.splines import SplinePicture, spline_of
from marey.nonrigid.tracking.weighted_factorisation import (
    LEAST_POINTS_SEEN,
    LowRankTracks,
    PlaceEquations,
    inverse_of_symmetric,
    low_rank_tracks,
    times,
)

_RANKS = (2, 3, 4, 5, 6, 7, 8, 9, 10, 12, 14)
"""Ranks, beside the translation, among which that of several cameras' tracks is chosen. Chosen by hand; results were
not measured against other values."""


@dataclass(frozen=True, kw_only=True)
class HeldOutSettings:
    """Settings of the cross-validation of the rank; chosen by hand, results were not measured against other values."""

    past_best: int = 3
    """The search ends this many ranks after the best one."""
    share: float = 0.1
    """Fraction of the well-determined positions that are held out."""
    clump: float = 0.1
    """Fraction of the points, and of the frames, that are held out together."""
    least_information: float = 4.0
    """A position is well determined where its information in the weakest direction is above this [1/px2]."""
    tolerance: float = 1.02
    """The least rank whose error is within this factor of the best is chosen."""
    rounds: int = 15
    """Number of rounds of the factorisation."""
    counted: float = 0.95
    """Fraction of the held-out positions, those of the smallest errors, that count; some are outliers themselves."""


_HELD_OUT = HeldOutSettings()
"""Default settings of the cross-validation, which also serve the standard deviations."""


@dataclass(frozen=True, kw_only=True)
class RankTrackingSettings:
    """Settings of the refinement of tracks under a low rank.

    Where nothing else is stated, defaults were chosen by hand, and results were not measured against other values.

    Raises:
        SettingProblem: A value is impossible.
    """

    rank: int | None = None
    """Rank beside the translation; chosen by cross-validation if None."""
    passes: int = 4
    """Number of times that grey values are compared at the current positions."""
    alike: float = 0.7
    """Least correlation with the reference at a position that is used."""
    ranks: tuple[int, ...] = (*_RANKS, 17, 20, 24, 28, 34, 40)
    """Ranks that are tried for one video, whose lens and surface need more than few shapes."""
    stray: float = 3.0
    """A position from a later reference only is rejected where it is farther from the prediction of its neighbours than
    this times the distance within which 95 % of all positions lie."""
    least_weight: float = 0.25
    """Positions with a smaller weight are outliers, and are not visible."""
    least_sd: float = 0.05
    """Least standard deviation of a position [px]: the effect of deformation, blur and compression on patches."""
    held_out: HeldOutSettings = _HELD_OUT
    """Settings of the cross-validation of the rank."""

    def __post_init__(self) -> None:
        if (self.rank is not None and self.rank < 1) or self.passes < 1 or not 0 < self.alike < 1:
            raise SettingProblem(
                f"Tracks cannot be refined with rank {self.rank}, {self.passes} passes and a correlation of "
                f"{self.alike:g}: rank and passes must be at least 1, the correlation between 0 and 1."
            )


_USUAL = 1.96
"""Number of standard deviations that contain 95 % of the positions of a normal distribution."""


@dataclass(frozen=True, eq=False, kw_only=True)
class RankTracks:
    """Refined tracks with their rank."""

    tracks: FeatureTracks
    """Positions with standard deviations."""
    rank: int
    """Rank beside the translation."""
    curve: Floats
    """(n, 2) ranks tried and the root mean square distance of held-out positions from the model [px]; empty where the
    rank was given."""
    spread: float
    """Standard deviation of a coordinate about the low rank [px]."""

    def __post_init__(self) -> None:
        freeze_fields(self, "curve")


def refine_tracks(
    pictures: Pictures,
    followed: FollowedPoints,
    *,
    settings: RankTrackingSettings | None = None,
    patches: FollowSettings = DEFAULT,
) -> RankTracks:
    """Solve for the tracks of all points in all frames together from the grey values ([Torresani2001]).

    Args:
        pictures: Grey images of the video.
        followed: Tracks of single points; those along edges are initialised by the others.
        settings: Rank, passes and tuned constants; the defaults if None.
        patches: Settings with which the points were followed.

    Returns:
        Positions in all frames in which at least three points are seen, `predicted` where the point itself is not; NaN
        in the others, and for points that could never be compared.

    Raises:
        SettingProblem: There are fewer points or frames than the least rank needs.
    """
    settings = settings or RankTrackingSettings()
    followed = _without_strays(followed, settings.stray)
    places = _complete(followed)
    rank = settings.rank
    curve: Floats = np.empty((0, 2))
    for _ in range(settings.passes):
        equations = _equations(pictures, followed, places, settings, patches)
        if rank is None:
            rank, curve = choose_tracking_rank(equations, places, ranks=settings.ranks, settings=settings.held_out)
        _require_enough(equations, rank)
        model = low_rank_tracks(equations, places, rank)
        refined, covariance = combined(equations, model, settings.least_weight)
        lost = ~np.all(np.isfinite(refined), axis=2)
        before, places = places, np.where(lost[..., None], places, refined)
    assert rank is not None
    factor = _uncertainty_factor(equations, before, rank, settings)
    return RankTracks(
        tracks=_tracks(followed, equations, model, (refined, covariance), factor, settings),
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
    settings: RankTrackingSettings | None = None,
    patches: FollowSettings = DEFAULT,
) -> RankTracks:
    """Select corners and points along edges in one frame and track them through a video.

    The default numbers are those of [Alexander2003] section 3.2.

    Args:
        pictures: Grey images of the video.
        frame: Frame in which points are selected.
        corners: Largest number of corners.
        edges: Largest number of points along edges.
        within: (H, W) mask of possible positions; everywhere if None.
        settings: Rank, passes and tuned constants; the defaults if None.
        patches: Settings with which corners are followed.

    Returns:
        The refined tracks, corners first.

    Raises:
        SettingProblem: There are too few corners to constrain the other points.
    """
    strong = good_features(pictures[frame], count=corners, size=patches.size, within=within)
    weak = edge_features(pictures[frame], count=edges, taken=strong, size=patches.size, within=within)
    followed = follow_points(pictures, np.concatenate([strong, weak]), frame=frame, settings=patches)
    return refine_tracks(pictures, followed, settings=settings, patches=patches)


def _require_enough(equations: PlaceEquations, rank: int) -> None:
    known = equations.known
    frames, points = int((known.sum(axis=1) >= LEAST_POINTS_SEEN).sum()), int(known.any(axis=0).sum())
    if points <= rank + 1 or 2 * frames <= rank + 1:
        raise SettingProblem(
            f"{points} points seen in {frames} frames are too few for tracks of rank {rank}: more points than "
            f"{rank + 1} and more frames than {(rank + 1) // 2} are needed."
        )


def _without_strays(followed: FollowedPoints, ratio: float) -> FollowedPoints:
    """Remove positions from later references that are far from the prediction of their neighbours.

    A point that is compared with a recent patch only can slide to similar texture; its neighbours reveal this.
    """
    found, first = np.swapaxes(followed.found.tracks, 1, 2), followed.guesses[followed.start].T
    away = np.stack([np.linalg.norm(now - predicted_by_neighbours(first, now), axis=1) for now in found])
    if not np.isfinite(away).any():
        return followed
    stray = np.nan_to_num(away) > ratio * np.nanpercentile(away, 95)
    stray &= followed.used >= found.shape[1]
    places = np.swapaxes(np.where(stray[..., None], np.nan, found), 1, 2)
    deviations = np.where(stray[:, None], np.nan, followed.found.tracks_sd)
    marks = replace(followed.found, tracks=places, tracks_sd=deviations, visible=followed.found.visible & ~stray)
    return replace(followed, found=marks, used=np.where(stray, -1, followed.used))


def _complete(followed: FollowedPoints) -> Floats:
    """Compute initial positions (F, P, 2); points that were not seen are extrapolated from their neighbours."""
    found = np.swapaxes(followed.found.tracks, 1, 2)
    guesses = np.swapaxes(followed.guesses, 1, 2)
    first = guesses[followed.start]
    return np.stack([extrapolated(first, now, guess)[0] for now, guess in zip(found, guesses, strict=True)])


def _equations(
    pictures: Pictures,
    followed: FollowedPoints,
    places: Floats,
    settings: RankTrackingSettings,
    patches: FollowSettings,
) -> PlaceEquations:
    """Compare all points with the images, using the first reference, or that with which they were followed."""
    frames, count = places.shape[:2]
    information, right = np.zeros((frames, count, 2, 2)), np.zeros((frames, count, 2))
    maps = _maps(followed, places)
    usable = followed.used[followed.start] >= 0
    first = np.where(usable, np.arange(count), -1)
    for t in range(frames):
        spline = spline_of(pictures[t])
        later = np.where(followed.used[t] >= count, followed.used[t], -1)
        for chosen in (first, later):
            _compare(spline, followed, chosen, places, maps[t], t, settings, patches, information[t], right[t])
    return PlaceEquations(information=information, right=right)


def _compare(
    spline: SplinePicture,
    followed: FollowedPoints,
    chosen: np.ndarray,
    places: Floats,
    maps: Floats,
    frame: int,
    settings: RankTrackingSettings,
    patches: FollowSettings,
    information: Floats,
    right: Floats,
) -> None:
    """Add the equations of a frame's points that have none so far and resemble their reference."""
    references, everyone = followed.references, np.arange(len(chosen))
    taken = references.frames[chosen]
    ahead = followed.maps[taken, everyone]
    own = np.where((chosen >= len(chosen))[:, None, None], maps @ np.linalg.inv(ahead), maps)
    # A later reference refers to the current estimate of its position, so its drift decreases as that improves.
    pixels = places[taken, everyone]
    new, side, alike = references.equations(spline, chosen, pixels, places[frame], own, patches.noise)
    good = (alike >= settings.alike) & (np.trace(information, axis1=1, axis2=2) == 0)
    information[good], right[good] = new[good], side[good]


def _maps(followed: FollowedPoints, places: Floats) -> Floats:
    """Compute affine maps (F, P, 2, 2) from the first frame: as matched, or from the positions of neighbours."""
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


def combined(equations: PlaceEquations, model: LowRankTracks, least_weight: float) -> tuple[Floats, Floats]:
    """Combine the information of the grey values with the prediction of the low-rank model.

    Args:
        equations: Information of the grey values.
        model: Low-rank model.
        least_weight: Grey values of positions with a smaller weight are ignored.

    Returns:
        Positions (F, P, 2) [px] and their covariance (F, P, 2, 2) [px2].
    """
    places, prior = model.places(), model.place_covariance()
    weight = np.where(model.weight > least_weight, model.weight, 0)[..., None, None]
    information = equations.information * weight
    pull = equations.right * weight[..., 0] - times(information, places)
    finite = np.all(np.isfinite(prior), axis=(2, 3))
    prior = np.where(finite[..., None, None], prior, np.eye(2))
    covariance = inverse_of_symmetric(inverse_of_symmetric(prior) + information)
    refined = places + times(covariance, np.nan_to_num(pull))
    covariance = np.where(finite[..., None, None], covariance, np.nan)
    return refined, covariance


def choose_tracking_rank(
    equations: PlaceEquations,
    places: Floats,
    *,
    ranks: tuple[int, ...] = _RANKS,
    settings: HeldOutSettings = _HELD_OUT,
) -> tuple[int, Floats]:
    """Choose the rank by the prediction of well-determined positions that are held out.

    Args:
        equations: Information about each position.
        places: (F, P, 2) initial positions [px].
        ranks: Ranks to try, in ascending order.
        settings: Tuned constants.

    Returns:
        The least rank whose error is within 2 % of the best, and the curve (n, 2) of ranks and errors [px].

    Raises:
        SettingProblem: There are too few points or frames for any rank.
    """
    _require_enough(equations, ranks[0])
    hidden, kept, truth = _held_out(equations, places, settings)
    points = int((kept.known.sum(axis=0) > 0).sum())
    curve: list[tuple[int, float]] = []
    for rank in ranks:
        if curve and len(curve) - 1 - int(np.argmin([error for _, error in curve])) >= settings.past_best:
            break
        if points <= 2 * rank or len(places) <= rank:
            break
        model = low_rank_tracks(kept, places, rank, rounds=settings.rounds)
        away = np.sum((model.places()[hidden] - truth) ** 2, axis=1)
        away = away[np.isfinite(away)]
        # The largest errors are ignored: some held-out positions are outliers themselves.
        counted = np.sort(away)[: max(1, int(settings.counted * len(away)))]
        curve.append((rank, float(np.sqrt(np.mean(counted)))))
    if not curve:
        raise SettingProblem(f"{points} points in {len(places)} frames are too few to choose a rank.")
    errors = np.array(curve)
    return int(errors[np.argmax(errors[:, 1] <= settings.tolerance * errors[:, 1].min()), 0]), errors


def _held_out(
    equations: PlaceEquations, places: Floats, settings: HeldOutSettings
) -> tuple[Mask, PlaceEquations, Floats]:
    """Hold out well-determined positions: return their mask (F, P), the other equations, and the positions (n, 2)."""
    weakest = np.linalg.eigvalsh(equations.information)[..., 0]
    hidden = (weakest > settings.least_information) & _clumps(places, settings)
    if not hidden.any():
        raise SettingProblem("No point is determined well enough in both directions to choose a rank.")
    truth = times(inverse_of_symmetric(equations.information[hidden]), equations.right[hidden])
    return hidden, equations.without(hidden), truth


def _uncertainty_factor(equations: PlaceEquations, places: Floats, rank: int, settings: RankTrackingSettings) -> float:
    """Estimate the ratio of actual to stated standard deviations of predicted positions, from positions held out.

    Deformation beyond the rank is correlated between neighbours, while the model takes it as independent.
    """
    hidden, kept, truth = _held_out(equations, places, settings.held_out)
    model = low_rank_tracks(kept, places, rank, rounds=settings.held_out.rounds)
    covariance = model.place_covariance()[hidden] + inverse_of_symmetric(equations.information[hidden])
    sd = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2) + settings.least_sd**2)
    away = np.abs(model.places()[hidden] - truth) / sd
    return max(1.0, float(np.nanpercentile(away, 95)) / _USUAL)


def _clumps(places: Floats, settings: HeldOutSettings) -> Mask:
    """Select positions (F, P) to hold out as an occlusion would: neighbours together, for several frames."""
    frames, count = places.shape[:2]
    random, hidden = np.random.default_rng(0), np.zeros(places.shape[:2], bool)
    near, length = max(1, round(settings.clump * count)), max(1, round(settings.clump * frames))
    while hidden.mean() < settings.share:
        start = random.integers(frames)
        away = np.linalg.norm(places[start] - places[start, random.integers(count)], axis=1)
        hidden[start : start + length, np.argsort(away)[:near]] = True
    return hidden


def _tracks(
    followed: FollowedPoints,
    equations: PlaceEquations,
    model: LowRankTracks,
    estimate: tuple[Floats, Floats],
    factor: float,
    settings: RankTrackingSettings,
) -> FeatureTracks:
    """Assemble the result; positions that are outliers are replaced by their prediction."""
    refined, covariance = estimate
    known = np.all(np.isfinite(refined), axis=2) & equations.known.any(axis=0)
    seen: Mask = equations.known & (model.weight > settings.least_weight) & known
    variance = np.diagonal(covariance, axis1=2, axis2=3) + settings.least_sd**2
    variance = np.where(seen[..., None], variance, factor**2 * variance)
    places = np.where(known[..., None], refined, np.nan)
    sd = np.where(known[..., None], np.sqrt(variance), np.nan)
    # In the first frame, points are exact by definition.
    start, given = followed.start, followed.used[followed.start] >= 0
    places[start, given], sd[start, given] = followed.guesses[start].T[given], 0.0
    seen[start], known[start] = given, known[start] | given
    return FeatureTracks(
        tracks=np.swapaxes(places, 1, 2), tracks_sd=np.swapaxes(sd, 1, 2), visible=seen, predicted=known & ~seen
    )
