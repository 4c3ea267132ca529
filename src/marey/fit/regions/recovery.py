"""Frames of a track in which the person was lost, and the person found again in them."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from marey.body.articulation.pose import Pose, PosedBody
from marey.fit.progress import FrameProgress, no_progress
from marey.fit.regions.places import standing_poses
from marey.fit.regions.region_track import RegionTrack, RegionTracker
from marey.fit.search.search import turned_about
from marey.fit.solver.threads import map_in_threads

SHORTEST_S = 0.15
"""Shortest time for which a person must be lost to be searched again [s]; a shorter gap is interpolated. Chosen by
hand."""
EVERY_S = 0.5
"""Distance of the frames in which a lost person is searched [s]. Chosen by hand."""


def find_again(
    tracker: RegionTracker, track: RegionTrack, *, progress: FrameProgress = no_progress
) -> RegionTrack:  # fmt: skip
    """Search a person in the frames in which it was lost, and track it from where it is found.

    Where the score is low, the person has left, is hidden, or the track has remained where the person was. In some of
    these frames, upright postures are compared at all places of the room, with the colours that the track has learned.

    Args:
        tracker: The tracker.
        track: The track.
        progress: Called with each frame that was searched or tracked again.

    Returns:
        The track with the better poses; its frames remain the same.
    """
    poses, scores = dict(track.poses), dict(track.scores)
    least, step = track.least_score(tracker.settings.least_share), max(1, round(EVERY_S * tracker.rate))
    for lost in _runs([frame for frame in poses if scores[frame] < least], list(poses)):
        if len(lost) < SHORTEST_S * tracker.rate:
            continue
        searched = lost[step // 2 :: step] or [lost[len(lost) // 2]]
        frame, (score, pose) = max(
            zip(searched, map_in_threads(lambda frame: _searched(tracker, track, frame), searched), strict=True),
            key=lambda each: each[1][0],
        )
        if score < least:
            continue
        facings = [
            tracker.track(replace(track, poses={frame: each}), lost, progress=progress)
            for each in (pose, turned_about(PosedBody(track.body, pose)))
        ]
        again = max(facings, key=lambda found: found.mean_score)
        better = [other for other in lost if again.scores[other] > scores[other]]
        poses |= {other: again.poses[other] for other in better}
        scores |= {other: again.scores[other] for other in better}
    return replace(track, poses=poses, scores=scores)


def _runs(frames: Sequence[int], known: Sequence[int]) -> list[list[int]]:
    """Return the runs of frames that are successive among the known ones."""
    place = {frame: i for i, frame in enumerate(known)}
    runs: list[list[int]] = []
    for frame in frames:
        if runs and place[frame] == place[runs[-1][-1]] + 1:
            runs[-1].append(frame)
        else:
            runs.append([frame])
    return runs


def _searched(tracker: RegionTracker, track: RegionTrack, frame: int) -> tuple[float, Pose]:
    """Return the score and the pose of the best posture at any place of a frame."""
    search, settings, images = tracker.search, tracker.settings, tracker.images_of(frame)
    table = search.word_table(track.learned, None, images, whole_share=settings.whole_shares[0])
    floor = track.shown(settings.least_share).floor
    tries = standing_poses(search.cameras, track.body, settings.places, floor)
    best = tries[int(np.argmax(search.scores(track.body, tries, images, table)))]
    posed = PosedBody(track.body, best)
    table = search.word_table(track.learned, posed, images, whole_share=settings.whole_shares[-1])
    return tracker.best_posture(posed, images, table)
