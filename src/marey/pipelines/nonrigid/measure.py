"""Points from which shapes are recovered: followed in videos, or read, and matched between cameras."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.errors import MareyError
from marey.nonrigid.core.track_checks import FEWEST_POINTS
from marey.nonrigid.correspondence.calibrated_correspondence import join_calibrated
from marey.nonrigid.correspondence.view_joining import join_views
from marey.pipelines.nonrigid.input import NonRigidInput
from marey.pipelines.nonrigid.video import VideoTracks, follow_video, follow_views
from marey.pipelines.progress import Progress
from marey.pipelines.run_record import StageCache


@dataclass(frozen=True, eq=False, kw_only=True)
class NonRigidPoints:
    """Points from which shapes are recovered: either `tracks` or `points` is set."""

    tracks: Floats | None = None
    """(C, F, 2, P) positions in the images of C cameras [px]; NaN where a point is not visible."""
    tracks_sd: Floats | None = None
    """(C, F, 2, P) standard deviations of the tracks [px]."""
    points: Floats | None = None
    """(F, P, 3)."""
    labels: tuple[str, ...]
    edges: Integers
    unit: str
    """Unit of the input: px, m, or that it is not stated."""
    videos: tuple[VideoTracks, ...] = ()
    """Tracks of each video, over all of its frames."""
    camera_points: Integers | None = None
    """(C, P) number of the track of each camera, -1 if it has none; None if the correspondence was given."""
    probability: Floats | None = None
    """(C, P) probability of the correspondence."""
    notes: tuple[str, ...] = ()
    """What limits the correspondence, one sentence each."""

    @property
    def seen(self) -> Mask:
        """(C, F, P) true where a camera sees a point; C = 1 for points in space."""
        if self.tracks is not None:
            return np.asarray(np.isfinite(self.tracks).all(2))
        assert self.points is not None
        return np.asarray(np.isfinite(self.points).all(2))[None]


def measure_points(given: NonRigidInput, cache: StageCache, progress: Progress) -> NonRigidPoints:
    """Follow points in videos, and match them between cameras, where that is necessary.

    Args:
        given: The input.
        cache: Checkpoints of the run.
        progress: Progress reporter.

    Raises:
        MareyError: A video has nothing to follow, or the cameras have no points in common.
    """
    if len(given.data) == 1:
        data = given.data[0]
        return NonRigidPoints(
            tracks=data.tracks, points=data.points, labels=data.labels, edges=data.edges, unit=data.unit
        )  # fmt: skip
    if given.data:
        views = [one.tracks[0, given.requested] for one in given.data if one.tracks is not None]
        return _joined(views, given, cache, progress)
    if len(given.clips) > len(given.starts) > 0 or (len(given.clips) > 1 and not given.starts):
        return _found_in_all(given, cache, progress)
    videos = tuple(follow_video(given, number, cache, progress) for number in range(len(given.clips)))
    for name, video in zip(given.names, videos, strict=True):
        for note in video.notes:
            progress.warn(f"{name}: {note}" if len(videos) > 1 else note)
    return _of_videos(videos)


def _of_videos(
    videos: tuple[VideoTracks, ...], probability: Floats | None = None, notes: Sequence[str] = ()
) -> NonRigidPoints:
    """Combine the tracks of all videos, which have the same points in the same order; without predicted positions."""
    tracks = np.stack([np.where(v.found.visible[:, None], v.found.tracks, np.nan) for v in videos])
    return NonRigidPoints(
        tracks=tracks, tracks_sd=np.stack([video.found.tracks_sd for video in videos]), videos=videos, unit="px",
        labels=tuple(map(str, range(tracks.shape[-1]))), edges=np.zeros((0, 2), np.int64), probability=probability,
        notes=tuple(notes),
    )  # fmt: skip


def _found_in_all(given: NonRigidInput, cache: StageCache, progress: Progress) -> NonRigidPoints:
    """Follow the points of the first video in all videos."""
    videos, probability, notes = follow_views(given, cache, progress)
    for note in notes:
        progress.warn(note)
    seen = np.array([video.found.visible.any(0).sum() for video in videos])
    shared = int((np.sum([video.found.visible.any(0) for video in videos], axis=0) > 1).sum())
    each = ", ".join(f"{name} {count}" for name, count in zip(given.names, seen, strict=True))
    progress.report(f"Points found: {each}; {shared} of them by two cameras or more.")
    return _of_videos(videos, probability, notes)


def _joined(views: Sequence[Floats], given: NonRigidInput, cache: StageCache, progress: Progress) -> NonRigidPoints:
    """Match the points of several cameras by their motion."""

    def compute() -> dict[str, np.ndarray]:
        found = join_views(views) if given.rig is None else join_calibrated(views, given.rig)
        kept = found.shared()
        if len(kept) < FEWEST_POINTS:
            words = " ".join(found.notes)
            raise MareyError(
                f"Fewer than {FEWEST_POINTS} points match between two cameras more often than by chance. {words}"
            )
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
    tracks[:, given.requested] = found["tracks"]
    labels = tuple("/".join("-" if p < 0 else str(p) for p in column) for column in found["points"].T)
    return NonRigidPoints(
        tracks=tracks, labels=labels, edges=np.zeros((0, 2), np.int64), unit=given.data[0].unit,
        camera_points=found["points"], probability=found["probability"], notes=tuple(map(str, found["notes"])),
    )  # fmt: skip
