"""Tracks of the same points in the videos of several uncalibrated, synchronised cameras."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Integers, Mask, freeze_fields
from marey.errors import MareyError, SettingProblem
from marey.images.matching.feature_tracks import DEFAULT, FollowSettings, Pictures, follow_points
from marey.images.matching.features import good_features
from marey.images.matching.patch_search import Candidates, find_beside, find_candidates, without_duplicates
from marey.nonrigid.correspondence.view_correspondence import match_tracks
from marey.nonrigid.tracking.stray_places import without_strays

LEAST_PAIRS = 8
"""Least number of points that two cameras must share. Chosen by hand; results were not measured against other
values."""
PROBABLE = 0.5
"""Least probability of a pair that is used."""
_UNLIKE = -20.0
"""Log-likelihood ratio of pairs that are no candidates by their appearance [natural logarithm]."""
_USUAL_LIKENESS, _LIKENESS_SPREAD = 0.95, 0.6
"""Correlation of the patches of one point in two cameras, and the standard deviation of its inverse hyperbolic tangent.
Chosen by hand; results were not measured against other values."""
_CHANCE_LIKENESS, _CHANCE_SPREAD = 0.75, 0.3
"""The same for patches of different points that were matched by chance."""
_LARGEST_CORRELATION = 0.999
"""Correlations are limited to this absolute value before their inverse hyperbolic tangent is taken."""
_LARGEST_EVIDENCE = 10.0
"""Largest absolute log-likelihood ratio from appearance alone [natural logarithm]."""
_STILL = 1.5
"""Points that never move farther than this from their median position belong to the background [px]. Chosen by hand;
results were not measured against other values."""
CAMERA_WITHOUT_POINTS = "Camera {camera} shares no moving points with the others that could be found: it is ignored."
"""Note of a camera without common points."""

ProgressReporter = Callable[[str, int, int], None]
"""Function that is called with a description of the work, the number of steps done, and their total number."""


def no_progress(_what: str, _done: int, _all: int) -> None:
    """Ignore progress."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ViewTracks:
    """Tracks of the same points in several cameras."""

    tracks: Floats
    """(C, F, 2, P) [px]; NaN where a camera does not see the point."""
    tracks_sd: Floats
    """(C, F, 2, P) standard deviations of the tracks [px]."""
    probability: Floats
    """(C, P) probability that the camera's track shows the first camera's point; NaN where it has none."""
    start: int
    """Frame in which points were selected."""
    notes: tuple[str, ...]
    """Notes for the user."""

    def __post_init__(self) -> None:
        freeze_fields(self, "tracks", "tracks_sd", "probability")

    @property
    def connected(self) -> Mask:
        """(C,) mask of the cameras that share points with the first."""
        return np.asarray(np.isfinite(self.probability).any(axis=1))


def track_views(
    videos: Sequence[Pictures],
    *,
    frame: int = 0,
    count: int = 100,
    within: Mask | None = None,
    points: Floats | None = None,
    patches: FollowSettings = DEFAULT,
    progress: ProgressReporter = no_progress,
) -> ViewTracks:
    """Select points in the first camera, and track them in all cameras without calibration.

    Positions that resemble a point are candidates in the other cameras. All are followed, and their motion determines
    which is the point (`match_tracks`). Points without a match are then searched for near those that were found.

    Args:
        videos: Grey images of the cameras, the same instants in each.
        frame: Frame in which points are selected and compared.
        count: Largest number of points.
        within: (H, W) mask of possible positions in the first camera's image; everywhere if None.
        points: (P, 2) given points in the first camera's image instead of selected ones [px].
        patches: Settings with which points are followed.
        progress: Progress reporter.

    Returns:
        The tracks of the points that at least two cameras share, without outliers (`without_strays`). Points of the
        background, which do not move, are excluded if points were selected.

    Raises:
        SettingProblem: There are fewer than two videos, they differ in length, or a number is impossible.
        MareyError: There is nothing to follow, or no camera shares enough points with the first.
    """
    require_videos(videos, frame)
    points, first, first_sd = in_first_video(videos[0], frame, points, within, count, patches, progress)
    points = np.asarray(points, float)
    matches = _Matches(points, [first], [first_sd], [np.ones(len(points))], [points])
    notes = []
    for camera in range(1, len(videos)):
        if not _add_camera(videos, camera, frame, patches, progress, matches):
            notes.append(CAMERA_WITHOUT_POINTS.format(camera=camera + 1))
    if len(notes) == len(videos) - 1:
        raise MareyError(
            "No other camera shares points with the first whose motion agrees. Give synchronised videos of a textured "
            "surface from directions at most about 30 degrees apart."
        )
    return _view_tracks(matches, frame, tuple(notes))


def in_first_video(
    video: Pictures, frame: int, points: Floats | None, within: Mask | None, count: int, patches: FollowSettings,
    progress: ProgressReporter,
) -> tuple[Floats, Floats, Floats]:  # fmt: skip
    """Follow points through the first video: the given ones, or good features that move.

    Args:
        video: Grey images of the video.
        frame: Frame in which the points are given or selected.
        points: (P, 2) given points [px]; selected if None.
        within: (H, W) mask of possible positions of selected points.
        count: Largest number of selected points.
        patches: Settings with which points are followed.
        progress: Progress reporter.

    Returns:
        The points (P, 2), their tracks and standard deviations (F, 2, P) [px].

    Raises:
        MareyError: There are too few points to follow.
    """
    given = points is not None
    if points is None:
        points = good_features(video[frame], count=count, size=patches.size, within=within)
    if len(points) < LEAST_PAIRS:
        raise MareyError(
            f"Only {len(points)} points can be followed in frame {frame} of the first video; at least {LEAST_PAIRS} "
            "are needed. Choose another frame or a larger region."
        )
    tracks, spread = followed(video, points, frame, patches, progress, "Following points in camera 1")
    if given:
        return points, tracks, spread
    moving = moving_points(tracks)
    return points[moving], tracks[:, :, moving], spread[:, :, moving]


def _view_tracks(matches: "_Matches", frame: int, notes: tuple[str, ...]) -> ViewTracks:
    """Assemble the points that at least two cameras share, without outliers."""
    probability = np.stack(matches.probability)
    shared, connected = np.isfinite(probability).sum(axis=0) >= 2, np.isfinite(probability).any(axis=1)
    tracks, spread = np.stack(matches.tracks)[..., shared], np.stack(matches.tracks_sd)[..., shared]
    tracks[connected] = without_strays(tracks[connected], spread[connected])
    return ViewTracks(
        tracks=tracks, tracks_sd=np.where(np.isfinite(tracks), spread, np.nan), probability=probability[:, shared],
        start=frame, notes=notes,
    )  # fmt: skip


def require_videos(videos: Sequence[Pictures], frame: int) -> None:
    """Check the number and the lengths of videos, and that a frame exists.

    Raises:
        SettingProblem: There are fewer than two videos, their lengths differ, or the frame does not exist.
    """
    if len(videos) < 2:
        raise SettingProblem(f"There is {len(videos)} video; expected two videos or more.")
    lengths = [len(video) for video in videos]
    if len(set(lengths)) > 1:
        listed = ", ".join(str(length) for length in lengths)
        raise SettingProblem(f"The videos have {listed} frames; they must show the same instants.")
    if not 0 <= frame < lengths[0]:
        raise SettingProblem(f"Frame {frame} does not exist: the videos have the frames 0 to {lengths[0] - 1}.")


@dataclass
class _Matches:
    """Points found so far, with one entry per camera."""

    points: Floats
    """(P, 2) points in the first camera's image [px]."""
    tracks: list[Floats]
    tracks_sd: list[Floats]
    probability: list[Floats]
    places: list[Floats]
    """(P, 2) positions in the selected frame; NaN where not found."""


def followed(
    video: Pictures, points: Floats, frame: int, patches: FollowSettings, progress: ProgressReporter, what: str
) -> tuple[Floats, Floats]:
    """Follow points (P, 2); return tracks and standard deviations (F, 2, P), NaN where they are not seen."""
    height, width = video[frame].shape
    inside = np.all((points >= 0) & (points <= (width - 1, height - 1)), axis=1)
    tracks = np.full((len(video), 2, len(points)), np.nan)
    spread = tracks.copy()
    if inside.any():
        found = follow_points(
            video, points[inside], frame=frame, settings=patches, progress=lambda done, all: progress(what, done, all)
        ).found
        tracks[:, :, inside], spread[:, :, inside] = found.tracks, found.tracks_sd
    return tracks, spread


def moving_points(tracks: Floats) -> Mask:
    """Find the points (P,) that move in tracks (F, 2, P)."""
    away = np.linalg.norm(tracks - np.nanmedian(tracks, axis=0), axis=1)
    return np.asarray(np.nan_to_num(away).max(axis=0) > _STILL)


def _add_camera(
    videos: Sequence[Pictures],
    camera: int,
    frame: int,
    patches: FollowSettings,
    progress: ProgressReporter,
    matches: _Matches,
) -> bool:
    """Find and follow the points in one more camera; return whether enough were found."""
    picture, count = videos[camera][frame], len(matches.points)
    what = f"Following points in camera {camera + 1}"
    connected = [c for c in range(len(matches.places)) if np.isfinite(matches.places[c]).any()]
    candidates = _candidates(videos, connected, picture, frame, matches)
    places = np.full((count, 2), np.nan)
    if len(candidates.points) >= LEAST_PAIRS:
        tracks, _ = followed(videos[camera], candidates.pixels, frame, patches, progress, what)
        pairs, _ = _confirmed(matches.tracks[0], tracks, candidates.points, candidates.correlation, count)
        places[pairs[:, 0]] = candidates.pixels[pairs[:, 1]]
    correlation = np.full(count, np.nan)
    seeded = np.isfinite(places[:, 0])
    if seeded.sum() >= LEAST_PAIRS:
        for source in connected:
            here = np.flatnonzero(np.isfinite(matches.places[source][:, 0]))
            places[here], alike = find_beside(
                videos[source][frame], picture, matches.places[source][here], places[here]
            )
            correlation[here] = np.where(np.isfinite(alike), alike, correlation[here])
    known = np.flatnonzero(np.isfinite(places[:, 0]))
    tracks, spread = np.full((2, *matches.tracks[0].shape), np.nan)
    probability = np.full(count, np.nan)
    if len(known) >= LEAST_PAIRS:
        own, own_sd = followed(videos[camera], places[known], frame, patches, progress, what)
        alike = np.where(np.isfinite(correlation[known]), correlation[known], _USUAL_LIKENESS)
        pairs, sure = _confirmed(matches.tracks[0], own, known, alike, count)
        tracks[:, :, pairs[:, 0]], spread[:, :, pairs[:, 0]] = own[:, :, pairs[:, 1]], own_sd[:, :, pairs[:, 1]]
        probability[pairs[:, 0]] = sure
    places[~np.isfinite(probability)] = np.nan
    matches.tracks.append(tracks)
    matches.tracks_sd.append(spread)
    matches.probability.append(probability)
    matches.places.append(places)
    return bool(np.isfinite(probability).any())


def _candidates(
    videos: Sequence[Pictures], connected: Sequence[int], picture: np.ndarray, frame: int, matches: _Matches
) -> Candidates:
    """Find candidates of all points by their appearance in any of the cameras that already share points."""
    parts = []
    for source in connected:
        here = np.flatnonzero(np.isfinite(matches.places[source][:, 0]))
        found = find_candidates(videos[source][frame], picture, matches.places[source][here])
        parts.append(found._replace(points=here[found.points]))
    return without_duplicates(Candidates(*(np.concatenate(part) for part in zip(*parts, strict=True))))


def _confirmed(
    first: Floats, second: Floats, owner: Integers, correlation: Floats, count: int
) -> tuple[Integers, Floats]:
    """Match candidates (of points `owner`) by their motion; return pairs and probabilities."""
    looks = np.full((count, len(owner)), _UNLIKE)
    looks[owner, np.arange(len(owner))] = evidence_of_likeness(correlation)
    found = match_tracks(first, second, looks)
    good = found.probability >= PROBABLE
    return found.pairs[good], found.probability[good]


def evidence_of_likeness(correlation: Floats) -> Floats:
    """Compute the log-likelihood ratio of a correlation, for one point against two [natural logarithm]."""
    level = np.arctanh(np.clip(correlation, -_LARGEST_CORRELATION, _LARGEST_CORRELATION))
    same = (level - np.arctanh(_USUAL_LIKENESS)) / _LIKENESS_SPREAD
    chance = (level - np.arctanh(_CHANCE_LIKENESS)) / _CHANCE_SPREAD
    evidence = 0.5 * (chance**2 - same**2) - np.log(_LIKENESS_SPREAD / _CHANCE_SPREAD)
    return np.asarray(np.clip(evidence, -_LARGEST_EVIDENCE, _LARGEST_EVIDENCE))
