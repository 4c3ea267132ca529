"""Correspondence between the points of calibrated cameras, by epipolar lines over all frames and the low rank."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.cameras.camera import Camera
from marey.cameras.rig import Rig
from marey.cameras.triangulate import triangulate
from marey.errors import MareyError, SettingProblem
from marey.geometry.vectors import unit
from marey.nonrigid.core.alignment import mean_shape
from marey.nonrigid.correspondence.partial_assignment import best_pairs, pair_probabilities
from marey.nonrigid.correspondence.view_correspondence import AMBIGUOUS, SHARED, TOO_FEW, Correspondence, check_views
from marey.nonrigid.correspondence.view_joining import JoinedViews, join_pairs

_AT_ONCE = 32
"""Number of points that are compared at once, which limits the memory."""


@dataclass(frozen=True, kw_only=True)
class CalibratedMatchSettings:
    """Settings of the correspondence between calibrated cameras.

    Where nothing else is stated, defaults were chosen by hand, and results were not measured against other values.
    """

    independent_frames: float = 10.0
    """Largest number of frames whose distances from an epipolar line count as independent; the errors of one track are
    correlated for several frames."""
    shared: float = SHARED
    """Assumed fraction of the points that both cameras see."""
    slipped: float = 0.05
    """Assumed fraction of the frames in which a track has left its point."""
    least_sd_px: float = 0.3
    """Least standard deviation of a track [px]."""
    initial_sd_px: float = 1.0
    """Initial standard deviation of a track [px]."""
    rounds: int = 3
    """Number of rounds in which that standard deviation is estimated."""
    rival: float = 12.0
    """Pairs whose evidence is less than this below that of the best of their point are also evaluated by the low rank
    [natural logarithm]."""
    sure: float = 0.9
    """Least probability of the pairs from which the low rank is computed."""
    fewest_sure: int = 8
    """Least number of such pairs."""
    modes: int = 3
    """Number of modes of these pairs that predict another point, beside its position."""
    fewest_frames: int = 2
    """Least number of frames in which two points must be seen together."""


def join_calibrated(
    views: Sequence[Floats],
    rig: Rig,
    appearance: Mapping[tuple[int, int], Floats] | None = None,
    settings: CalibratedMatchSettings = CalibratedMatchSettings(),
) -> JoinedViews:
    """Match the tracks of several calibrated, synchronised cameras.

    Args:
        views: Tracks (F, 2, P) of the C cameras, each with its own number of points, in the rig's order.
        rig: The cameras.
        appearance: Appearance of the points of cameras (i, j), i < j, as for `match_calibrated`.
        settings: Tuned constants.

    Returns:
        All points, in descending order of the number of cameras that see them.

    Raises:
        SettingProblem: There are fewer than two cameras, or the shapes of the arrays do not match.
    """
    if len(views) < 2 or len(views) != len(rig):
        raise SettingProblem(
            f"There are tracks of {len(views)} cameras, but the calibration has {len(rig)}: at least two are needed, "
            "and as many in the calibration."
        )
    looks, cameras = appearance or {}, rig.cameras
    found = {
        (i, j): match_calibrated(views[i], views[j], (cameras[i], cameras[j]), looks.get((i, j)), settings)
        for i, j in combinations(range(len(views)), 2)
    }
    return join_pairs(views, found)


def match_calibrated(
    first: Floats,
    second: Floats,
    cameras: tuple[Camera, Camera],
    appearance: Floats | None = None,
    settings: CalibratedMatchSettings = CalibratedMatchSettings(),
) -> Correspondence:
    """Match the tracks of two calibrated, synchronised cameras.

    Unlike the paper, where this is done by hand ([Alexander2003] section 4), a pair is evaluated by the distance of the
    second track from the epipolar lines of the first, relative to that of other points; where several tracks are close
    enough, by whether the motion of the point in space is a combination of a few modes of the others.

    Args:
        first: (F, 2, P) tracks of one camera [px]; NaN where a point is not seen.
        second: (F, 2, Q) tracks of the other camera at the same instants [px].
        cameras: The two cameras, with their lenses.
        appearance: (P, Q) log-likelihood ratio that two points are the same, from their appearance; 0 where unknown,
            minus infinity where impossible.
        settings: Tuned constants.

    Returns:
        The pairs, and the points without a partner.

    Raises:
        SettingProblem: The shapes of the arrays do not match.
        MareyError: The cameras are in one place.
    """
    first, second = np.asarray(first, float), np.asarray(second, float)
    shape = check_views(first, second, appearance)
    looks = np.zeros(shape) if appearance is None else np.maximum(np.asarray(appearance, float), -1e3)
    looks = looks + np.log(settings.shared / ((1 - settings.shared) ** 2 * max(*shape, 1)))
    normals, directions, sd = _planes(first, second, cameras)
    cap, sigma = _usual_distance(normals, directions) / sd, settings.initial_sd_px
    score: Floats = np.zeros(shape)
    rows, columns = np.empty(0, np.int64), np.empty(0, np.int64)
    for _ in range(settings.rounds):
        score = looks + _evidence(normals, directions, sd * sigma, sd * max(cap, 10 * sigma), settings)
        rows, columns = best_pairs(score)
        if len(rows) < settings.fewest_sure:
            break
        off = np.einsum("fni,fni->fn", normals[:, rows], directions[:, columns]) / sd
        sigma = max(settings.least_sd_px, 1.4826 * float(np.nanmedian(np.abs(off))))
    return _correspondence(_with_low_rank(first, second, cameras, score, sigma, settings), settings)


def _planes(first: Floats, second: Floats, cameras: tuple[Camera, Camera]) -> tuple[Floats, Floats, float]:
    """Compute unit normals (F, P, 3) of the first points' epipolar planes, and rays (F, Q, 3) of the second points.

    The last value is the angle between ray and plane per pixel of both tracks [rad/px].
    """
    one, other = cameras
    baseline = other.centre - one.centre
    length = float(np.linalg.norm(baseline))
    if length == 0:
        raise MareyError(f"Cameras '{one.name}' and '{other.name}' are in one place, so that rays do not meet.")
    normals = unit(np.cross(baseline / length, one.rays(np.moveaxis(first, 1, 2)).directions))
    rays = other.rays(np.moveaxis(second, 1, 2)).directions
    turns = [1 / np.sqrt(camera.matrix[0, 0] * camera.matrix[1, 1]) for camera in cameras]
    return normals, rays, float(np.linalg.norm(turns))


def _usual_distance(normals: Floats, directions: Floats) -> float:
    """Compute the median angle [rad] between all rays of the second camera and all planes of the first."""
    every = max(1, len(normals) // 20)
    angles = np.abs(normals[::every] @ np.swapaxes(directions[::every], 1, 2))
    return float(np.nanmedian(angles)) if np.isfinite(angles).any() else 0.0


def _evidence(normals: Floats, directions: Floats, sd: float, cap: float, settings: CalibratedMatchSettings) -> Floats:
    """Compute the log-likelihood ratio (P, Q) of the angles, for one point against two [natural logarithm]."""
    out = np.empty((normals.shape[1], directions.shape[1]))
    for start in range(0, len(out), _AT_ONCE):
        part = slice(start, start + _AT_ONCE)
        angle = normals[:, part] @ np.swapaxes(directions, 1, 2)
        near = np.exp(-0.5 * (angle / sd) ** 2) / (np.sqrt(2 * np.pi) * sd)
        # angles of another point are taken as uniform within two caps
        ratio = np.log((1 - settings.slipped) * near * 4 * cap + settings.slipped)
        there = np.isfinite(ratio)
        count = there.sum(0)
        mean = np.where(there, ratio, 0).sum(0) / np.maximum(count, 1)
        out[part] = mean * np.minimum(count, settings.independent_frames) * (count >= settings.fewest_frames)
    return out


def _with_low_rank(
    first: Floats,
    second: Floats,
    cameras: tuple[Camera, Camera],
    score: Floats,
    sigma: float,
    settings: CalibratedMatchSettings,
) -> Floats:
    """Add the evidence of the low rank of the certain points, if several partners are near the epipolar lines."""
    rival = settings.rival
    likely = score > np.maximum(score.max(1, keepdims=True), rival) - rival
    rivals = np.argwhere(likely & ((likely.sum(1, keepdims=True) > 1) | (likely.sum(0, keepdims=True) > 1)))
    chance = pair_probabilities(score)
    sure = np.stack(best_pairs(score), 1)
    sure = sure[(chance[sure[:, 0], sure[:, 1]] > settings.sure) & (likely[sure[:, 0]].sum(1) == 1)]
    if len(sure) < settings.fewest_sure or not len(rivals):
        return score
    points, covariance = _met(first, second, cameras, sure, sigma)
    present: Mask = np.asarray(np.isfinite(points).all(-1))
    _, rotation, translation = mean_shape(points, present)
    weights = _weights(_carried(points, rotation, translation), settings.modes)
    usual = np.median([
        _left(points[:, n], covariance[:, n], rotation, translation, weights) for n in range(len(sure))
    ])  # fmt: skip
    out = score.copy()
    points, covariance = _met(first, second, cameras, rivals, sigma)
    for number, (i, j) in enumerate(rivals):
        left = _left(points[:, number], covariance[:, number], rotation, translation, weights)
        out[i, j] -= 0.5 * settings.independent_frames * (left / usual - 1) if np.isfinite(left) else 0.0
    return out


def _met(
    first: Floats, second: Floats, cameras: tuple[Camera, Camera], pairs: Integers, sigma: float
) -> tuple[Floats, Floats]:
    """Compute the points (F, N, 3) on which the rays of pairs meet, and their covariances."""
    pixels = np.moveaxis(np.stack([first[:, :, pairs[:, 0]], second[:, :, pairs[:, 1]]]), 2, 3)
    found = triangulate(cameras, pixels.reshape(2, -1, 2), sigma_px=sigma)
    shape = pixels.shape[1:3]
    return found.points.reshape(*shape, 3), found.covariance.reshape(*shape, 3, 3)


def _carried(points: Floats, rotation: Floats, translation: Floats) -> Floats:
    return np.asarray(np.einsum("fji,fpj->fpi", rotation, points - translation[:, None]))


def _weights(local: Floats, modes: int) -> Floats:
    """Compute ones and the weights (F, 1 + M) of the main modes of points (F, N, 3) in the object's frame."""
    left = np.nan_to_num(local - np.nanmean(local, 0)).reshape(len(local), -1)
    u, d, _ = np.linalg.svd(left, full_matrices=False)
    return np.concatenate([np.ones((len(u), 1)), u[:, :modes] * d[:modes]], 1)


def _left(points: Floats, covariance: Floats, rotation: Floats, translation: Floats, weights: Floats) -> float:
    """Compute the mean squared departure of a point (F, 3) from the prediction by the weights, in its variances."""
    local = _carried(points[:, None], rotation, translation)[:, 0]
    there = np.isfinite(local).all(1)
    if there.sum() < 2 * weights.shape[1]:
        return float("nan")
    explained = weights[there] @ np.linalg.lstsq(weights[there], local[there], rcond=None)[0]
    away = np.einsum("fij,fj->fi", rotation[there], local[there] - explained)
    return float(np.mean(np.einsum("fi,fi->f", away, np.linalg.solve(covariance[there], away[..., None])[..., 0])) / 3)


def _correspondence(score: Floats, settings: CalibratedMatchSettings) -> Correspondence:
    """Choose pairs by their scores, and compute probabilities."""
    rows, columns = best_pairs(score)
    chance = pair_probabilities(score)[rows, columns]
    ambiguous = int((chance < settings.sure).sum())
    notes = []
    if len(rows) < settings.fewest_sure:
        notes.append(TOO_FEW.format(count=settings.fewest_sure))
    elif ambiguous:
        notes.append(AMBIGUOUS.format(count=ambiguous, all=len(rows)))
    return Correspondence(
        pairs=np.stack([rows, columns], 1), probability=chance, score=score, notes=tuple(notes),
        alone_first=np.setdiff1d(np.arange(score.shape[0]), rows),
        alone_second=np.setdiff1d(np.arange(score.shape[1]), columns),
    )  # fmt: skip
