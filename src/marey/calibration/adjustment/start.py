"""Start values of a calibration: lenses from homographies, relative poses of cameras by a vote of common pictures."""

from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.calibration.adjustment.projection import CornerPlaces, project_corners
from marey.calibration.adjustment.state import LENS, SHAPE, SessionState
from marey.calibration.boards.corners import CornerSet
from marey.calibration.boards.wand import CalibrationTarget
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform

LEAST_CORNERS = 6
"""Least number of corners with which a view takes part in the start values; chosen by hand."""
_LEAST_VIEWS = 3
"""Least number of views from which a lens is estimated: three tilted planes determine its five numbers."""
_MOST_VIEWS = 40
"""Number of views of a camera from which its start values are estimated; chosen by hand."""
_GUESSED_FOCAL = 0.9
"""Focal length of a lens that cannot be estimated, in widths of the image; chosen by hand."""
_WORST_VIEW = 4.0
"""Views whose error exceeds the median this many times are left out of the start values; chosen by hand."""
_AMBIGUOUS = 4.0
"""Ratio of errors up to which both poses of a plane that explain its corners are kept; chosen by hand."""
SAME_ANGLE = np.radians(4.0)
"""Angle up to which two relative poses agree [rad]; chosen by hand for start values."""
SAME_SHIFT = 0.06
"""Distance up to which two relative poses agree, in distances of the board; chosen by hand."""
_LEAST_AGREEMENT = 0.25
"""Share of the common pictures of two cameras that must agree on their relative pose; chosen by hand."""
_MOST_VOTES = 80
"""Number of common pictures of two cameras that vote at most; chosen by hand."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PoseVote:
    """The relative pose of two cameras on which most of their common pictures agree."""

    first: int
    second: int
    second_from_first: RigidTransform
    agreeing: int
    """Number of common pictures that agree."""
    common: int
    """Number of common pictures that voted."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SessionStart:
    """Start values of a session."""

    state: SessionState
    """One board pose per picture; those of pictures without a view are the identity."""
    seen: Mask
    """(F,) pictures whose board pose is known."""
    joined: Integers
    """(C,) group of cameras that are connected by common pictures; equal numbers belong together."""
    votes: tuple[PoseVote, ...]


def estimate_lens(corners: CornerSet, board: CalibrationTarget, camera: int) -> Floats:
    """Estimate the lens of one camera from the homographies of its views, with OpenCV.

    Args:
        corners: All corners.
        board: The board.
        camera: Index of the camera.

    Returns:
        (9,) in the order of `LENS_NAMES`; a guess if the views do not determine it.
    """
    size = corners.sizes[camera]
    views = _spread_views(corners, camera)
    for _ in range(2):
        found = _calibrated(corners, board, views, size)
        if found is None:
            return guessed_lens(size)
        lens, errors = found
        good = errors <= _WORST_VIEW * np.median(errors)
        if good.all():
            break
        views = views[good]
    return lens if _is_plausible(lens, size) else guessed_lens(size)


def guessed_lens(size: tuple[int, int], focal_length: float = _GUESSED_FOCAL) -> Floats:
    """Return a lens without distortion.

    Args:
        size: Width and height of the image [px].
        focal_length: In longer sides of the image; by default a usual one.

    Returns:
        (9,) in the order of `LENS_NAMES`.
    """
    focal = focal_length * max(size)
    return np.array([focal, focal, (size[0] - 1) / 2, (size[1] - 1) / 2, 0, 0, 0, 0, 0])


def _spread_views(corners: CornerSet, camera: int) -> Integers:
    """Choose views of a camera with many corners, evenly over time."""
    views = np.flatnonzero((corners.view_camera == camera) & (corners.view_counts >= LEAST_CORNERS))
    if len(views) <= _MOST_VIEWS:
        return views
    groups = np.array_split(views, _MOST_VIEWS)
    return np.array([group[np.argmax(corners.view_counts[group])] for group in groups])


def _calibrated(
    corners: CornerSet, board: CalibrationTarget, views: Integers, size: tuple[int, int]
) -> tuple[Floats, Floats] | None:
    """Calibrate one camera; return its lens (9,) and the error of each view [px], or None."""
    if len(views) < _LEAST_VIEWS:
        return None
    rows = [corners.view_rows(view) for view in views]
    # All points of a side lie in one plane, as OpenCV's start requires.
    points = [(board.points[corners.corner[each]] * [1, 1, 0]).astype(np.float32) for each in rows]
    pixels = [corners.pixels[each].astype(np.float32) for each in rows]
    try:
        _, matrix, bending, _, _, _, _, errors = cv2.calibrateCameraExtended(
            points, pixels, size, np.zeros((3, 3)), np.zeros(5), flags=cv2.CALIB_FIX_K3
        )
    except cv2.error:
        return None
    lens = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *np.ravel(bending)[:5]])
    return lens, np.ravel(errors)


def _is_plausible(lens: Floats, size: tuple[int, int]) -> bool:
    focal, centre = lens[:2] / max(size), lens[2:4] / size
    usual = bool(np.all((focal > 0.2) & (focal < 20.0)) and np.all((centre > 0.1) & (centre < 0.9)))
    return usual and abs(lens[0] / lens[1] - 1.0) < 0.1


def start_session(
    corners: CornerSet, board: CalibrationTarget, lenses: Floats, poses: "dict[int, RigidTransform] | None" = None
) -> SessionStart:
    """Find start values of all poses.

    Args:
        corners: All corners.
        board: The board.
        lenses: (C, 9) start values of the lenses.
        poses: Known poses of cameras by index, from world to camera; the others are found by votes.

    Returns:
        Start values; the world is that of the best connected camera if no pose is known.
    """
    candidates = [plane_poses(corners, board, lenses, view) for view in range(len(corners.view_starts))]
    votes = _all_votes(corners, candidates)
    joined, cameras = connected_cameras(len(lenses), votes)
    if poses is not None:
        joined, cameras = np.zeros(len(lenses), np.int64), [poses[k] for k in range(len(lenses))]
    state = SessionState(
        lens=lenses,
        camera_rotation=np.stack([pose.rotation for pose in cameras]),
        camera_translation=np.stack([pose.translation for pose in cameras]),
        board_rotation=np.broadcast_to(np.eye(3), (len(corners.pictures), 3, 3)),
        board_translation=np.zeros((len(corners.pictures), 3)),
        shape=np.zeros(SHAPE),
        delay=np.zeros(len(lenses)),
    )
    return _with_boards(corners, board, state, candidates, joined, votes)


def plane_poses(corners: CornerSet, board: CalibrationTarget, lenses: Floats, view: int) -> list[RigidTransform]:
    """Return one or two poses of the board before the camera of a view."""
    rows = corners.view_rows(view)
    if rows.stop - rows.start < LEAST_CORNERS:
        return []
    fx, fy, cx, cy, *bending = lenses[corners.view_camera[view]]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    points = board.points[corners.corner[rows]]
    flat = points * [1, 1, 0]
    if np.linalg.matrix_rank(flat - flat.mean(axis=0), tol=1e-6) < 2:
        return []
    try:
        _, turns, shifts, errors = cv2.solvePnPGeneric(
            flat, corners.pixels[rows], matrix, np.array(bending), flags=cv2.SOLVEPNP_IPPE
        )
    except cv2.error:
        return []
    depth = points[:, 2].mean()
    found = [
        RigidTransform.from_vector(np.ravel(turn), np.ravel(shift))
        @ RigidTransform(np.eye(3), np.array([0, 0, -depth]))
        for turn, shift in zip(turns, shifts, strict=True)
        if np.isfinite(turn).all() and np.isfinite(shift).all() and float(np.ravel(shift)[2]) > 0
    ]
    errors = np.ravel(errors)
    keep_second = len(found) > 1 and errors[1] < _AMBIGUOUS * max(errors[0], 1e-9)
    return found if keep_second else found[:1]


def _all_votes(corners: CornerSet, candidates: list[list[RigidTransform]]) -> tuple[PoseVote, ...]:
    of_picture: dict[int, dict[int, list[RigidTransform]]] = {}
    for view, found in enumerate(candidates):
        if found:
            of_picture.setdefault(int(corners.view_picture[view]), {})[int(corners.view_camera[view])] = found
    votes = []
    for first, second in combinations(range(len(corners.cameras)), 2):
        common = [seen for seen in of_picture.values() if first in seen and second in seen]
        if common:
            vote = _vote(first, second, common)
            few = vote.agreeing < min(2, vote.common)
            if not few and vote.agreeing >= _LEAST_AGREEMENT * vote.common:
                votes.append(vote)
    return tuple(votes)


def _vote(first: int, second: int, common: list[dict[int, list[RigidTransform]]]) -> PoseVote:
    """Find the relative pose on which most common pictures agree, by comparing all candidates with each other."""
    spread = [common[k] for k in np.unique(np.linspace(0, len(common) - 1, min(len(common), _MOST_VOTES)).astype(int))]
    relative, picture, distance = [], [], []
    for number, seen in enumerate(spread):
        for a in seen[first]:
            for b in seen[second]:
                relative.append(b @ a.inverse())
                picture.append(number)
                distance.append(np.linalg.norm(b.translation))
    turn, shift = np.stack([each.rotation for each in relative]), np.stack([each.translation for each in relative])
    angle = np.arccos(np.clip((np.einsum("aij,bij->ab", turn, turn) - 1) / 2, -1, 1))
    apart = np.linalg.norm(shift[:, None] - shift, axis=-1)
    same = (angle < SAME_ANGLE) & (apart < SAME_SHIFT * np.array(distance)[:, None])
    owner = np.array(picture)
    support = np.array([len(np.unique(owner[row])) for row in same])
    best = same[np.argmax(support)]
    pose = RigidTransform(rotations.mean(turn[best]), np.median(shift[best], axis=0))
    return PoseVote(
        first=first, second=second, second_from_first=pose, agreeing=int(support.max()), common=len(spread)
    )  # fmt: skip


def connected_cameras(cameras: int, votes: tuple[PoseVote, ...]) -> tuple[Integers, list[RigidTransform]]:
    """Connect the cameras by the votes with the greatest support.

    Args:
        cameras: Number of cameras C.
        votes: Relative poses of pairs.

    Returns:
        The group of each camera (C,), and the poses from the world, which is a camera of each group.
    """
    poses: list[RigidTransform | None] = [None] * cameras
    group = np.full(cameras, -1)
    support = np.zeros(cameras)
    for vote in votes:
        support[[vote.first, vote.second]] += vote.agreeing
    for root in np.argsort(-support, kind="stable"):
        if poses[root] is not None:
            continue
        poses[root], group[root] = RigidTransform.identity(), root
        while True:
            border = [vote for vote in votes if (poses[vote.first] is None) != (poses[vote.second] is None)]
            border = [vote for vote in border if root in (group[vote.first], group[vote.second])]
            if not border:
                break
            best = max(border, key=lambda vote: vote.agreeing)
            known, new, step = best.first, best.second, best.second_from_first
            if poses[known] is None:
                known, new, step = new, known, step.inverse()
            poses[new], group[new] = step @ _known(poses[known]), root
    return group.astype(np.int64), [_known(pose) for pose in poses]


def still_connected(joined: Integers, corners: CornerSet) -> Integers:
    """Return the groups of cameras that common pictures connect, after views were left out.

    Args:
        joined: (C,) groups of cameras that all views connected.
        corners: The corners of the views that are left.

    Returns:
        (C,) groups, each a part of one of the former; each bears the number of one of its cameras, as before if it is
        whole.
    """
    group = np.arange(len(joined))
    for picture in np.unique(corners.view_picture):
        seen = corners.view_camera[corners.view_picture == picture]
        for first, second in combinations(seen.tolist(), 2):
            if joined[first] == joined[second]:
                group[group == group[second]] = group[first]
    for each in np.unique(joined):
        parts = np.unique(group[joined == each])
        seeing = [part for part in parts if np.isin(np.flatnonzero(group == part), corners.camera).any()]
        if len(seeing) < 2:
            # Cameras that see nothing do not divide a group.
            group[joined == each] = each
    return group.astype(np.int64)


def _known(pose: RigidTransform | None) -> RigidTransform:
    assert pose is not None
    return pose


def _with_boards(
    corners: CornerSet,
    board: CalibrationTarget,
    state: SessionState,
    candidates: list[list[RigidTransform]],
    joined: Integers,
    votes: tuple[PoseVote, ...],
) -> SessionStart:
    """Choose for each picture the board pose that explains the corners of all its views best."""
    turn, shift = np.array(state.board_rotation), np.array(state.board_translation)
    seen = np.zeros(len(corners.pictures), bool)
    views_of: dict[int, list[int]] = {}
    for view, picture in enumerate(corners.view_picture):
        views_of.setdefault(int(picture), []).append(view)
    for picture, views in views_of.items():
        options = [
            RigidTransform(state.camera_rotation[camera], state.camera_translation[camera]).inverse() @ pose
            for view in views
            for camera in [int(corners.view_camera[view])]
            for pose in candidates[view]
        ]
        if options:
            best = min(options, key=lambda pose: _picture_error(corners, board, state, views, pose))
            turn[picture], shift[picture], seen[picture] = best.rotation, best.translation, True
    found = SessionState(
        lens=state.lens, camera_rotation=state.camera_rotation, camera_translation=state.camera_translation,
        board_rotation=turn, board_translation=shift, shape=state.shape, delay=state.delay,
    )  # fmt: skip
    return SessionStart(state=found, seen=seen, joined=joined, votes=votes)


def _picture_error(
    corners: CornerSet, board: CalibrationTarget, state: SessionState, views: list[int], pose: RigidTransform
) -> float:
    """Return the sum of the distances of a picture's corners, each bounded, under one board pose [px]."""
    rows = np.concatenate([np.arange(*corners.view_rows(view).indices(len(corners))) for view in views])
    places = CornerPlaces(
        camera=corners.camera[rows], pose=np.zeros(len(rows), np.int64),
        points=board.points[corners.corner[rows]], centre=board.centre,
    )  # fmt: skip
    own = SessionState(
        lens=state.lens, camera_rotation=state.camera_rotation, camera_translation=state.camera_translation,
        board_rotation=pose.rotation[None], board_translation=pose.translation[None], shape=state.shape,
        delay=state.delay,
    )  # fmt: skip
    apart = np.linalg.norm(corners.pixels[rows] - project_corners(own, places)[0], axis=1)
    bound = 0.1 * max(max(size) for size in corners.sizes)
    return float(np.minimum(np.where(np.isnan(apart), bound, apart), bound).sum())


def start_lenses(corners: CornerSet, board: CalibrationTarget) -> Floats:
    """Estimate the lenses of all cameras; see `estimate_lens`.

    Returns:
        (C, 9).
    """
    lenses = [estimate_lens(corners, board, camera) for camera in range(len(corners.cameras))]
    return np.stack(lenses) if lenses else np.zeros((0, LENS))
