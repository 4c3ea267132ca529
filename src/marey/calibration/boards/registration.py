"""Corners measured by registration of the printed pattern to a picture.

Around each corner the predicted appearance of the board, blurred like the picture, is shifted until it fits by
least squares
([Lucas1981]). All edges of print and markers up to half a square away contribute, and the residuals determine the
corner's
covariance. A corner whose surroundings do not look like the print is left out.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from marey.arrays import Floats, Image, Integers, Mask
from marey.calibration.boards import registration_kernels as kernels
from marey.calibration.boards.board import CalibrationBoard
from marey.calibration.boards.corners import BoardSighting
from marey.calibration.boards.printed import RenderedBoard, own_view, render_board, visible_corners
from marey.cameras.camera import Camera
from marey.geometry.rigid import RigidTransform

_REACH = 0.5
"""Half width of the surroundings of a corner, in squares: those of neighbouring corners do not overlap."""
_MOST_PIXELS = 24
"""Largest half width of the surroundings of a corner [px]; chosen by hand."""
_LEAST_PIXELS = 16
"""Least number of pixels in the surroundings of a corner; chosen by hand."""
_GREATEST_SHIFT = 3.0
"""Largest shift of a corner from its prediction, after that of the whole board [px]; chosen by hand."""
_LEAST_CORRELATION = 0.75
"""Least correlation of a corner's surroundings with the print; chosen by hand."""
_GREATEST_SD = 0.7
"""Largest standard deviation of a corner [px]; chosen by hand."""
_LEAST_SD = 0.015
"""Standard deviation of a corner's print and rendering [px]; chosen by hand."""
_CORRELATED = 2.0
"""Factor of the variance due to the correlation of neighbouring pixels in compressed video; chosen by hand."""
_BLUR_ROUNDS = 4
"""Number of times that the blur of a picture is estimated; chosen by hand."""
_BLUR_SETTLED = 0.02
"""Change of shift [px] and blur [px2] that ends these rounds; chosen by hand."""
_FIRST_BLUR = 0.4
"""First variance of the blur beyond the pixel's own width [px2]; chosen by hand."""
_GREATEST_BLUR = 36.0
"""Largest variance of the blur [px2]; chosen by hand."""
_CUBIC_REACH = 8
"""Pixels around a moved part of a picture that are kept for its interpolation, more than the two that it uses [px]."""
_SEARCH = 12
"""Largest shift of the whole board from its prediction where it was not found before [px]; chosen by hand."""
_LEAST_MATCH = 0.5
"""Least correlation of the whole board with its prediction in that search; chosen by hand."""


@dataclass(frozen=True, eq=False, kw_only=True)
class RegisteredBoard:
    """The corners that were measured in one picture, and its blur."""

    sighting: BoardSighting
    blur: Floats
    """(2, 2) variance of the blur beyond the pixel's own width [px2]."""


def register_board(
    grey: Image,
    board: CalibrationBoard,
    camera: Camera,
    camera_from_board: RigidTransform,
    *,
    detected: BoardSighting | None = None,
) -> RegisteredBoard | None:
    """Measure all visible corners of a board whose pose is known approximately.

    Args:
        grey: (H, W) the picture.
        board: The board.
        camera: The camera; its own pose is ignored.
        camera_from_board: Approximate pose of the board before the camera.
        detected: Corners that were found in the picture before.

    Returns:
        The corners with covariances; None where the board is not visible.
    """
    own = own_view(camera)
    corner, predicted = visible_corners(board, own, camera_from_board)
    rendered = render_board(board, own, camera_from_board) if len(corner) else None
    if rendered is None or np.count_nonzero(rendered.on_board) < _LEAST_PIXELS:
        return None
    shift = _detected_shift(corner, predicted, detected)
    if shift is None:
        shift = _searched_shift(grey, rendered)
    if shift is None:
        return None
    model, blur, shift = _blurred_like(grey, rendered, shift)
    moved, spread = _registered(grey, rendered, model, _windows(board, own, camera_from_board, rendered, corner), shift)
    good = np.isfinite(moved[:, 0])
    if not good.any():
        return None
    sighting = BoardSighting(corner=corner[good], pixels=predicted[good] + moved[good], covariance=spread[good])
    return RegisteredBoard(sighting=sighting, blur=blur)


def _detected_shift(corner: np.ndarray, predicted: Floats, detected: BoardSighting | None) -> Floats | None:
    """Return the median shift of detected corners from their predictions; None if they are too few or disagree."""
    if detected is None:
        return None
    _, own, other = np.intersect1d(corner, detected.corner, return_indices=True)
    if len(own) < 3:
        return None
    shifts = detected.pixels[other] - predicted[own]
    middle = np.median(shifts, axis=0)
    return np.asarray(middle) if np.median(np.abs(shifts - middle)) < _GREATEST_SHIFT else None


def _searched_shift(grey: Image, rendered: RenderedBoard) -> Floats | None:
    """Search the shift of the whole board by correlation; None if nothing there looks like it."""
    x0, y0 = rendered.corner
    height, width = rendered.grey.shape
    padded = cv2.copyMakeBorder(grey, _SEARCH, _SEARCH, _SEARCH, _SEARCH, cv2.BORDER_REPLICATE)
    window = padded[y0 : y0 + height + 2 * _SEARCH, x0 : x0 + width + 2 * _SEARCH].astype(np.float32)
    template = cv2.GaussianBlur(rendered.grey.astype(np.float32), (0, 0), 0.8)
    mask = rendered.on_board.astype(np.float32)
    score = cv2.matchTemplate(window, template, cv2.TM_CCOEFF_NORMED, mask=mask)
    score = np.where(np.isfinite(score), score, -1.0)
    _, best, _, (x, y) = cv2.minMaxLoc(score)
    return np.array([x - _SEARCH, y - _SEARCH], float) if best > _LEAST_MATCH else None


def _part(grey: Image, rendered: RenderedBoard, shift: Floats) -> Floats:
    """Return the part (h, w) of the picture where the rendered board lies, moved by a shift [px]."""
    height, width = rendered.grey.shape
    x, y = rendered.corner
    # Only what the moved part reaches is converted.
    around = int(np.ceil(np.abs(shift).max())) + _CUBIC_REACH
    left, top = max(x - around, 0), max(y - around, 0)
    near = grey[top : y + height + around, left : x + width + around].astype(np.float32)
    move = np.array([[1.0, 0.0, x - left + shift[0]], [0.0, 1.0, y - top + shift[1]]])
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(near, move, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE))


def _blurred_like(grey: Image, rendered: RenderedBoard, shift: Floats) -> tuple[Floats, Floats, Floats]:
    """Blur the rendered board like the picture, and correct the shift of the whole board.

    The picture is a linear function of the blurred board, its derivatives (shift) and its second derivatives (further
    blur), to first order.

    Returns:
        The blurred board (h, w), the variance of the blur (2, 2) [px2], and the shift (2,) [px].
    """
    blur: Floats = _FIRST_BLUR * np.eye(2)
    inner = _eroded(rendered.on_board)
    for _ in range(_BLUR_ROUNDS):
        model = _blurred(rendered.grey, blur)
        gain, change = _blur_step(model, _part(grey, rendered, shift), inner)
        if gain <= 1.0:
            break
        change = np.clip(change, -1.0, 1.0)
        shift = shift + change[:2]
        blur = _possible(blur + np.array([[change[2], change[3]], [change[3], change[4]]]))
        if np.abs(change).max() < _BLUR_SETTLED:
            break
    return _blurred(rendered.grey, blur), blur, shift


def _blur_step(model: Floats, part: Floats, inner: Mask) -> tuple[float, Floats]:
    """Return the gain, and the steps of shift (2) [px] and blur (3) [px2], that explain a part of the picture."""
    normal, right = np.empty((7, 7)), np.empty(7)
    kernels.blur_equations(model, part, inner, normal, right)
    # A ridge far below the noise keeps a board without edges in one direction solvable.
    normal[np.diag_indices(7)] *= 1.0 + 1e-9
    gain, _, *rest = np.linalg.solve(normal, right)
    return float(gain), np.array(rest) / max(float(gain), 1e-9)


def _eroded(mask: Mask) -> Mask:
    small = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=0).astype(bool)
    return small if small.any() else mask


def _possible(variance: Floats) -> Floats:
    values, vectors = np.linalg.eigh(variance)
    return np.asarray((vectors * np.clip(values, 0.0, _GREATEST_BLUR)) @ vectors.T)


def _blurred(image: Floats, variance: Floats) -> Floats:
    """Convolve an image with a normal density of a variance (2, 2) [px2]."""
    values = np.linalg.eigvalsh(variance)
    if values[-1] < 1e-3:
        return image
    half = int(np.ceil(3.5 * np.sqrt(values[-1]))) + 1
    y, x = np.mgrid[-half : half + 1, -half : half + 1].astype(float)
    # A narrow density is integrated over the pixels approximately: its variance is not let fall below a fraction.
    inverse = np.linalg.inv(variance + 0.02 * np.eye(2))
    kernel = np.exp(-0.5 * (inverse[0, 0] * x * x + 2 * inverse[0, 1] * x * y + inverse[1, 1] * y * y))
    return np.asarray(
        cv2.filter2D(image.astype(np.float32), cv2.CV_32F, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE),
        float,
    )


def _registered(
    grey: Image, rendered: RenderedBoard, model: Floats, windows: "_Windows", shift: Floats
) -> tuple[Floats, Floats]:
    """Register the surroundings of corners; return shifts (n, 2) and covariances (n, 2, 2), NaN where rejected."""
    slope_x, slope_y = np.empty(model.shape), np.empty(model.shape)
    kernels.slopes_of(model, slope_x, slope_y)
    out = np.empty((len(windows.box), kernels.VAR_Y + 1))
    kernels.register_corners(
        grey, model, slope_x, slope_y, rendered.place, rendered.on_board, np.array(rendered.corner), windows.box,
        windows.centre, windows.reach, shift, _GREATEST_SHIFT, out,
    )  # fmt: skip
    spread = np.empty((len(out), 2, 2))
    spread[:, 0, 0], spread[:, 1, 1] = out[:, kernels.VAR_X], out[:, kernels.VAR_Y]
    spread[:, 0, 1] = spread[:, 1, 0] = out[:, kernels.VAR_XY]
    spread = _CORRELATED * spread + _LEAST_SD**2 * np.eye(2)
    with np.errstate(invalid="ignore"):
        good = out[:, kernels.CORRELATION] >= _LEAST_CORRELATION
        good &= np.trace(spread, axis1=1, axis2=2) < _GREATEST_SD**2
    moved = np.where(good[:, None], out[:, kernels.SHIFT_X : kernels.SHIFT_Y + 1], np.nan)
    return moved, spread


@dataclass(frozen=True, eq=False)
class _Windows:
    """The surroundings of corners."""

    box: NDArray[np.int64]
    """(n, 4) first column, first row, and those behind the last, in the rendered part."""
    centre: Floats
    """(n, 2) the corners on the board [m]."""
    reach: float
    """Half width on the board [m]."""


def _windows(
    board: CalibrationBoard, own: Camera, camera_from_board: RigidTransform, rendered: RenderedBoard, corner: Integers
) -> _Windows:
    front = board.front[corner % len(board.front)]
    reach = _REACH * board.square
    ring = reach * np.array([[0, 0, 0], [-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    pixels = own.project(camera_from_board.apply(front[:, None] + ring)) - rendered.corner
    middle, around = pixels[:, 0], pixels[:, 1:]
    low = np.floor(np.maximum(around.min(axis=1), middle - _MOST_PIXELS))
    high = np.ceil(np.minimum(around.max(axis=1), middle + _MOST_PIXELS)) + 1
    known = np.isfinite(low).all(axis=1) & np.isfinite(high).all(axis=1)
    limit = np.array(rendered.grey.shape[::-1])
    box = np.concatenate([np.clip(low, 0, limit), np.clip(high, 0, limit)], axis=1)
    box = np.where(known[:, None], box, 0).astype(np.int64)
    return _Windows(box, np.ascontiguousarray(front[:, :2]), reach)
