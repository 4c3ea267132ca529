"""Tracks of the same points in the videos of several calibrated, synchronised cameras."""

from collections.abc import Sequence

import numpy as np

from marey.arrays import Floats, Mask
from marey.cameras.camera import Camera
from marey.cameras.rig import Rig
from marey.errors import MareyError, SettingProblem
from marey.images.matching.epipolar_search import find_on_lines
from marey.images.matching.feature_tracks import DEFAULT, FollowSettings, Pictures
from marey.nonrigid.correspondence.calibrated_correspondence import match_calibrated
from marey.nonrigid.correspondence.uncalibrated_videos import (
    LEAST_PAIRS,
    PROBABLE,
    ProgressReporter,
    ViewTracks,
    evidence_of_likeness,
    followed,
    in_first_video,
    no_progress,
    require_videos,
)
from marey.nonrigid.tracking.stray_places import without_strays

NAMED_CAMERA_WITHOUT_POINTS = "Camera '{camera}' shares no points with '{first}' that could be found: it is ignored."
"""Note of a camera without common points."""


def track_calibrated_views(
    videos: Sequence[Pictures],
    rig: Rig,
    *,
    frame: int = 0,
    count: int = 100,
    within: Mask | None = None,
    points: Floats | None = None,
    patches: FollowSettings = DEFAULT,
    progress: ProgressReporter = no_progress,
) -> ViewTracks:
    """Select points in the first camera, and track them in all cameras.

    Positions on a point's epipolar line that resemble it are candidates. All are followed, and the one that stays on
    the epipolar line of the point's track is the point (`match_calibrated`).

    Args:
        videos: Grey images of the cameras, the same instants in each.
        rig: The cameras, in the order of the videos.
        frame: Frame in which points are selected and compared.
        count: Largest number of points.
        within: (H, W) mask of possible positions in the first camera's image; everywhere if None.
        points: (P, 2) given points in the first camera's image instead of selected ones [px].
        patches: Settings with which points are followed.
        progress: Progress reporter.

    Returns:
        The tracks of the points that at least two cameras share, without outliers (`without_strays`). Points that do
        not move are excluded if points were selected.

    Raises:
        SettingProblem: The videos do not match the cameras or each other, or a number is impossible.
        MareyError: There is nothing to follow, or no camera shares enough points with the first.
    """
    require_videos(videos, frame)
    if len(videos) != len(rig):
        raise SettingProblem(f"There are {len(videos)} videos, but the calibration has {len(rig)} cameras.")
    points, first, first_sd = in_first_video(videos[0], frame, points, within, count, patches, progress)
    tracks, spread, probability = [first], [first_sd], [np.ones(len(points), float)]
    for number in range(1, len(videos)):
        what = f"Following points in camera {number + 1}"
        pair = (rig.cameras[0], rig.cameras[number])
        found = _in_camera((videos[0][frame], videos[number]), pair, (points, first), frame, patches, progress, what)
        tracks.append(found[0])
        spread.append(found[1])
        probability.append(found[2])
    return _shared(np.stack(tracks), np.stack(spread), np.stack(probability), rig, frame)


def _in_camera(
    pictures: tuple[np.ndarray, Pictures],
    cameras: tuple[Camera, Camera],
    given: tuple[Floats, Floats],
    frame: int,
    patches: FollowSettings,
    progress: ProgressReporter,
    what: str,
) -> tuple[Floats, Floats, Floats]:
    """Find and follow points in one more camera.

    Args:
        pictures: First camera's image in which points were selected, and the other camera's video.
        cameras: Both cameras.
        given: Points (P, 2) and their tracks (F, 2, P) in the first camera.
        frame: Frame in which points were selected.
        patches: Settings with which points are followed.
        progress: Progress reporter.
        what: Description of the work for the progress reporter.

    Returns:
        Tracks and standard deviations (F, 2, P), and probabilities (P,).
    """
    (template, video), (points, first) = pictures, given
    tracks, spread = np.full((2, *first.shape), np.nan)
    probability = np.full(len(points), np.nan)
    candidates = find_on_lines(template, video[frame], points, cameras)
    if len(candidates.points) < LEAST_PAIRS:
        return tracks, spread, probability
    own, own_sd = followed(video, candidates.pixels, frame, patches, progress, what)
    looks = np.full((len(points), len(candidates.points)), -np.inf)
    looks[candidates.points, np.arange(len(candidates.points))] = evidence_of_likeness(candidates.correlation)
    found = match_calibrated(first, own, cameras, looks)
    pairs = found.pairs[found.probability >= PROBABLE]
    tracks[:, :, pairs[:, 0]], spread[:, :, pairs[:, 0]] = own[:, :, pairs[:, 1]], own_sd[:, :, pairs[:, 1]]
    probability[pairs[:, 0]] = found.probability[found.probability >= PROBABLE]
    return tracks, spread, probability


def _shared(tracks: Floats, spread: Floats, probability: Floats, rig: Rig, frame: int) -> ViewTracks:
    """Assemble the points that at least two cameras share, without outliers."""
    connected = np.isfinite(probability).sum(1) >= LEAST_PAIRS
    if connected.sum() < 2:
        raise MareyError(
            "No other camera shares points with the first: the calibration or the order of the cameras may be wrong, "
            "the videos may show different instants, or the views may be too far apart."
        )
    notes = tuple(
        NAMED_CAMERA_WITHOUT_POINTS.format(camera=name, first=rig.names[0])
        for name, good in zip(rig.names, connected, strict=True)
        if not good
    )
    kept = np.isfinite(probability).sum(0) >= 2
    tracks[connected] = without_strays(tracks[connected], spread[connected])
    return ViewTracks(
        tracks=tracks[..., kept], tracks_sd=np.where(np.isfinite(tracks), spread, np.nan)[..., kept],
        probability=probability[:, kept], start=frame, notes=notes,
    )  # fmt: skip
