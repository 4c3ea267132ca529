"""What shapes are recovered from: points followed in videos, or read, and matched between cameras."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.errors import MareyError
from marey.nonrigid.correspondence.calibrated_correspondence import join_calibrated
from marey.nonrigid.correspondence.view_joining import join_views
from marey.nonrigid.one_camera.one_view import FEWEST_POINTS
from marey.pipelines.nonrigid.input import NonRigidInput
from marey.pipelines.nonrigid.video import VideoTracks, follow_video, follow_views
from marey.pipelines.progress import Progress
from marey.pipelines.run_record import StageCache


@dataclass(frozen=True, eq=False, kw_only=True)
class MeasuredPoints:
    """What the shapes are recovered from; one of `tracks` and `points` is there."""

    tracks: Floats | None = None
    """(C, F, 2, P) where points were seen; NaN elsewhere."""
    tracks_sd: Floats | None = None
    """(C, F, 2, P) [px]."""
    points: Floats | None = None
    """(F, P, 3)."""
    labels: tuple[str, ...]
    edges: Integers
    unit: str
    """Of the input: px, m, or that nobody says it."""
    videos: tuple[VideoTracks, ...] = ()
    """What was followed."""
    camera_points: Integers | None = None
    """(C, P) which track of each camera a point is, -1 where none, where that was found."""
    probability: Floats | None = None
    """(C, P) that it is that one."""

    @property
    def seen(self) -> Mask:
        """(C, F, P) by camera; of points in space C = 1."""
        if self.tracks is not None:
            return np.asarray(np.isfinite(self.tracks).all(2))
        assert self.points is not None
        return np.asarray(np.isfinite(self.points).all(2))[None]


def measure_points(given: NonRigidInput, cache: StageCache, progress: Progress) -> MeasuredPoints:
    """Give what is known of the points: in videos they are followed first, and of several cameras matched.

    Args:
        given: The input.
        cache: Of the run.
        progress: Is told.

    Raises:
        MareyError: A video shows nothing to follow, or cameras show no points in common.
    """
    if len(given.data) == 1:
        data = given.data[0]
        return MeasuredPoints(
            tracks=data.tracks, points=data.points, labels=data.labels, edges=data.edges, unit=data.unit
        )  # fmt: skip
    if given.data:
        views = [one.tracks[0, given.asked] for one in given.data if one.tracks is not None]
        return _joined(views, given, cache, progress)
    if len(given.clips) > len(given.starts) > 0 or (len(given.clips) > 1 and not given.starts):
        return _found_in_all(given, cache, progress)
    videos = tuple(follow_video(given, number, cache, progress) for number in range(len(given.clips)))
    for name, video in zip(given.names, videos, strict=True):
        for note in video.notes:
            progress.warn(f"{name}: {note}" if len(videos) > 1 else note)
    return _of_videos(videos)


def _of_videos(videos: tuple[VideoTracks, ...], probability: Floats | None = None) -> MeasuredPoints:
    """Give points that stand in one order in all videos; only what was seen counts."""
    tracks = np.stack([np.where(v.found.visible[:, None], v.found.tracks, np.nan) for v in videos])
    return MeasuredPoints(
        tracks=tracks, tracks_sd=np.stack([video.found.tracks_sd for video in videos]), videos=videos, unit="px",
        labels=tuple(map(str, range(tracks.shape[-1]))), edges=np.zeros((0, 2), np.int64), probability=probability,
    )  # fmt: skip


def _found_in_all(given: NonRigidInput, cache: StageCache, progress: Progress) -> MeasuredPoints:
    """Follow the first video's points in all of them."""
    videos, probability, notes = follow_views(given, cache, progress)
    for note in notes:
        progress.warn(note)
    seen = np.array([video.found.visible.any(0).sum() for video in videos])
    shared = int((np.sum([video.found.visible.any(0) for video in videos], axis=0) > 1).sum())
    each = ", ".join(f"{name} {count}" for name, count in zip(given.names, seen, strict=True))
    progress.report(f"Points found: {each}; {shared} of them in two cameras or more.")
    return _of_videos(videos, probability)


def _joined(views: Sequence[Floats], given: NonRigidInput, cache: StageCache, progress: Progress) -> MeasuredPoints:
    """Find which points of several cameras are the same, from how they move."""

    def compute() -> dict[str, np.ndarray]:
        found = join_views(views) if given.rig is None else join_calibrated(views, given.rig)
        kept = found.shared()
        if len(kept) < FEWEST_POINTS:
            words = " ".join(found.notes)
            raise MareyError(f"No {FEWEST_POINTS} points are the same in two cameras beyond chance. {words}")
        return {
            "tracks": found.tracks[..., kept], "points": found.points[:, kept],
            "probability": found.probability[:, kept], "notes": np.array(found.notes, np.str_),
        }  # fmt: skip

    depends = (given.first, given.end, given.rig, [np.nan_to_num(v) for v in views])
    with progress.stage("Matching cameras"):
        found = cache.arrays("matching", compute, depends=depends)
    for note in found["notes"]:
        progress.warn(str(note))
    tracks = np.full((len(views), given.frames, *found["tracks"].shape[2:]), np.nan)
    tracks[:, given.asked] = found["tracks"]
    labels = tuple("/".join("-" if p < 0 else str(p) for p in column) for column in found["points"].T)
    return MeasuredPoints(
        tracks=tracks, labels=labels, edges=np.zeros((0, 2), np.int64), unit=given.data[0].unit,
        camera_points=found["points"], probability=found["probability"],
    )  # fmt: skip
