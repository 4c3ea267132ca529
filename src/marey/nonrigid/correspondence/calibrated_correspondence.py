"""Which point of one calibrated camera is which of another: by epipolar lines over all frames, and the low rank."""

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.cameras.camera import Camera
from marey.cameras.rig import Rig
from marey.cameras.triangulate import triangulate
from marey.errors import MareyError, SettingProblem
from marey.nonrigid.core.alignment import mean_shape
from marey.nonrigid.correspondence.partial_assignment import best_pairs, pair_probabilities
from marey.nonrigid.correspondence.view_correspondence import AMBIGUOUS, TOO_FEW, Correspondence
from marey.nonrigid.correspondence.view_joining import JoinedViews, join_pairs

INDEPENDENT = 10.0
"""Frames whose distances from a line count each for itself: those of one point err alike for a while."""
SHARED = 0.5
"""Share of the points that is thought to be seen by both cameras, before anything is known."""
SLIPPED = 0.05
"""Share of the frames in which a track is not on its point."""
LEAST_PX = 0.3
FIRST_PX = 1.0
ROUNDS = 3
RIVAL = 12.0
"""Pairs whose evidence is less than this behind the best of their point are judged by the low rank, too [natural
logarithm]."""
SURE = 0.9
FEWEST_SURE = 8
MODES = 3
"""Displacements of the sure points that explain another's, beside its place."""
FEWEST_FRAMES = 2
_AT_ONCE = 32
"""Points that are compared at once, to bound the memory."""


def join_calibrated(
    views: Sequence[Floats], rig: Rig, appearance: Mapping[tuple[int, int], Floats] | None = None
) -> JoinedViews:
    """Find which tracks of several calibrated, synchronised cameras show the same points.

    Args:
        views: The C cameras' tracks (F, 2, P), each with its own number of points, in the rig's order.
        rig: The cameras.
        appearance: For cameras (i, j), i < j, what their points look like, as for `match_calibrated`.

    Returns:
        All points, those that most cameras see first.

    Raises:
        SettingProblem: There are fewer than two cameras, or the arrays do not fit together.
    """
    if len(views) < 2 or len(views) != len(rig):
        raise SettingProblem(f"There are tracks of {len(views)} cameras, and the calibration has {len(rig)}.")
    looks, cameras = appearance or {}, rig.cameras
    found = {
        (i, j): match_calibrated(views[i], views[j], (cameras[i], cameras[j]), looks.get((i, j)))
        for i, j in combinations(range(len(views)), 2)
    }
    return join_pairs(views, found)


def match_calibrated(
    first: Floats, second: Floats, cameras: tuple[Camera, Camera], appearance: Floats | None = None
) -> Correspondence:
    """Find which tracks of two calibrated, synchronised cameras show the same points.

    The paper does this by hand ([Alexander2003] section 4). Here a pair is judged by how far the second track stays
    from the first one's epipolar lines, against how far tracks of other points do; where several stay near enough, by
    whether the point in space moves as the others do, in a few displacements of theirs.

    Args:
        first: (F, 2, P) tracks of one camera [px]; NaN where a point is not seen.
        second: (F, 2, Q) those of the other; the frames are the same instants.
        cameras: The two cameras, with their lenses.
        appearance: (P, Q) logarithm of how much more alike two points look than two different ones do, for one and the
            same point; 0 says nothing, minus infinity that they cannot be one.

    Returns:
        The pairs, with the points that have no partner.

    Raises:
        SettingProblem: The arrays do not fit together.
    """
    first, second = np.asarray(first, float), np.asarray(second, float)
    shape = _checked(first, second, appearance)
    looks = np.zeros(shape) if appearance is None else np.maximum(np.asarray(appearance, float), -1e3)
    looks = looks + np.log(SHARED / ((1 - SHARED) ** 2 * max(*shape, 1)))
    normals, directions, sd = _planes(first, second, cameras)
    cap, sigma = _usual_distance(normals, directions) / sd, FIRST_PX
    score: Floats = np.zeros(shape)
    rows, columns = np.empty(0, np.int64), np.empty(0, np.int64)
    for _ in range(ROUNDS):
        score = looks + _evidence(normals, directions, sd * sigma, sd * max(cap, 10 * sigma))
        rows, columns = best_pairs(score)
        if len(rows) < FEWEST_SURE:
            break
        off = np.einsum("fni,fni->fn", normals[:, rows], directions[:, columns]) / sd
        sigma = max(LEAST_PX, 1.4826 * float(np.nanmedian(np.abs(off))))
    score = _judged_by_rank(first, second, cameras, score, sigma)
    return _told(score)


def _checked(first: Floats, second: Floats, appearance: Floats | None) -> tuple[int, int]:
    for tracks in (first, second):
        if tracks.ndim != 3 or tracks.shape[1] != 2:
            raise SettingProblem(f"Tracks of shape {tracks.shape} are none of one view (frames, 2, points).")
    if len(first) != len(second):
        raise SettingProblem(f"The cameras have {len(first)} and {len(second)} frames; they must be the same instants.")
    shape = first.shape[2], second.shape[2]
    if appearance is not None and np.shape(appearance) != shape:
        raise SettingProblem(f"The points' likeness has the shape {np.shape(appearance)} and should have {shape}.")
    return shape


def _planes(first: Floats, second: Floats, cameras: tuple[Camera, Camera]) -> tuple[Floats, Floats, float]:
    """Give unit normals (F, P, 3) of the first points' epipolar planes, and unit rays (F, Q, 3) of the second points.

    The last number says by how much a pixel of each turns a ray against a plane [rad/px].
    """
    one, other = cameras
    baseline = other.centre - one.centre
    length = float(np.linalg.norm(baseline))
    if length == 0:
        raise MareyError(f"Cameras '{one.name}' and '{other.name}' stand in one place: rays do not meet.")
    normals = np.cross(baseline / length, one.rays(np.moveaxis(first, 1, 2)).directions)
    normals = normals / np.linalg.norm(normals, axis=-1, keepdims=True)
    rays = other.rays(np.moveaxis(second, 1, 2)).directions
    turns = [1 / np.sqrt(camera.matrix[0, 0] * camera.matrix[1, 1]) for camera in cameras]
    return normals, rays, float(np.linalg.norm(turns))


def _usual_distance(normals: Floats, directions: Floats) -> float:
    """Give the median angle [rad] between all rays of the second camera and all planes of the first."""
    every = max(1, len(normals) // 20)
    angles = np.abs(normals[::every] @ np.swapaxes(directions[::every], 1, 2))
    return float(np.nanmedian(angles)) if np.isfinite(angles).any() else 0.0


def _evidence(normals: Floats, directions: Floats, sd: float, cap: float) -> Floats:
    """Give how much more probable the angles are for one point than for two (P, Q) [natural logarithm]."""
    out = np.empty((normals.shape[1], directions.shape[1]))
    for start in range(0, len(out), _AT_ONCE):
        part = slice(start, start + _AT_ONCE)
        angle = normals[:, part] @ np.swapaxes(directions, 1, 2)
        near = np.exp(-0.5 * (angle / sd) ** 2) / (np.sqrt(2 * np.pi) * sd)
        ratio = np.log((1 - SLIPPED) * near * 4 * cap + SLIPPED)  # one of another point: evenly within two caps
        there = np.isfinite(ratio)
        count = there.sum(0)
        mean = np.where(there, ratio, 0).sum(0) / np.maximum(count, 1)
        out[part] = mean * np.minimum(count, INDEPENDENT) * (count >= FEWEST_FRAMES)
    return out


def _judged_by_rank(
    first: Floats, second: Floats, cameras: tuple[Camera, Camera], score: Floats, sigma: float
) -> Floats:
    """Add, where several partners stay near the lines, what the low rank of the sure points says of them."""
    likely = score > np.maximum(score.max(1, keepdims=True), RIVAL) - RIVAL
    rivals = np.argwhere(likely & ((likely.sum(1, keepdims=True) > 1) | (likely.sum(0, keepdims=True) > 1)))
    chance = pair_probabilities(score)
    sure = np.stack(best_pairs(score), 1)
    sure = sure[(chance[sure[:, 0], sure[:, 1]] > SURE) & (likely[sure[:, 0]].sum(1) == 1)]
    if len(sure) < FEWEST_SURE or not len(rivals):
        return score
    points, covariance = _met(first, second, cameras, sure, sigma)
    present: Mask = np.asarray(np.isfinite(points).all(-1))
    _, rotation, translation = mean_shape(points, present)
    weights = _weights(_carried(points, rotation, translation))
    usual = np.median([
        _left(points[:, n], covariance[:, n], rotation, translation, weights) for n in range(len(sure))
    ])  # fmt: skip
    out = score.copy()
    points, covariance = _met(first, second, cameras, rivals, sigma)
    for number, (i, j) in enumerate(rivals):
        left = _left(points[:, number], covariance[:, number], rotation, translation, weights)
        out[i, j] -= 0.5 * INDEPENDENT * (left / usual - 1) if np.isfinite(left) else 0.0
    return out


def _met(
    first: Floats, second: Floats, cameras: tuple[Camera, Camera], pairs: Integers, sigma: float
) -> tuple[Floats, Floats]:
    """Give the points (F, N, 3) on which the rays of pairs meet, and their covariances."""
    pixels = np.moveaxis(np.stack([first[:, :, pairs[:, 0]], second[:, :, pairs[:, 1]]]), 2, 3)
    found = triangulate(cameras, pixels.reshape(2, -1, 2), sigma_px=sigma)
    shape = pixels.shape[1:3]
    return found.points.reshape(*shape, 3), found.covariance.reshape(*shape, 3, 3)


def _carried(points: Floats, rotation: Floats, translation: Floats) -> Floats:
    return np.asarray(np.einsum("fji,fpj->fpi", rotation, points - translation[:, None]))


def _weights(local: Floats) -> Floats:
    """Give ones and the weights (F, 1 + M) of the main displacements of points (F, N, 3) in the object."""
    left = np.nan_to_num(local - np.nanmean(local, 0)).reshape(len(local), -1)
    u, d, _ = np.linalg.svd(left, full_matrices=False)
    return np.concatenate([np.ones((len(u), 1)), u[:, :MODES] * d[:MODES]], 1)


def _left(points: Floats, covariance: Floats, rotation: Floats, translation: Floats, weights: Floats) -> float:
    """Give the mean squared departure of a point (F, 3) from what the weights explain, in its variances."""
    local = _carried(points[:, None], rotation, translation)[:, 0]
    there = np.isfinite(local).all(1)
    if there.sum() < 2 * weights.shape[1]:
        return float("nan")
    explained = weights[there] @ np.linalg.lstsq(weights[there], local[there], rcond=None)[0]
    away = np.einsum("fij,fj->fi", rotation[there], local[there] - explained)
    return float(np.mean(np.einsum("fi,fi->f", away, np.linalg.solve(covariance[there], away[..., None])[..., 0])) / 3)


def _told(score: Floats) -> Correspondence:
    rows, columns = best_pairs(score)
    chance = pair_probabilities(score)[rows, columns]
    doubtful = int((chance < SURE).sum())
    notes = []
    if len(rows) < FEWEST_SURE:
        notes.append(TOO_FEW.format(count=FEWEST_SURE))
    elif doubtful:
        notes.append(AMBIGUOUS.format(count=doubtful, all=len(rows)))
    return Correspondence(
        pairs=np.stack([rows, columns], 1), probability=chance, score=score, notes=tuple(notes),
        alone_first=np.setdiff1d(np.arange(score.shape[0]), rows),
        alone_second=np.setdiff1d(np.arange(score.shape[1]), columns),
    )  # fmt: skip
