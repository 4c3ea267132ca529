"""Points of several uncalibrated cameras joined into one array, from what each two cameras say about each other."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from marey.arrays import Floats, Integers, freeze_fields
from marey.errors import SettingProblem
from marey.nonrigid.correspondence.partial_assignment import best_pairs, pair_probabilities
from marey.nonrigid.correspondence.view_correspondence import Correspondence, match_tracks

_SWEEPS = 10
UNTIED = "Camera {camera} could not be tied to the others: its points stand alone."


@dataclass(frozen=True, eq=False, kw_only=True)
class JoinedViews:
    """Tracks of the same points in several cameras."""

    tracks: Floats
    """(C, F, 2, N) NaN where a camera does not see the point."""
    points: Integers
    """(C, N) which track of the camera it is; -1 where none."""
    probability: Floats
    """(C, N) that this track belongs to the point, given the others; 1 where the point has no other, NaN where none."""
    notes: tuple[str, ...]
    """What a user should know of this answer."""

    def __post_init__(self) -> None:
        freeze_fields(self, "tracks", "probability")
        freeze_fields(self, "points", dtype=np.int64)

    def shared(self, cameras: int = 2) -> Integers:
        """Give the points (n,) that at least so many cameras see."""
        return np.flatnonzero((self.points >= 0).sum(axis=0) >= cameras)


def join_views(views: Sequence[Floats], appearance: Mapping[tuple[int, int], Floats] | None = None) -> JoinedViews:
    """Find which tracks of several fixed, synchronised, uncalibrated cameras show the same points.

    Each two cameras are matched (`match_tracks`). A point then is one track a camera at most; the tracks of each camera
    in turn are given to the points by what all other cameras say together, until nothing changes.

    Args:
        views: The cameras' tracks (F, 2, P), each with its own number of points.
        appearance: For cameras (i, j), i < j, what their points look like, as for `match_tracks`.

    Returns:
        All points, those that most cameras see first.

    Raises:
        SettingProblem: There are fewer than two cameras, or the arrays do not fit together.
    """
    if len(views) < 2:
        raise SettingProblem(f"Points are joined between two cameras or more, not {len(views)}.")
    looks = appearance or {}
    found = {(i, j): match_tracks(views[i], views[j], looks.get((i, j))) for i, j in combinations(range(len(views)), 2)}
    return join_pairs(views, found)


def join_pairs(views: Sequence[Floats], found: Mapping[tuple[int, int], Correspondence]) -> JoinedViews:
    """Join the points of several cameras as `join_views` does, from what each two cameras (i, j), i < j, say."""
    order, notes = _order(found, len(views))
    points = _joined(found, order, [view.shape[2] for view in views])
    points = points[:, np.argsort(-(points >= 0).sum(axis=0), kind="stable")]
    said = [f"Cameras {i + 1} and {j + 1}: {note}" for (i, j), pair in found.items() for note in pair.notes]
    return JoinedViews(
        tracks=_tracks(views, points), points=points, probability=_probability(found, points), notes=(*notes, *said)
    )


def _scores(found: Mapping[tuple[int, int], Correspondence], camera: int, other: int) -> Floats:
    """Give what two cameras say about each other, (P of the one, P of the other)."""
    return found[camera, other].score if camera < other else found[other, camera].score.T


def _order(found: Mapping[tuple[int, int], Correspondence], cameras: int) -> tuple[list[int], list[str]]:
    """Begin with the two cameras that share most, and add the one that shares most with those there are."""
    shared = np.zeros((cameras, cameras))
    for (i, j), pair in found.items():
        shared[i, j] = shared[j, i] = pair.probability.sum()
    order = [int(shared.sum(axis=1).argmax())]
    notes = []
    while len(order) < cameras:
        rest = [camera for camera in range(cameras) if camera not in order]
        best = max(rest, key=lambda camera: shared[camera, order].sum())
        if shared[best, order].sum() == 0:
            notes.append(UNTIED.format(camera=best + 1))
        order.append(best)
    return order, notes


def _joined(found: Mapping[tuple[int, int], Correspondence], order: Sequence[int], counts: Sequence[int]) -> Integers:
    """Give each camera's tracks to points (C, N)."""
    points = np.full((len(counts), counts[order[0]]), -1, np.int64)
    points[order[0]] = np.arange(counts[order[0]])
    for camera in order[1:]:
        points = _given(found, points, camera, counts[camera])
    for _ in range(_SWEEPS):
        before = points
        for camera in order:
            points = _given(found, points, camera, counts[camera])
        if points.shape == before.shape and np.array_equal(points, before):
            break
    return points


def _given(found: Mapping[tuple[int, int], Correspondence], points: Integers, camera: int, count: int) -> Integers:
    """Take a camera's tracks from their points and give them anew; what fits none becomes a point of its own."""
    points = points.copy()
    points[camera] = -1
    points = points[:, (points >= 0).any(axis=0)]
    score = _against(found, points, camera, count)
    columns, tracks = best_pairs(score)
    points[camera, columns] = tracks
    alone = np.setdiff1d(np.arange(count), tracks)
    own = np.full((len(points), len(alone)), -1, np.int64)
    own[camera] = alone
    return np.concatenate([points, own], axis=1)


def _against(found: Mapping[tuple[int, int], Correspondence], points: Integers, camera: int, count: int) -> Floats:
    """Add up what the other cameras say about a camera's tracks, (N, count)."""
    score = np.zeros((points.shape[1], count))
    for other in range(len(points)):
        seen = np.flatnonzero(points[other] >= 0)
        if other != camera and len(seen):
            score[seen] += _scores(found, other, camera)[points[other, seen]]
    return score


def _probability(found: Mapping[tuple[int, int], Correspondence], points: Integers) -> Floats:
    """Give the probability (C, N) of each track's point, the other cameras' tracks taken as they are."""
    probability = np.where(points >= 0, 1.0, np.nan)
    for camera in range(len(points)):
        rest = points.copy()
        rest[camera] = -1
        columns = np.flatnonzero((points[camera] >= 0) & (rest >= 0).any(axis=0))
        chance = pair_probabilities(_against(found, rest, camera, int(points[camera].max(initial=-1)) + 1))
        probability[camera, columns] = chance[columns, points[camera, columns]]
    return probability


def _tracks(views: Sequence[Floats], points: Integers) -> Floats:
    tracks = np.full((len(views), len(views[0]), 2, points.shape[1]), np.nan)
    for camera, view in enumerate(views):
        seen = np.flatnonzero(points[camera] >= 0)
        tracks[camera][:, :, seen] = view[:, :, points[camera, seen]]
    return tracks
