"""Finding of boards in pictures, with OpenCV."""

from collections.abc import Sequence
from functools import lru_cache

import cv2
import numpy as np

from marey.arrays import Floats, Image, Integers
from marey.calibration.boards.board import CalibrationBoard
from marey.calibration.boards.corner_errors import corner_covariances, image_noise
from marey.calibration.boards.corners import BoardSighting
from marey.errors import SettingProblem

_LEAST_PERIMETER = 0.01
"""Smallest perimeter of a marker, as a share of the longer side of the image.

With OpenCV's 0.03 no marker of the board on the floor is found in the pictures of the rendered session, with 0.01
three in
two of its four cameras.
"""
_LEAST_HALF_WINDOW, _GREATEST_HALF_WINDOW = 2, 9
"""Half widths of the window in which a corner is refined [px], smallest and largest; chosen by hand."""
_WINDOW_SHARE = 0.25
"""Half width of that window as a share of the distance to the nearest corner; chosen by hand."""
_REFINEMENT = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4)
"""End of the refinement of corners: number of iterations, and shift [px]."""
_GREATEST_SHIFT = 1.5
"""Largest shift of a corner by its refinement, in half widths of the window; chosen by hand."""
_SMALL_CHESSBOARD = 640
"""Longer side [px] to which an image is reduced to see whether it shows a chessboard at all; chosen by hand."""


def known_dictionary(name: str) -> "cv2.aruco.Dictionary":
    """Return a dictionary of markers.

    Args:
        name: OpenCV's name, for example DICT_5X5_250, with or without DICT_.

    Raises:
        SettingProblem: There is no such dictionary.
    """
    known = {key for key in dir(cv2.aruco) if key.startswith("DICT_")}
    wanted = name.upper() if name.upper().startswith("DICT_") else f"DICT_{name.upper()}"
    if wanted not in known:
        raise SettingProblem(f"There is no dictionary '{name}' of markers; OpenCV knows {', '.join(sorted(known))}.")
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, wanted))


@lru_cache(maxsize=16)
def charuco_of(board: CalibrationBoard) -> "cv2.aruco.CharucoBoard":
    """Return OpenCV's own description of a ChArUco board."""
    dictionary = known_dictionary(board.dictionary)
    count = board.columns * board.rows // 2
    ids = np.arange(board.first_marker, board.first_marker + count)
    made = cv2.aruco.CharucoBoard((board.columns, board.rows), board.square, board.marker, dictionary, ids)
    made.setLegacyPattern(board.legacy)
    return made


def _parameters() -> "cv2.aruco.DetectorParameters":
    parameters = cv2.aruco.DetectorParameters()
    parameters.minMarkerPerimeterRate = _LEAST_PERIMETER
    return parameters


def _charuco_detector(board: CalibrationBoard) -> "cv2.aruco.CharucoDetector":
    settings = cv2.aruco.CharucoParameters()
    settings.minMarkers = 1
    return cv2.aruco.CharucoDetector(charuco_of(board), settings, _parameters())


def find_board(grey: Image, board: CalibrationBoard) -> BoardSighting | None:
    """Find the corners of a board in a picture.

    Args:
        grey: (H, W).
        board: The board.

    Returns:
        The corners with covariances, or None where the board is not found. With a two-sided board, the corners of the
        side that is seen.
    """
    shown = 255 - grey if board.inverted else grey
    front = _find_side(shown, board)
    if not board.two_sided or (front is not None and len(front[0]) >= len(board.front) // 2):
        return _with_covariance(grey, front, 0)
    mirrored = _find_side(np.ascontiguousarray(shown[:, ::-1]), board)
    if mirrored is None or (front is not None and len(front[0]) >= len(mirrored[0])):
        return _with_covariance(grey, front, 0)
    corner, pixels = mirrored
    unmirrored = np.stack([grey.shape[1] - 1 - pixels[:, 0], pixels[:, 1]], axis=-1)
    return _with_covariance(grey, (corner, unmirrored), len(board.front))


def find_mirrored(grey: Image, board: CalibrationBoard) -> int:
    """Return how many corners are found in the mirror image of a picture, which should show none of a one-sided board.

    Args:
        grey: (H, W).
        board: The board.
    """
    shown = 255 - grey if board.inverted else grey
    found = _find_side(np.ascontiguousarray(shown[:, ::-1]), board)
    return 0 if found is None else len(found[0])


def _find_side(shown: Image, board: CalibrationBoard) -> tuple[Integers, Floats] | None:
    """Find corners (n,) and their pixels (n, 2) in a picture in which black is black."""
    if board.kind == "charuco":
        found = _find_charuco(shown, board)
    elif board.kind == "markers":
        found = _find_markers(shown, board)
    else:
        found = _find_chessboard(shown, board)
    return found if found is not None and len(found[0]) else None


def _find_charuco(shown: Image, board: CalibrationBoard) -> tuple[Integers, Floats] | None:
    corners, ids, _, _ = _charuco_detector(board).detectBoard(shown)
    if ids is None or not len(ids):
        return None
    corner, pixels = np.ravel(ids).astype(np.int64), np.reshape(corners, (-1, 2)).astype(float)
    return _inside(shown, corner, pixels)


def _find_markers(shown: Image, board: CalibrationBoard) -> tuple[Integers, Floats] | None:
    detector = cv2.aruco.ArucoDetector(known_dictionary(board.dictionary), _parameters())
    corners, ids, _ = detector.detectMarkers(shown)
    if ids is None or not len(ids):
        return None
    number = np.ravel(ids).astype(np.int64) - board.first_marker
    pixels = np.reshape(np.stack([np.reshape(each, (4, 2)) for each in corners]), (-1, 4, 2)).astype(float)
    own = (number >= 0) & (number < board.columns * board.rows)
    corner = (4 * number[own, None] + np.arange(4)).ravel()
    return _refined(shown, corner, pixels[own].reshape(-1, 2)) if own.any() else None


def _find_chessboard(shown: Image, board: CalibrationBoard) -> tuple[Integers, Floats] | None:
    pattern = (board.columns - 1, board.rows - 1)
    if not _may_show_chessboard(shown, pattern):
        return None
    found, corners = cv2.findChessboardCornersSB(
        shown, pattern, flags=cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    )
    if not found:
        found, corners = cv2.findChessboardCorners(shown, pattern)
    if not found:
        return None
    grid = _oriented(shown, np.reshape(corners, (pattern[1], pattern[0], 2)).astype(float))
    return _refined(shown, np.arange(len(board.front)), grid.reshape(-1, 2))


def _may_show_chessboard(shown: Image, pattern: tuple[int, int]) -> bool:
    """Return whether a reduced image may show a chessboard; the full search takes seconds where there is none."""
    longest = max(shown.shape)
    if longest <= _SMALL_CHESSBOARD:
        return True
    scale = _SMALL_CHESSBOARD / longest
    small = cv2.resize(shown, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return bool(cv2.checkChessboard(small, pattern) or cv2.checkChessboard(shown, pattern))


def _oriented(shown: Image, grid: Floats) -> Floats:
    """Order the corners (rows, columns, 2) of a chessboard clockwise, and so that the first square is black.

    A board with one even and one odd number of corners has one such order; others look the same after half a turn.
    """
    across, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if across[0] * down[1] - across[1] * down[0] < 0:
        grid = grid[::-1]
    first, last = (_mean_grey(shown, each) for each in (grid[:2, :2], grid[-2:, -2:]))
    beside = 0.5 * (_mean_grey(shown, grid[:2, 1:3]) + _mean_grey(shown, grid[-2:, -3:-1]))
    turned = (first > beside) if (grid.shape[0] + grid.shape[1]) % 2 else False
    return np.asarray(grid[::-1, ::-1] if turned and last < first else grid)


def _mean_grey(shown: Image, square: Floats) -> float:
    """Return the grey level in the middle of four corners (2, 2, 2)."""
    centre = square.reshape(-1, 2).mean(axis=0)
    return float(cv2.getRectSubPix(shown, (3, 3), (float(centre[0]), float(centre[1]))).mean())


def _refined(shown: Image, corner: Integers, pixels: Floats) -> tuple[Integers, Floats] | None:
    """Refine corners to a part of a pixel, each in a window that reaches no other; drop those that wander off."""
    order = np.argsort(corner, kind="stable")
    corner, pixels = corner[order], pixels[order]
    half = half_windows(pixels)
    refined = pixels.copy()
    for size in np.unique(half):
        own = half == size
        start = np.ascontiguousarray(pixels[own, None].astype(np.float32))
        refined[own] = cv2.cornerSubPix(shown, start, (int(size), int(size)), (-1, -1), _REFINEMENT)[:, 0]
    near = np.linalg.norm(refined - pixels, axis=1) <= _GREATEST_SHIFT * half
    return _inside(shown, corner[near], refined[near])


def _inside(shown: Image, corner: Integers, pixels: Floats) -> tuple[Integers, Floats] | None:
    """Keep the corners that lie in the image with their surroundings, in ascending order."""
    height, width = shown.shape
    keep = (pixels > 2).all(axis=1) & (pixels < [width - 3, height - 3]).all(axis=1)
    order = np.argsort(corner[keep], kind="stable")
    return (corner[keep][order], pixels[keep][order]) if keep.any() else None


def half_windows(pixels: Floats) -> Integers:
    """Return half widths (n,) of windows around corners (n, 2) that contain no other corner [px]."""
    if len(pixels) < 2:
        return np.full(len(pixels), _LEAST_HALF_WINDOW)
    apart = np.linalg.norm(pixels[:, None] - pixels, axis=-1)
    np.fill_diagonal(apart, np.inf)
    half = np.clip(np.round(_WINDOW_SHARE * apart.min(axis=1)), _LEAST_HALF_WINDOW, _GREATEST_HALF_WINDOW)
    return np.asarray(half.astype(np.int64))


def _with_covariance(grey: Image, found: tuple[Integers, Floats] | None, offset: int) -> BoardSighting | None:
    if found is None:
        return None
    corner, pixels = found
    spread = corner_covariances(grey, pixels, half_windows(pixels).astype(float), image_noise(grey))
    keep = np.isfinite(spread).all(axis=(1, 2))
    if not keep.any():
        return None
    return BoardSighting(corner=corner[keep] + offset, pixels=pixels[keep], covariance=spread[keep])


def find_tags(grey: Image, dictionary: str, numbers: Sequence[int]) -> dict[int, tuple[Floats, Floats]]:
    """Find the centres of single tags, the intersections of their diagonals.

    Args:
        grey: (H, W).
        dictionary: OpenCV's name of the dictionary.
        numbers: The tags that are searched.

    Returns:
        Centre (2,) [px] and covariance (2, 2) [px2] by number; a tag that appears twice is left out.
    """
    corners, ids, _ = cv2.aruco.ArucoDetector(known_dictionary(dictionary), _parameters()).detectMarkers(grey)
    if ids is None:
        return {}
    found: dict[int, tuple[Floats, Floats]] = {}
    every = [int(each) for each in np.ravel(ids)]
    noise = image_noise(grey)
    for number, quad in zip(every, corners, strict=True):
        refined = _refined(grey, np.arange(4), np.reshape(quad, (4, 2)).astype(float))
        if number not in numbers or every.count(number) > 1 or refined is None or len(refined[0]) < 4:
            continue
        spread = corner_covariances(grey, refined[1], half_windows(refined[1]).astype(float), noise)
        if np.isfinite(spread).all():
            found[number] = _diagonal_centre(refined[1]), spread.mean(axis=0) / 4
    return found


def _diagonal_centre(quad: Floats) -> Floats:
    """Return where the diagonals of corners (4, 2) meet."""
    one, two = quad[2] - quad[0], quad[3] - quad[1]
    along = np.linalg.solve(np.stack([one, -two], axis=-1), quad[1] - quad[0])
    return np.asarray(quad[0] + along[0] * one)
