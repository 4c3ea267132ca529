"""Landmarks: points of the room with known coordinates, which set the world and its scale, and may stand alone.

Each landmark takes part in the adjustment as a pose without rotation of its own, whose translation has the given
coordinates and their standard deviations.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import cv2
import numpy as np

from marey.arrays import Floats, Integers
from marey.calibration.adjustment.adjust import Adjusted, AdjustmentProblem, adjust
from marey.calibration.adjustment.covariance import common_covariance
from marey.calibration.adjustment.lens_choice import DISTORTION_NAMES, FixedModel
from marey.calibration.adjustment.problem import default_lens, session_problem
from marey.calibration.adjustment.solve import LeftOut, SolvedSession
from marey.calibration.adjustment.start import guessed_lens
from marey.calibration.adjustment.state import CAMERA, LENS, LENS_NAMES, SHAPE, SessionState
from marey.calibration.adjustment.wand_start import FOCAL_LENGTHS, nearest_points, straight_directions
from marey.calibration.boards.board import CalibrationBoard
from marey.calibration.boards.corners import BoardSighting, CornerSet
from marey.calibration.boards.wand import Landmark, NoTarget
from marey.errors import SettingProblem
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform

_LEAST_ALIGNED = 3
"""Least number of landmarks, not on one line, that determine the world."""
_LEAST_ALONE = 4
"""Least number of landmarks in a camera that determine its pose without a board; its focal length needs them, too."""
_WRONG_SD = 5.0
"""Distance of a landmark from its place, in standard deviations, beyond which it is left out; chosen by hand."""
_WRONG_M = 0.01
"""A landmark is left out only if that distance exceeds this as well [m]; chosen by hand."""
_WRONG_PX = 2.0
"""Distance of a landmark's pixel from its prediction beyond which it is left out [px]; chosen by hand."""
_FLAT = 0.02
"""Spread of landmarks across their longest direction, relative to it, up to which they lie on one line; by hand."""
_MIRRORED = 0.3
"""Share to which a reflection must lower the distances of landmarks to be called one; chosen by hand."""

LandmarkPixels = Mapping[tuple[int, str], tuple[Floats, Floats]]
"""Pixel (2,) [px] and covariance (2, 2) [px2] of each landmark by camera and name."""


@dataclass(frozen=True, eq=False, kw_only=True)
class LandmarkWorld:
    """A session in the world of its landmarks."""

    solved: SolvedSession
    used: tuple[str, ...]
    """Names of the landmarks that were used."""
    wrong: tuple[tuple[str, float], ...]
    """Landmarks whose coordinates contradict the others, and by how much [m]."""
    mirrored: bool
    """Whether the mirror image of the coordinates fits: their axes are left-handed."""
    scale: float
    """Ratio of the distances of the landmarks in the session to the given ones, before they were adjusted."""
    exchanged: tuple[str, str] | None = None
    """Two landmarks whose coordinates are exchanged."""


def in_landmark_world(
    solved: SolvedSession, landmarks: Sequence[Landmark], pixels: LandmarkPixels
) -> LandmarkWorld | None:
    """Bring a session to the world of landmarks, and adjust it together with them.

    Args:
        solved: The session in any world.
        landmarks: The landmarks.
        pixels: Where the cameras see them.

    Returns:
        The session; None if fewer than three landmarks that are not on one line are seen by two cameras.
    """
    group = np.flatnonzero(solved.joined == np.bincount(solved.joined).argmax())
    places = _triangulated(solved.state, landmarks, pixels, group)
    known = np.asarray(np.isfinite(places).all(axis=1))
    given = np.array([each.place for each in landmarks])
    if np.count_nonzero(known) < _LEAST_ALIGNED or _on_one_line(given[known]):
        return None
    sd = np.array([each.sd for each in landmarks])
    board = solved.adjusted.problem.board
    own = board if isinstance(board, CalibrationBoard) and board.square_assumed else None
    free_scale = own is not None
    pair = _exchanged(places, given, sd, known, free_scale=free_scale)
    keep, wrong = _agreeing(places, given, sd, known & ~np.isin(np.arange(len(known)), pair), free_scale=free_scale)
    wrong = [*pair, *wrong]
    mirrored = _is_mirrored(places[keep], given[keep])
    motion, ratio = _similarity(places[keep], given[keep])
    state, scale = solved.state, 1.0
    if own is not None:
        scale = ratio
        state = _scaled(state, scale)
        board = replace(own, square=own.square * scale, marker=own.marker * scale, gap=own.gap * scale,
                        thickness=own.thickness * scale, square_assumed=False)  # fmt: skip
        motion = RigidTransform(motion.rotation, given[keep].mean(0) - motion.rotation @ (scale * places[keep].mean(0)))
    state = state.moved(motion)
    used = [each for each, good in zip(landmarks, ~np.isin(np.arange(len(landmarks)), wrong), strict=True) if good]
    problem = replace(solved.adjusted.problem, board=board)
    found, left_out = _adjusted_with(problem, state, used, pixels)
    whole = replace(
        solved, adjusted=found, covariance=common_covariance(found), left_out=solved.left_out + left_out,
        landmarks=tuple(each.name for each in used),
    )  # fmt: skip
    off = np.linalg.norm(motion.apply(scale * places) - given, axis=1)
    return LandmarkWorld(
        solved=whole, used=whole.landmarks, wrong=tuple((landmarks[k].name, float(off[k])) for k in wrong),
        mirrored=mirrored, scale=1.0 / ratio,
        exchanged=(landmarks[pair[0]].name, landmarks[pair[1]].name) if pair else None,
    )  # fmt: skip


def _triangulated(
    state: SessionState, landmarks: Sequence[Landmark], pixels: LandmarkPixels, cameras: Integers
) -> Floats:
    """Return the places (K, 3) of landmarks in the world of the session; NaN where fewer than two cameras see one."""
    centre = -np.einsum("cji,cj->ci", state.camera_rotation, state.camera_translation)
    rays = np.full((len(landmarks), len(cameras), 3), np.nan)
    for k, each in enumerate(landmarks):
        for column, camera in enumerate(cameras):
            if (int(camera), each.name) in pixels:
                pixel, _ = pixels[int(camera), each.name]
                direction = straight_directions(pixel[None], state.lens[camera])[0]
                rays[k, column] = state.camera_rotation[camera].T @ [*direction, 1.0]
    return nearest_points(np.broadcast_to(centre[cameras], rays.shape), rays)


def _on_one_line(points: Floats) -> bool:
    values = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(values[1] < _FLAT * values[0])


def _similarity(own: Floats, given: Floats) -> tuple[RigidTransform, float]:
    """Return the rigid motion (without scale) that fits points best, and the ratio of the given size to their own."""
    a, b = own - own.mean(axis=0), given - given.mean(axis=0)
    turn = rotations.nearest(b.T @ a)
    ratio = float(np.sqrt(np.sum(b**2) / np.sum(a**2)))
    return RigidTransform(turn, given.mean(axis=0) - turn @ own.mean(axis=0)), ratio


def _distances(own: Floats, given: Floats, *, free_scale: bool) -> Floats:
    """Return how far points lie from the given ones after the best motion [m]."""
    motion, ratio = _similarity(own, given)
    scale = ratio if free_scale else 1.0
    moved = scale * (own - own.mean(axis=0)) @ motion.rotation.T + given.mean(axis=0)
    return np.asarray(np.linalg.norm(moved - given, axis=1))


def _is_mirrored(own: Floats, given: Floats) -> bool:
    """Return whether the mirror image of the given points fits much better; points in one plane fit both ways."""
    flipped = _distances(own, given * [1.0, 1.0, -1.0], free_scale=True)
    straight = _distances(own, given, free_scale=True)
    return bool(np.sqrt(np.mean(flipped**2)) < _MIRRORED * np.sqrt(np.mean(straight**2)) and straight.max() > _WRONG_M)


def _agreeing(
    own: Floats, given: Floats, sd: Floats, known: np.ndarray, *, free_scale: bool
) -> tuple[Integers, list[int]]:
    """Return the landmarks that agree with each other, and those that do not."""
    keep, wrong = np.flatnonzero(known), []
    while len(keep) > _LEAST_ALIGNED and not _is_mirrored(own[keep], given[keep]):
        off = _distances(own[keep], given[keep], free_scale=free_scale)
        if np.all(off < np.maximum(_WRONG_SD * sd[keep] * np.sqrt(3), _WRONG_M)):
            break
        rest = [np.delete(keep, k) for k in range(len(keep))]
        usable = [each for each in rest if not _on_one_line(given[each])]
        if not usable:
            break
        best = min(usable, key=lambda each: float(_distances(own[each], given[each], free_scale=free_scale).max()))
        if _distances(own[best], given[best], free_scale=free_scale).max() > 0.5 * off.max():
            break
        wrong += np.setdiff1d(keep, best).tolist()
        keep = best
    return keep, wrong


def _exchanged(own: Floats, given: Floats, sd: Floats, known: np.ndarray, *, free_scale: bool) -> tuple[int, ...]:
    """Return two landmarks that agree with all others when their coordinates change places; empty if there are none."""
    seen = np.flatnonzero(known)
    limit = np.maximum(_WRONG_SD * sd * np.sqrt(3), _WRONG_M)
    off = _distances(own[seen], given[seen], free_scale=free_scale)
    if len(seen) < _LEAST_ALIGNED + 2 or np.all(off < limit[seen]):
        return ()
    for first, second in combinations(seen.tolist(), 2):
        other = given.copy()
        other[[first, second]] = given[[second, first]]
        rest = np.setdiff1d(seen, [first, second])
        fits = np.all(_distances(own[seen], other[seen], free_scale=free_scale) < limit[seen])
        if fits and not _on_one_line(given[rest]):
            return first, second
    return ()


def _scaled(state: SessionState, scale: float) -> SessionState:
    return replace(
        state, camera_translation=scale * state.camera_translation, board_translation=scale * state.board_translation
    )


def _adjusted_with(
    problem: AdjustmentProblem, state: SessionState, landmarks: Sequence[Landmark], pixels: LandmarkPixels
) -> tuple[Adjusted, tuple[LeftOut, ...]]:
    """Adjust with landmarks, without those views of them that contradict the rest."""
    left_out: tuple[LeftOut, ...] = ()
    whole, start = _with_landmarks(problem, state, landmarks, pixels)
    found = adjust(whole, start)
    apart = np.linalg.norm(np.nan_to_num(found.residual, nan=1e3), axis=1)
    landmark = whole.corners.corner == len(problem.board.points)
    far = landmark & (apart > _WRONG_PX) & (found.distance > _WRONG_SD)
    if far.any():
        left_out = tuple(
            LeftOut(
                picture=int(whole.corners.picture[k]), camera=int(whole.corners.camera[k]),
                reason=f"lies {apart[k]:.1f} px from its prediction",
            )
            for k in np.flatnonzero(far)
        )  # fmt: skip
        found = adjust(replace(whole, corners=whole.corners.subset(~far)), found.state)
    return found, left_out


def _with_landmarks(
    problem: AdjustmentProblem, state: SessionState, landmarks: Sequence[Landmark], pixels: LandmarkPixels
) -> tuple[AdjustmentProblem, SessionState]:
    """Append one instant for each landmark."""
    corners, board = problem.corners, problem.board
    names = tuple(f"point {each.name}" for each in landmarks)
    number = {each.name: len(corners.pictures) + k for k, each in enumerate(landmarks)}
    rows = corners.sightings()
    for (camera, name), (pixel, spread) in pixels.items():
        if name in number:
            sighting = BoardSighting(corner=np.array([len(board.points)]), pixels=pixel[None], covariance=spread[None])
            rows.append((number[name], camera, sighting))
    joined = CornerSet.gather(corners.cameras, corners.sizes, corners.pictures + names, rows)
    count, more = state.poses, len(landmarks)
    place = np.array([each.place for each in landmarks]).reshape(more, 3) - board.centre
    sd = np.array([each.sd for each in landmarks])
    free = problem.free.copy()
    poses = free[: CAMERA * state.cameras].reshape(-1, CAMERA)
    poses[np.isin(np.arange(state.cameras), joined.camera), LENS:] = True
    start = replace(
        state,
        board_rotation=np.concatenate([state.board_rotation, np.broadcast_to(np.eye(3), (more, 3, 3))]),
        board_translation=np.concatenate([state.board_translation, place]),
    )
    whole = replace(
        problem, corners=joined, board=board, free=free,
        pose=np.concatenate([problem.pose, count + np.arange(more)]),
        fixed_pose=np.concatenate([problem.fixed_pose, np.zeros(more, bool)]),
        place_mean=np.concatenate([problem.place_mean, place]), place_sd=np.concatenate([problem.place_sd, sd]),
    )  # fmt: skip
    return whole, start


def solve_landmarks(
    cameras: tuple[str, ...], sizes: tuple[tuple[int, int], ...], landmarks: Sequence[Landmark],
    pixels: LandmarkPixels, *, fixed: Sequence[FixedModel] = (),
) -> SolvedSession:  # fmt: skip
    """Calibrate cameras from landmarks alone.

    Args:
        cameras: Names of the cameras.
        sizes: Width and height of their images [px].
        landmarks: The landmarks.
        pixels: Where the cameras see them.
        fixed: Distortion coefficients of each camera that were given; by default each lens has k1, k2, p1 and p2.

    Returns:
        The session in the world of the landmarks.

    Raises:
        SettingProblem: A camera sees too few landmarks.
    """
    count = len(cameras)
    start = [_resected(cameras[k], sizes[k], _seen_by(k, landmarks, pixels)) for k in range(count)]
    target = NoTarget()
    empty = CornerSet.gather(cameras, sizes, (), [])
    state = SessionState(
        lens=np.stack([lens for lens, _ in start]),
        camera_rotation=np.stack([pose.rotation for _, pose in start]),
        camera_translation=np.stack([pose.translation for _, pose in start]),
        board_rotation=np.zeros((0, 3, 3)), board_translation=np.zeros((0, 3)), shape=np.zeros(SHAPE),
        delay=np.zeros(count),
    )  # fmt: skip
    joined = np.zeros(count, np.int64)
    problem = session_problem(empty, target, np.zeros((count, LENS), bool), joined, shape=False)
    whole, at = _with_landmarks(problem, state, landmarks, pixels)
    lens = default_lens(whole.corners)
    for camera, model in enumerate(fixed):
        if model is not None:
            lens[camera] = lens[camera].any() & [name not in DISTORTION_NAMES or name in model for name in LENS_NAMES]
    free = whole.free.copy()
    own = free[: CAMERA * count].reshape(-1, CAMERA)
    own[:, [LENS_NAMES.index("fx"), LENS_NAMES.index("fy")]] = True
    first = adjust(replace(whole, free=free), at, rounds=2, displaced=False)
    own[:, :LENS] = lens
    found, left_out = _adjusted_with(replace(problem, free=free), replace(
        first.state, board_rotation=state.board_rotation, board_translation=state.board_translation
    ), landmarks, pixels)  # fmt: skip
    return SolvedSession(
        adjusted=found, covariance=common_covariance(found), joined=joined, votes=(), lens=lens, shape=False,
        left_out=left_out, wrong_corners=0, landmarks=tuple(each.name for each in landmarks), fixed=tuple(fixed),
    )  # fmt: skip


def _seen_by(camera: int, landmarks: Sequence[Landmark], pixels: LandmarkPixels) -> tuple[Floats, Floats]:
    seen = [each for each in landmarks if (camera, each.name) in pixels]
    places = np.array([each.place for each in seen], float).reshape(-1, 3)
    return places, np.array([pixels[camera, each.name][0] for each in seen], float).reshape(-1, 2)


def _resected(name: str, size: tuple[int, int], seen: tuple[Floats, Floats]) -> tuple[Floats, RigidTransform]:
    """Return lens (9,) and pose of a camera by trying focal lengths."""
    places, pixels = seen
    if len(places) < _LEAST_ALONE or _on_one_line(places):
        raise SettingProblem(
            f"Camera {name} sees {len(places)} points with known coordinates; without a board or wand at least "
            f"{_LEAST_ALONE} that are not on one line are needed."
        )
    best: tuple[float, Floats, RigidTransform] | None = None
    for focal in FOCAL_LENGTHS:
        lens = guessed_lens(size, focal)
        matrix = np.array([[lens[0], 0, lens[2]], [0, lens[1], lens[3]], [0, 0, 1]])
        found, turns, shifts, errors = cv2.solvePnPGeneric(places, pixels, matrix, None, flags=cv2.SOLVEPNP_SQPNP)
        for turn, shift, error in zip(turns, shifts, np.ravel(errors), strict=True) if found else ():
            pose = RigidTransform.from_vector(np.ravel(turn), np.ravel(shift))
            ahead = bool(np.all(pose.apply(places)[:, 2] > 0))
            if ahead and (best is None or error < best[0]):
                best = float(error), lens, pose
    if best is None:
        raise SettingProblem(f"Camera {name}: no pose fits its points; check their names and coordinates.")
    return best[1], best[2]
