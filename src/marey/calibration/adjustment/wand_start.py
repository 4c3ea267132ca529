"""Start values of a session with a wand: focal lengths and poses from pairs of cameras that see the same points.

No lens has to be known. The fundamental matrix of two cameras, found by RANSAC, becomes an essential matrix, with two
equal singular values, only with the right focal lengths ([Hartley1992]); a common focal length, in widths of the
image, is searched for which this holds best for all pairs. The length of the wand gives the distance of the cameras.
"""

from dataclasses import dataclass, replace
from itertools import combinations

import cv2
import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.calibration.adjustment.start import PoseVote, SessionStart, connected_cameras, guessed_lens
from marey.calibration.adjustment.state import SHAPE, SessionState
from marey.calibration.boards.corners import CornerSet
from marey.calibration.boards.wand import CalibrationWand
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform

FOCAL_LENGTHS = tuple(np.geomspace(0.5, 2.4, 12).tolist())
"""Focal lengths that are tried, in longer sides of the image: fields of view from 90 to 24 degrees."""
_LEAST_COMMON = 16
"""Least number of points that two cameras must see together for a relative pose; eight determine it. Chosen by
hand."""
_THRESHOLD = 0.006
"""Distance from the epipolar line up to which points agree, in longer sides of the image; lenses that are not yet
undistorted bend lines by about as much. Chosen by hand."""
_MOST_POINTS = 1500
"""Number of points from which a pair of cameras is estimated at most; chosen by hand."""
_NEAR = 0.25
"""Difference of a length from that of the wand, as a ratio, up to which a picture takes part; chosen by hand."""
_EQUAL = 0.05
"""Standard deviation of the ratio of the singular values of an essential matrix; chosen by hand."""


@dataclass(frozen=True, eq=False)
class _Pair:
    """Points that two cameras see at the same instants."""

    first: int
    second: int
    picture: Integers
    """(m,)."""
    corner: Integers
    """(m,)."""
    a: Floats
    """(m, 2) [px]."""
    b: Floats
    """(m, 2) [px]."""


def start_focal_lengths(corners: CornerSet) -> list[float]:
    """Order the tried focal lengths by how well the pairs of cameras agree with them.

    Args:
        corners: Points of the wand.

    Returns:
        Focal lengths in longer sides of the image, the best first.
    """
    cost = np.zeros(len(FOCAL_LENGTHS))
    for pair in _pairs(corners):
        matrix, mask = _fundamental(pair, corners)
        if matrix is None:
            continue
        weight = np.sqrt(np.count_nonzero(mask))
        for k, focal in enumerate(FOCAL_LENGTHS):
            ka, kb = (_matrix(guessed_lens(corners.sizes[c], focal)) for c in (pair.first, pair.second))
            values = np.linalg.svd(kb.T @ matrix @ ka, compute_uv=False)
            gap = 1.0 - values[1] / values[0]
            cost[k] += weight * gap**2 / (gap**2 + _EQUAL**2)
    return [FOCAL_LENGTHS[k] for k in np.argsort(cost, kind="stable")]


def start_wand(corners: CornerSet, wand: CalibrationWand, lenses: Floats) -> SessionStart:
    """Find start values of all poses.

    Args:
        corners: Points of the wand.
        wand: The wand.
        lenses: (C, 9) start values of the lenses.

    Returns:
        Start values; the world is that of the best connected camera.
    """
    straight = _straight(corners, lenses)
    votes = []
    for pair in _pairs(corners):
        vote = _vote(pair, corners, wand, straight, lenses)
        if vote is not None:
            votes.append(vote)
    joined, cameras = connected_cameras(len(lenses), tuple(votes))
    state = SessionState(
        lens=lenses,
        camera_rotation=np.stack([pose.rotation for pose in cameras]),
        camera_translation=np.stack([pose.translation for pose in cameras]),
        board_rotation=np.broadcast_to(np.eye(3), (len(corners.pictures), 3, 3)),
        board_translation=np.zeros((len(corners.pictures), 3)),
        shape=np.zeros(SHAPE),
        delay=np.zeros(len(lenses)),
    )
    state, seen = with_wand_poses(state, corners, wand, joined)
    return SessionStart(state=state, seen=seen, joined=joined, votes=tuple(votes))


def _pairs(corners: CornerSet) -> list[_Pair]:
    """List the pairs of cameras with enough common points."""
    key = corners.picture * (int(corners.corner.max(initial=0)) + 1) + corners.corner
    found = []
    for first, second in combinations(range(len(corners.cameras)), 2):
        a, b = np.flatnonzero(corners.camera == first), np.flatnonzero(corners.camera == second)
        _, own, other = np.intersect1d(key[a], key[b], return_indices=True)
        if len(own) >= _LEAST_COMMON:
            rows, others = a[own], b[other]
            found.append(_Pair(first, second, corners.picture[rows], corners.corner[rows],
                               corners.pixels[rows], corners.pixels[others]))  # fmt: skip
    return found


def _matrix(lens: Floats) -> Floats:
    return np.array([[lens[0], 0, lens[2]], [0, lens[1], lens[3]], [0, 0, 1]])


def _thinned(count: int) -> Integers:
    return np.unique(np.linspace(0, count - 1, min(count, _MOST_POINTS)).astype(int))


def _fundamental(pair: _Pair, corners: CornerSet) -> tuple[Floats | None, Mask]:
    rows = _thinned(len(pair.a))
    limit = _THRESHOLD * max(max(corners.sizes[pair.first]), max(corners.sizes[pair.second]))
    # OpenCV's random numbers are its own: the same command gives the same result.
    cv2.setRNGSeed(0)
    matrix, mask = cv2.findFundamentalMat(
        pair.a[rows], pair.b[rows], cv2.FM_RANSAC, ransacReprojThreshold=limit, confidence=0.9999, maxIters=5000
    )
    if matrix is None or matrix.shape != (3, 3):
        return None, np.zeros(0, bool)
    return np.asarray(matrix, float), np.ravel(mask).astype(bool)


def _straight(corners: CornerSet, lenses: Floats) -> Floats:
    """Return the directions x / z, y / z (N, 2) of all points in their cameras."""
    out = np.empty_like(corners.pixels)
    for camera, lens in enumerate(lenses):
        own = corners.camera == camera
        if own.any():
            out[own] = straight_directions(corners.pixels[own], lens)
    return out


def straight_directions(pixels: Floats, lens: Floats) -> Floats:
    """Return directions x / z, y / z without distortion.

    Args:
        pixels: (n, 2) [px].
        lens: (9,) in the order of `LENS_NAMES`.

    Returns:
        (n, 2).
    """
    return np.asarray(cv2.undistortPoints(np.ascontiguousarray(pixels)[:, None], _matrix(lens), lens[4:])[:, 0])


def _vote(
    pair: _Pair, corners: CornerSet, wand: CalibrationWand, straight: Floats, lenses: Floats
) -> PoseVote | None:
    """Find the relative pose of two cameras, with the distance from the length of the wand."""
    lookup = {
        key: row
        for row, key in enumerate(
            zip(corners.camera.tolist(), corners.picture.tolist(), corners.corner.tolist(), strict=True)
        )
    }
    keys = list(zip(pair.picture.tolist(), pair.corner.tolist(), strict=True))
    a = straight[[lookup[pair.first, *key] for key in keys]]
    b = straight[[lookup[pair.second, *key] for key in keys]]
    focal = 0.5 * (lenses[pair.first, 0] + lenses[pair.second, 0])
    limit = _THRESHOLD * max(corners.sizes[pair.first]) / focal
    rows = _thinned(len(a))
    cv2.setRNGSeed(0)
    essential, mask = cv2.findEssentialMat(a[rows], b[rows], np.eye(3), cv2.RANSAC, 0.9999, limit, 3000)
    if essential is None or essential.shape[1] != 3:
        return None
    count, turn, shift, _ = cv2.recoverPose(essential[:3], a[rows], b[rows], np.eye(3), mask=mask.copy())
    if count < _LEAST_COMMON:
        return None
    rotation: Floats = np.array(turn, np.float64)
    pose = RigidTransform(rotation, np.ravel(shift))
    points = _of_two(pose, a, b)
    scale, agreeing = _scale(points, pair, wand)
    if agreeing < _LEAST_COMMON // 2:
        return None
    return PoseVote(
        first=pair.first, second=pair.second, second_from_first=RigidTransform(rotation, scale * pose.translation),
        agreeing=agreeing, common=len(np.unique(pair.picture)),
    )  # fmt: skip


def _of_two(pose: RigidTransform, a: Floats, b: Floats) -> Floats:
    """Triangulate directions (m, 2) of two cameras; NaN behind one of them."""
    one = np.column_stack([a, np.ones(len(a))])
    two = np.column_stack([b, np.ones(len(b))]) @ pose.rotation
    centre = pose.inverse().translation
    points = nearest_points(
        np.stack([np.zeros((len(a), 3)), np.broadcast_to(centre, (len(a), 3))], axis=1), np.stack([one, two], axis=1)
    )
    behind = (points[:, 2] <= 0) | (pose.apply(points)[:, 2] <= 0)
    return np.where(behind[:, None], np.nan, points)


def nearest_points(centres: Floats, directions: Floats) -> Floats:
    """Return the points nearest to rays.

    Args:
        centres: (m, k, 3) a point of each ray [m].
        directions: (m, k, 3) its direction; NaN for rays that do not exist.

    Returns:
        (m, 3) [m]; NaN where rays are parallel.
    """
    known = np.asarray(np.isfinite(directions).all(axis=-1))
    unit = np.where(known[..., None], directions, 0.0)
    unit = unit / np.maximum(np.linalg.norm(unit, axis=-1, keepdims=True), 1e-300)
    across = known[..., None, None] * np.eye(3) - unit[..., :, None] * unit[..., None, :]
    normal, right = across.sum(axis=1), np.einsum("mkij,mkj->mi", across, centres)
    good = np.linalg.eigvalsh(normal)[:, 0] > 1e-6
    out = np.full((len(normal), 3), np.nan)
    out[good] = np.linalg.solve(normal[good], right[good][..., None])[..., 0]
    return out


def _scale(points: Floats, pair: _Pair, wand: CalibrationWand) -> tuple[float, int]:
    """Return by what points have to be multiplied to have the wand's length, and the number of agreeing pictures."""
    ratios = []
    for corner in range(len(wand.points) - 1):
        low = np.arange(len(pair.corner))[pair.corner == corner]
        high = np.arange(len(pair.corner))[pair.corner == corner + 1]
        _, own, other = np.intersect1d(pair.picture[low], pair.picture[high], return_indices=True)
        apart = np.linalg.norm(points[low[own]] - points[high[other]], axis=1)
        known = float(np.linalg.norm(wand.points[corner + 1] - wand.points[corner]))
        with np.errstate(divide="ignore"):
            ratios.append(known / apart)
    together: Floats = np.concatenate(ratios)
    every: Floats = np.extract(np.isfinite(together), together)
    if not len(every):
        return 1.0, 0
    scale = float(np.median(every))
    return scale, int(np.count_nonzero(np.abs(np.log(every / scale)) < _NEAR))


def with_wand_poses(
    state: SessionState, corners: CornerSet, wand: CalibrationWand, joined: Integers
) -> tuple[SessionState, Mask]:
    """Place the wand of every picture by triangulation.

    Args:
        state: The cameras.
        corners: Points of the wand.
        wand: The wand.
        joined: (C,) group of each camera; points are triangulated within the largest group that sees them.

    Returns:
        The state with the wand's poses, and (F,) whether the pose of a picture is known.
    """
    count, marks = len(corners.pictures), len(wand.points)
    centre = -np.einsum("cji,cj->ci", state.camera_rotation, state.camera_translation)
    straight = _straight(corners, state.lens)
    ray = np.einsum(
        "nji,nj->ni", state.camera_rotation[corners.camera], np.column_stack([straight, np.ones(len(straight))])
    )
    turn = np.array(state.board_rotation)
    shift = np.array(state.board_translation)
    seen = np.zeros(count, bool)
    for group in np.unique(joined):
        members = np.flatnonzero(joined == group)
        rays = np.full((count * marks, len(members), 3), np.nan)
        own = np.isin(corners.camera, members)
        rays[corners.picture[own] * marks + corners.corner[own], np.searchsorted(members, corners.camera[own])] = ray[
            own
        ]
        points = nearest_points(np.broadcast_to(centre[members], rays.shape), rays).reshape(count, marks, 3)
        rotation, translation, known = wand_poses(wand, points)
        new = known & ~seen
        turn[new], shift[new], seen[new] = rotation[new], translation[new], True
    return replace(state, board_rotation=turn, board_translation=shift), seen


def wand_poses(wand: CalibrationWand, points: Floats) -> tuple[Floats, Floats, Mask]:
    """Return the poses of a wand whose points are at given places.

    Args:
        wand: The wand.
        points: (F, P, 3) for each picture [m]; NaN for points that are not known.

    Returns:
        Rotations (F, 3, 3), translations (F, 3) [m], and (F,) whether the pose is known: at least two points are, and
        they are about as far apart as those of the wand. Other poses have no meaning.
    """
    there = np.asarray(np.isfinite(points).all(axis=-1))
    count = np.maximum(there.sum(axis=1), 1)[:, None]
    place = np.where(there[..., None], points, 0.0)
    along = np.where(there, wand.points[:, 0], 0.0)
    middle, centre = along.sum(axis=1, keepdims=True) / count, place.sum(axis=1) / count
    along = np.where(there, along - middle, 0.0)
    axis = np.einsum("fp,fpi->fi", along, place - centre[:, None])
    length, span = np.linalg.norm(axis, axis=1), np.sum(along**2, axis=1)
    known = np.asarray((there.sum(axis=1) >= 2) & (length > 0.0))
    ratio = np.where(known, length, 1.0) / np.where(known, span, 1.0)
    known = known & (np.abs(np.log(ratio)) <= 2 * _NEAR)
    forwards = np.array([1.0, 0.0, 0.0])
    turn = rotations.shortest(forwards, np.where(known[:, None], axis, forwards))
    return turn, centre - turn[:, :, 0] * middle, known
