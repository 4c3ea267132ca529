"""From the videos of several uncalibrated, synchronised cameras to tracks of the same points in all of them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Integers, Mask, freeze_fields
from marey.errors import MareyError, SettingProblem
from marey.images.matching.feature_tracks import DEFAULT, FollowSettings, Pictures, follow_points
from marey.images.matching.features import good_features
from marey.images.matching.patch_search import Candidates, find_beside, find_candidates, without_twins
from marey.nonrigid.correspondence.view_correspondence import match_tracks
from marey.nonrigid.tracking.stray_places import without_strays

LEAST_PAIRS = 8
PROBABLE = 0.5
_UNLIKE = -20.0
"""Evidence against a pair that does not look alike at all [natural logarithm]."""
_USUAL_LIKENESS, _LIKENESS_SPREAD = 0.95, 0.6
"""Correlation of one point's patches in two cameras, and the standard deviation of its inverse hyperbolic tangent."""
_CHANCE_LIKENESS, _CHANCE_SPREAD = 0.75, 0.3
"""The same of patches that ended on each other by chance."""
_STILL = 1.5
"""Points that never move further from where they are in the middle belong to the background [px]."""
UNTIED = "Camera {camera} shares no moving points with the others that can be found: it is left out."

Told = Callable[[str, int, int], None]
"""Is told what is done, and how much of how much."""


def quiet(_what: str, _done: int, _all: int) -> None:
    """Tell nobody."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ViewTracks:
    """Tracks of the same points in several cameras."""

    tracks: Floats
    """(C, F, 2, P) [px]; NaN where a camera does not see the point."""
    tracks_sd: Floats
    """(C, F, 2, P) their standard deviations [px]."""
    probability: Floats
    """(C, P) that this camera's track shows the first camera's point; NaN where it has none."""
    start: int
    """The frame in which points were chosen."""
    notes: tuple[str, ...]
    """What a user should know of this answer."""

    def __post_init__(self) -> None:
        freeze_fields(self, "tracks", "tracks_sd", "probability")

    @property
    def tied(self) -> Mask:
        """(C,) which cameras share points with the first."""
        return np.asarray(np.isfinite(self.probability).any(axis=1))


def track_views(
    videos: Sequence[Pictures],
    *,
    frame: int = 0,
    count: int = 100,
    within: Mask | None = None,
    points: Floats | None = None,
    patches: FollowSettings = DEFAULT,
    told: Told = quiet,
) -> ViewTracks:
    """Choose points in the first camera, and track them in all cameras, with nothing known of the cameras.

    Places that look like a point are candidates in the other camera; all are followed, and the motion decides which is
    the point (`match_tracks`). Points that had none are looked for beside those that were found.

    Args:
        videos: The cameras' grey pictures, the same instants in each.
        frame: The frame in which points are chosen and compared.
        count: How many points at most.
        within: (H, W) where points may lie in the first camera's picture; everywhere when None.
        points: (P, 2) the points themselves in the first camera's picture, instead of chosen ones [px].
        patches: How points are followed.
        told: Is told of the progress.

    Returns:
        The tracks of the points that at least two cameras share, without places that strayed off their points
        (`without_strays`). Points of the background, which do not move, are left out where points were chosen.

    Raises:
        SettingProblem: There are fewer than two videos, they differ in length, or a number is impossible.
        MareyError: There is nothing to follow, or no camera shares enough points with the first.
    """
    require_videos(videos, frame)
    points, first, first_sd = in_first_video(videos[0], frame, points, within, count, patches, told)
    book = _Book(np.asarray(points, float), [first], [first_sd], [np.ones(len(points))], [np.asarray(points, float)])
    notes = []
    for camera in range(1, len(videos)):
        if not _add_camera(videos, camera, frame, patches, told, book):
            notes.append(UNTIED.format(camera=camera + 1))
    if len(notes) == len(videos) - 1:
        raise MareyError(
            "No other camera shares points with the first whose motion agrees. Videos of one instant, taken from "
            "directions at most some 30 degrees apart, of a surface with texture are needed."
        )
    return _told(book, frame, tuple(notes))


def in_first_video(
    video: Pictures, frame: int, points: Floats | None, within: Mask | None, count: int, patches: FollowSettings,
    told: Told,
) -> tuple[Floats, Floats, Floats]:  # fmt: skip
    """Follow points through the first video: the given ones, or good features as far as they move.

    Args:
        video: Its pictures.
        frame: In which the points are, or are chosen.
        points: (P, 2) [px], or None to choose.
        within: Where they may be chosen.
        count: How many are chosen at most.
        patches: How they are followed.
        told: Is told of the progress.

    Returns:
        The points (P, 2), their tracks and deviations (F, 2, P) [px].

    Raises:
        MareyError: There is too little to follow.
    """
    given = points is not None
    if points is None:
        points = good_features(video[frame], count=count, size=patches.size, within=within)
    if len(points) < LEAST_PAIRS:
        raise MareyError(
            f"Only {len(points)} points can be followed in frame {frame} of the first video; at least {LEAST_PAIRS} "
            "are needed. Give another frame or a larger region."
        )
    tracks, spread = followed(video, points, frame, patches, told, "Following points in camera 1")
    if given:
        return points, tracks, spread
    moving = moves(tracks)
    return points[moving], tracks[:, :, moving], spread[:, :, moving]


def _told(book: "_Book", frame: int, notes: tuple[str, ...]) -> ViewTracks:
    """Give the points that at least two cameras share, without places that strayed."""
    probability = np.stack(book.probability)
    shared, tied = np.isfinite(probability).sum(axis=0) >= 2, np.isfinite(probability).any(axis=1)
    tracks, spread = np.stack(book.tracks)[..., shared], np.stack(book.tracks_sd)[..., shared]
    tracks[tied] = without_strays(tracks[tied], spread[tied])
    return ViewTracks(
        tracks=tracks, tracks_sd=np.where(np.isfinite(tracks), spread, np.nan), probability=probability[:, shared],
        start=frame, notes=notes,
    )  # fmt: skip


def require_videos(videos: Sequence[Pictures], frame: int) -> None:
    """Refuse videos that are too few or of several lengths, and a frame that they do not have."""
    if len(videos) < 2:
        raise SettingProblem(f"Points are compared between two videos or more, not {len(videos)}.")
    lengths = [len(video) for video in videos]
    if len(set(lengths)) > 1:
        told = ", ".join(str(length) for length in lengths)
        raise SettingProblem(f"The videos have {told} frames; they must show the same instants.")
    if not 0 <= frame < lengths[0]:
        raise SettingProblem(f"Frame {frame} does not exist: the videos have the frames 0 to {lengths[0] - 1}.")


@dataclass
class _Book:
    """What has been found so far, one entry a camera."""

    points: Floats
    tracks: list[Floats]
    tracks_sd: list[Floats]
    probability: list[Floats]
    places: list[Floats]
    """(P, 2) in the start's frame, NaN where not found."""


def followed(
    video: Pictures, points: Floats, frame: int, patches: FollowSettings, told: Told, what: str
) -> tuple[Floats, Floats]:
    """Follow points; give tracks and standard deviations (F, 2, P), NaN where they are not seen."""
    height, width = video[frame].shape
    inside = np.all((points >= 0) & (points <= (width - 1, height - 1)), axis=1)
    tracks = np.full((len(video), 2, len(points)), np.nan)
    spread = tracks.copy()
    if inside.any():
        found = follow_points(
            video, points[inside], frame=frame, settings=patches, progress=lambda done, all: told(what, done, all)
        ).found
        tracks[:, :, inside], spread[:, :, inside] = found.tracks, found.tracks_sd
    return tracks, spread


def moves(tracks: Floats) -> Mask:
    """Tell which points (P,) move at all in tracks (F, 2, P)."""
    away = np.linalg.norm(tracks - np.nanmedian(tracks, axis=0), axis=1)
    return np.asarray(np.nan_to_num(away).max(axis=0) > _STILL)


def _add_camera(
    videos: Sequence[Pictures], camera: int, frame: int, patches: FollowSettings, told: Told, book: _Book
) -> bool:
    """Find and follow the points in one more camera; tell whether enough were found."""
    picture, count = videos[camera][frame], len(book.points)
    what = f"Following points in camera {camera + 1}"
    tied = [c for c in range(len(book.places)) if np.isfinite(book.places[c]).any()]
    candidates = _candidates(videos, tied, picture, frame, book)
    places = np.full((count, 2), np.nan)
    if len(candidates.points) >= LEAST_PAIRS:
        tracks, _ = followed(videos[camera], candidates.pixels, frame, patches, told, what)
        pairs, _ = _confirmed(book.tracks[0], tracks, candidates.points, candidates.correlation, count)
        places[pairs[:, 0]] = candidates.pixels[pairs[:, 1]]
    correlation = np.full(count, np.nan)
    seeded = np.isfinite(places[:, 0])
    if seeded.sum() >= LEAST_PAIRS:
        for source in tied:
            here = np.flatnonzero(np.isfinite(book.places[source][:, 0]))
            places[here], alike = find_beside(videos[source][frame], picture, book.places[source][here], places[here])
            correlation[here] = np.where(np.isfinite(alike), alike, correlation[here])
    known = np.flatnonzero(np.isfinite(places[:, 0]))
    tracks, spread = np.full((2, *book.tracks[0].shape), np.nan)
    probability = np.full(count, np.nan)
    if len(known) >= LEAST_PAIRS:
        own, own_sd = followed(videos[camera], places[known], frame, patches, told, what)
        alike = np.where(np.isfinite(correlation[known]), correlation[known], _USUAL_LIKENESS)
        pairs, sure = _confirmed(book.tracks[0], own, known, alike, count)
        tracks[:, :, pairs[:, 0]], spread[:, :, pairs[:, 0]] = own[:, :, pairs[:, 1]], own_sd[:, :, pairs[:, 1]]
        probability[pairs[:, 0]] = sure
    places[~np.isfinite(probability)] = np.nan
    book.tracks.append(tracks)
    book.tracks_sd.append(spread)
    book.probability.append(probability)
    book.places.append(places)
    return bool(np.isfinite(probability).any())


def _candidates(
    videos: Sequence[Pictures], tied: Sequence[int], picture: np.ndarray, frame: int, book: _Book
) -> Candidates:
    """Find candidates of all points by what they look like in any of the cameras that are tied already."""
    parts = []
    for source in tied:
        here = np.flatnonzero(np.isfinite(book.places[source][:, 0]))
        found = find_candidates(videos[source][frame], picture, book.places[source][here])
        parts.append(found._replace(points=here[found.points]))
    return without_twins(Candidates(*(np.concatenate(part) for part in zip(*parts, strict=True))))


def _confirmed(
    first: Floats, second: Floats, owner: Integers, correlation: Floats, count: int
) -> tuple[Integers, Floats]:
    """Let the motion decide which candidates (of points `owner`) are the points; give pairs and probabilities."""
    looks = np.full((count, len(owner)), _UNLIKE)
    looks[owner, np.arange(len(owner))] = evidence_of_likeness(correlation)
    found = match_tracks(first, second, looks)
    good = found.probability >= PROBABLE
    return found.pairs[good], found.probability[good]


def evidence_of_likeness(correlation: Floats) -> Floats:
    """Give how much more probable a correlation is for one point than for two, in natural logarithms."""
    level = np.arctanh(np.clip(correlation, -0.999, 0.999))
    same = (level - np.arctanh(_USUAL_LIKENESS)) / _LIKENESS_SPREAD
    chance = (level - np.arctanh(_CHANCE_LIKENESS)) / _CHANCE_SPREAD
    evidence = 0.5 * (chance**2 - same**2) - np.log(_LIKENESS_SPREAD / _CHANCE_SPREAD)
    return np.asarray(np.clip(evidence, -10, 10))
