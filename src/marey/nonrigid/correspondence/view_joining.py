"""Joining of the points of several cameras into one array, from the correspondences of pairs of cameras."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from marey.arrays import Floats, Integers, freeze_fields
from marey.errors import SettingProblem
from marey.nonrigid.correspondence.partial_assignment import best_pairs, pair_probabilities
from marey.nonrigid.correspondence.view_correspondence import Correspondence, TrackMatchSettings, match_tracks

_SWEEPS = 10
"""Largest number of rounds in which the tracks of all cameras are assigned again; a limit on time."""
UNCONNECTED_CAMERA = "Camera {camera} shares no points with the others: its points have no partners."
"""Note of a camera without correspondences."""


@dataclass(frozen=True, eq=False, kw_only=True)
class JoinedViews:
    """Tracks of the same points in several cameras."""

    tracks: Floats
    """(C, F, 2, N) NaN where a camera does not see the point."""
    points: Integers
    """(C, N) index of the camera's track; -1 where there is none."""
    probability: Floats
    """(C, N) probability that the track belongs to the point, given the others; 1 where it is the only one, NaN where
    there is none."""
    notes: tuple[str, ...]
    """Notes for the user."""

    def __post_init__(self) -> None:
        freeze_fields(self, "tracks", "probability")
        freeze_fields(self, "points", dtype=np.int64)

    def shared(self, cameras: int = 2) -> Integers:
        """Find the points (n,) that at least so many cameras see."""
        return np.flatnonzero((self.points >= 0).sum(axis=0) >= cameras)


def join_views(
    views: Sequence[Floats],
    appearance: Mapping[tuple[int, int], Floats] | None = None,
    settings: TrackMatchSettings | None = None,
) -> JoinedViews:
    """Match the tracks of several fixed, synchronised, uncalibrated cameras.

    All pairs of cameras are matched (`match_tracks`). A point has at most one track per camera; the tracks of each
    camera in turn are assigned to the points by the scores of all other cameras together, until convergence.

    Args:
        views: Tracks (F, 2, P) of each camera, each with its own number of points.
        appearance: Appearance of the points of cameras (i, j), i < j, as for `match_tracks`.
        settings: Tuned constants of `match_tracks`; the defaults if None.

    Returns:
        All points, in descending order of the number of cameras that see them.

    Raises:
        SettingProblem: There are fewer than two cameras, or the shapes of the arrays do not match.
    """
    if len(views) < 2:
        raise SettingProblem(f"There are tracks of {len(views)} cameras; expected two cameras or more.")
    looks, settings = appearance or {}, settings or TrackMatchSettings()
    found = {
        (i, j): match_tracks(views[i], views[j], looks.get((i, j)), settings)
        for i, j in combinations(range(len(views)), 2)
    }
    return join_pairs(views, found)


def join_pairs(views: Sequence[Floats], found: Mapping[tuple[int, int], Correspondence]) -> JoinedViews:
    """Join the points of several cameras as `join_views` does, from the correspondences of cameras (i, j), i < j."""
    order, notes = _order(found, len(views))
    points = _joined(found, order, [view.shape[2] for view in views])
    points = points[:, np.argsort(-(points >= 0).sum(axis=0), kind="stable")]
    of_pairs = [f"Cameras {i + 1} and {j + 1}: {note}" for (i, j), pair in found.items() for note in pair.notes]
    return JoinedViews(
        tracks=_tracks(views, points), points=points, probability=_probability(found, points), notes=(*notes, *of_pairs)
    )


def _scores(found: Mapping[tuple[int, int], Correspondence], camera: int, other: int) -> Floats:
    """Look up the scores of two cameras, (P of the one, P of the other)."""
    return found[camera, other].score if camera < other else found[other, camera].score.T


def _order(found: Mapping[tuple[int, int], Correspondence], cameras: int) -> tuple[list[int], list[str]]:
    """Order the cameras by the number of points that they share with the preceding ones, most first."""
    shared = np.zeros((cameras, cameras))
    for (i, j), pair in found.items():
        shared[i, j] = shared[j, i] = pair.probability.sum()
    order = [int(shared.sum(axis=1).argmax())]
    notes = []
    while len(order) < cameras:
        rest = [camera for camera in range(cameras) if camera not in order]
        best = max(rest, key=lambda camera: shared[camera, order].sum())
        if shared[best, order].sum() == 0:
            notes.append(UNCONNECTED_CAMERA.format(camera=best + 1))
        order.append(best)
    return order, notes


def _joined(found: Mapping[tuple[int, int], Correspondence], order: Sequence[int], counts: Sequence[int]) -> Integers:
    """Assign the tracks of each camera to points (C, N)."""
    points = np.full((len(counts), counts[order[0]]), -1, np.int64)
    points[order[0]] = np.arange(counts[order[0]])
    for camera in order[1:]:
        points = _reassigned(found, points, camera, counts[camera])
    for _ in range(_SWEEPS):
        before = points
        for camera in order:
            points = _reassigned(found, points, camera, counts[camera])
        if points.shape == before.shape and np.array_equal(points, before):
            break
    return points


def _reassigned(found: Mapping[tuple[int, int], Correspondence], points: Integers, camera: int, count: int) -> Integers:
    """Assign the tracks of a camera again; a track that fits no point becomes a new point."""
    points = points.copy()
    points[camera] = -1
    points = points[:, (points >= 0).any(axis=0)]
    score = _summed_scores(found, points, camera, count)
    columns, tracks = best_pairs(score)
    points[camera, columns] = tracks
    alone = np.setdiff1d(np.arange(count), tracks)
    own = np.full((len(points), len(alone)), -1, np.int64)
    own[camera] = alone
    return np.concatenate([points, own], axis=1)


def _summed_scores(
    found: Mapping[tuple[int, int], Correspondence], points: Integers, camera: int, count: int
) -> Floats:
    """Sum the scores of a camera's tracks with those of the other cameras, (N, count)."""
    score = np.zeros((points.shape[1], count))
    for other in range(len(points)):
        seen = np.flatnonzero(points[other] >= 0)
        if other != camera and len(seen):
            score[seen] += _scores(found, other, camera)[points[other, seen]]
    return score


def _probability(found: Mapping[tuple[int, int], Correspondence], points: Integers) -> Floats:
    """Compute the probability (C, N) of each track's point, given the tracks of the other cameras."""
    probability = np.where(points >= 0, 1.0, np.nan)
    for camera in range(len(points)):
        rest = points.copy()
        rest[camera] = -1
        columns = np.flatnonzero((points[camera] >= 0) & (rest >= 0).any(axis=0))
        chance = pair_probabilities(_summed_scores(found, rest, camera, int(points[camera].max(initial=-1)) + 1))
        probability[camera, columns] = chance[columns, points[camera, columns]]
    return probability


def _tracks(views: Sequence[Floats], points: Integers) -> Floats:
    tracks = np.full((len(views), len(views[0]), 2, points.shape[1]), np.nan)
    for camera, view in enumerate(views):
        seen = np.flatnonzero(points[camera] >= 0)
        tracks[camera][:, :, seen] = view[:, :, points[camera, seen]]
    return tracks
