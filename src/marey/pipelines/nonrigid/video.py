"""From videos to tracks: points are selected or given, followed, and refined together."""

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial

import numpy as np

from marey.arrays import Floats, Mask
from marey.errors import MareyError
from marey.images.matching.feature_tracks import FeatureTracks, follow_points
from marey.images.matching.features import edge_features, good_features
from marey.io.stages import Arrays
from marey.io.video.pictures import grey_pictures
from marey.nonrigid.correspondence.calibrated_videos import track_calibrated_views
from marey.nonrigid.correspondence.uncalibrated_videos import track_views
from marey.nonrigid.tracking.rank_tracking import refine_tracks
from marey.pipelines.nonrigid.input import NonRigidInput
from marey.pipelines.progress import Progress
from marey.pipelines.run_record import StageCache

CORNERS, EDGES = 30, 80
"""Number of corners and of points on edges that are selected ([Alexander2003] section 3.2)."""
STILL_PX = 2.0
"""A point that never moves farther from its mean position belongs to the background [px].

Chosen by hand; results were not measured against other values.
"""
_TRACKS = ("tracks", "tracks_sd", "visible", "predicted")
"""Names of the arrays of `FeatureTracks`."""


@dataclass(frozen=True, eq=False, kw_only=True)
class VideoTracks:
    """Tracks of points in one video."""

    found: FeatureTracks
    """Tracks over all frames of the video."""
    rank: int
    """Rank of the tracks, without the translation."""
    curve: Floats
    """(n, 2) ranks that were tried, and their held-out error [px]."""
    notes: tuple[str, ...]
    """Remarks on points that were left out, one sentence each."""


def follow_video(given: NonRigidInput, number: int, cache: StageCache, progress: Progress) -> VideoTracks:
    """Follow points through one video, or read the checkpoint of an interrupted run.

    Args:
        given: The input.
        number: Number of the video.
        cache: Checkpoints of the run.
        progress: Progress reporter.

    Raises:
        MareyError: The video has nothing to follow.
    """
    name = given.names[number]
    start = given.starts[number] if given.starts else None
    depends = (name, given.first, given.end, start, given.within, CORNERS, EDGES)

    def compute() -> dict[str, np.ndarray]:
        return _followed(given, number, cache, progress)

    arrays = cache.arrays(f"tracks-{number}", compute, depends=depends)
    found = FeatureTracks(**{key: arrays[key] for key in _TRACKS})
    return _without_background(_widened(found, given), arrays, given)


def follow_views(
    given: NonRigidInput, cache: StageCache, progress: Progress
) -> tuple[tuple[VideoTracks, ...], Floats, tuple[str, ...]]:
    """Follow points through several videos of one scene: selected or given in the first, and found in the others.

    Args:
        given: The input.
        cache: Checkpoints of the run.
        progress: Progress reporter.

    Returns:
        The tracks of each video, with the points in the same order in all; the probability (C, P) that the track of a
        video belongs to the point of the first video, NaN where there is no track; and notes.

    Raises:
        MareyError: There is nothing to follow, or no other camera has points in common with the first.
    """
    points, frame = given.starts[0] if given.starts else (None, given.first)

    def compute() -> dict[str, np.ndarray]:
        videos = [_pictures(given, number, cache, progress) for number in range(len(given.clips))]
        with _NamedStages(progress) as stages:
            track = track_views if given.rig is None else partial(track_calibrated_views, rig=given.rig)
            found = track(videos, frame=frame - given.first, points=points, within=given.within, progress=stages.step)
        return {
            "tracks": found.tracks, "tracks_sd": found.tracks_sd, "probability": found.probability,
            "notes": np.array(found.notes, np.str_),
        }  # fmt: skip

    depends = (given.names, given.first, given.end, points, frame, given.within, given.rig)
    arrays = cache.arrays("views", compute, depends=depends)
    videos = []
    for tracks, sd in zip(arrays["tracks"], arrays["tracks_sd"], strict=True):
        seen = np.isfinite(tracks).all(1)
        one = FeatureTracks(tracks=tracks, tracks_sd=sd, visible=seen, predicted=np.zeros_like(seen))
        videos.append(VideoTracks(found=_widened(one, given), rank=0, curve=np.zeros((0, 2)), notes=()))
    return tuple(videos), arrays["probability"], tuple(map(str, arrays["notes"]))


class _NamedStages:
    """Shows the stages of a function that reports their names one after the other."""

    def __init__(self, progress: Progress):
        self._progress, self._what, self._open = progress, "", ExitStack()
        self._step: Callable[[], None] = lambda: None

    def step(self, what: str, done: int, total: int) -> None:
        if what != self._what:
            self._open.close()
            self._what, self._open = what, ExitStack()
            self._step = self._open.enter_context(self._progress.stage(what, total))
        self._step()

    def __enter__(self) -> "_NamedStages":
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()


def _pictures(given: NonRigidInput, number: int, cache: StageCache, progress: Progress) -> list[np.ndarray]:
    of = f" {given.names[number]}" if len(given.clips) > 1 else ""
    frames = range(given.first, given.end)
    with progress.stage(f"Images{of}", len(frames)) as step:
        return grey_pictures(cache.folder / f"grey-{number}.npy", given.clips[number], frames, step)


def _followed(given: NonRigidInput, number: int, cache: StageCache, progress: Progress) -> dict[str, np.ndarray]:
    of = f" {given.names[number]}" if len(given.clips) > 1 else ""
    pictures = _pictures(given, number, cache, progress)
    if given.starts:
        points, frame = given.starts[number]
        frame -= given.first
    else:
        points, frame = _chosen(pictures[0], given), 0
    with progress.stage(f"Following{of}", len(pictures) - 1) as step:
        followed = follow_points(pictures, points, frame=frame, progress=_each(step))
    with progress.stage(f"Refining{of}"):
        refined = refine_tracks(pictures, followed)
    arrays = {key: np.asarray(getattr(refined.tracks, key)) for key in _TRACKS}
    return arrays | {"rank": np.array(refined.rank), "curve": refined.curve}


def _each(step: Callable[[], None]) -> Callable[[int, int], None]:
    return lambda done, total: step()


def _chosen(first: np.ndarray, given: NonRigidInput) -> Floats:
    strong = good_features(first, count=CORNERS, within=given.within)
    weak = edge_features(first, count=EDGES, taken=strong, within=given.within)
    if not len(strong):
        raise MareyError(
            f"{given.paths[0]}: frame {given.first} has no corners to follow. Begin with another frame "
            "(--frames), or give points (--points)."
        )
    return np.concatenate([strong, weak])


def _widened(found: FeatureTracks, given: NonRigidInput) -> FeatureTracks:
    """Extend the tracks to all frames of the video; the others are NaN."""
    count = found.tracks.shape[2]
    tracks, sd = np.full((2, given.frames, 2, count), np.nan)
    visible, predicted = np.zeros((2, given.frames, count), bool)
    tracks[given.requested], sd[given.requested] = found.tracks, found.tracks_sd
    visible[given.requested], predicted[given.requested] = found.visible, found.predicted
    return FeatureTracks(tracks=tracks, tracks_sd=sd, visible=visible, predicted=predicted)


def _without_background(found: FeatureTracks, arrays: Arrays, given: NonRigidInput) -> VideoTracks:
    """Leave out selected points that do not move, if others do; given points are kept."""
    notes: tuple[str, ...] = ()
    moves = np.ones(found.tracks.shape[2], bool) if given.starts else _moving(found)
    if 4 <= moves.sum() < len(moves):
        notes = (f"{int((~moves).sum())} points never move by more than {STILL_PX:g} px: excluded as background.",)
        found = FeatureTracks(
            tracks=found.tracks[:, :, moves], tracks_sd=found.tracks_sd[:, :, moves], visible=found.visible[:, moves],
            predicted=found.predicted[:, moves],
        )  # fmt: skip
    return VideoTracks(found=found, rank=int(arrays["rank"]), curve=arrays["curve"], notes=notes)


def _moving(found: FeatureTracks) -> Mask:
    """Return which points (P,) move farther than `STILL_PX` from their mean position."""
    seen = np.where(found.visible[:, None], found.tracks, np.nan)
    known: Mask = np.asarray(np.isfinite(seen).all(1))
    middle = np.where(known[:, None], seen, 0).sum(0) / np.maximum(known.sum(0), 1)
    away = np.where(known, np.linalg.norm(seen - middle, axis=1), 0)
    moves: Mask = away.max(0) > STILL_PX
    return moves
