"""Corners measured by registration of the printed pattern to a picture.

Around each corner the predicted appearance of the board, blurred like the picture, is shifted until it fits by least squares
([Lucas1981]). All edges of print and markers up to half a square away contribute, and the residuals determine the corner's
covariance. A corner whose surroundings do not look like the print is left out.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from marey.arrays import Floats, Image, Mask
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
_ITERATIONS = 6
"""Largest number of Gauss-Newton iterations of a corner; chosen by hand."""
_SMALL_STEP = 0.003
"""Length of a step that ends the iteration [px]; chosen by hand."""
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
_FIRST_BLUR = 0.4
"""First variance of the blur beyond the pixel's own width [px2]; chosen by hand."""
_GREATEST_BLUR = 36.0
"""Largest variance of the blur [px2]; chosen by hand."""
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
    corner, predicted = visible_corners(board, camera, camera_from_board)
    rendered = render_board(board, camera, camera_from_board) if len(corner) else None
    if rendered is None or np.count_nonzero(rendered.on_board) < _LEAST_PIXELS:
        return None
    shift = _detected_shift(corner, predicted, detected)
    if shift is None:
        shift = _searched_shift(grey, rendered)
    if shift is None:
        return None
    model, blur, shift = _blurred_like(grey, rendered, shift)
    slopes = np.gradient(model)
    found = [
        _registered(grey, rendered, model, slopes, board, camera, camera_from_board, int(index), shift)
        for index in corner
    ]
    good = [k for k, each in enumerate(found) if each is not None]
    if not good:
        return None
    pixels = np.stack([predicted[k] + found[k][0] for k in good])  # type: ignore[index]
    spread = np.stack([found[k][1] for k in good])  # type: ignore[index]
    return RegisteredBoard(sighting=BoardSighting(corner=corner[good], pixels=pixels, covariance=spread), blur=blur)


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
    move = np.array([[1.0, 0.0, x + shift[0]], [0.0, 1.0, y + shift[1]]])
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    moved = cv2.warpAffine(grey.astype(np.float32), move, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(moved, float)


def _blurred_like(grey: Image, rendered: RenderedBoard, shift: Floats) -> tuple[Floats, Floats, Floats]:
    """Blur the rendered board like the picture, and correct the shift of the whole board.

    The picture is a linear function of the blurred board, its derivatives (shift) and its second derivatives (further
    blur), to first order.

    Returns:
        The blurred board (h, w), the variance of the blur (2, 2) [px2], and the shift (2,) [px].
    """
    blur = _FIRST_BLUR * np.eye(2)
    inner = _eroded(rendered.on_board)
    for _ in range(_BLUR_ROUNDS):
        model, part = _blurred(rendered.grey, blur), _part(grey, rendered, shift)
        gy, gx = np.gradient(model)
        gyy, gyx = np.gradient(gy)
        _, gxx = np.gradient(gx)
        columns = [model, np.ones_like(model), -gx, -gy, 0.5 * gxx, gyx, 0.5 * gyy]
        table = np.stack([each[inner] for each in columns], axis=-1)
        gain, _, *rest = np.linalg.lstsq(table, part[inner], rcond=None)[0]
        if gain <= 1.0:
            break
        change = np.clip(np.array(rest) / gain, -1.0, 1.0)
        shift = shift + change[:2]
        blur = _possible(blur + np.array([[change[2], change[3]], [change[3], change[4]]]))
    return _blurred(rendered.grey, blur), blur, shift


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
    return np.asarray(cv2.filter2D(image, cv2.CV_64F, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE))


def _registered(
    grey: Image, rendered: RenderedBoard, model: Floats, slopes: "tuple[Floats, ...] | list[Floats]",
    board: CalibrationBoard, camera: Camera, camera_from_board: RigidTransform, index: int, shift: Floats,
) -> tuple[Floats, Floats] | None:  # fmt: skip
    """Register the surroundings of one corner; return its shift (2,) and covariance (2, 2), or None."""
    window = _window(rendered, board, camera, camera_from_board, index)
    if window is None:
        return None
    rows, columns, mask = window
    template = model[rows, columns][mask]
    slope = np.stack([slopes[1][rows, columns][mask], slopes[0][rows, columns][mask]], axis=-1)
    x, y = np.meshgrid(np.arange(columns.start, columns.stop), np.arange(rows.start, rows.stop))
    x, y = (x + rendered.corner[0]).astype(np.float32), (y + rendered.corner[1]).astype(np.float32)
    offset = shift.copy()
    for _ in range(_ITERATIONS):
        moved_x, moved_y = x + np.float32(offset[0]), y + np.float32(offset[1])
        patch = cv2.remap(grey, moved_x, moved_y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)[mask].astype(float)
        gain, level = _gain(template, patch)
        if gain <= 1.0:
            return None
        # The picture, moved by the offset, is the print moved by what is missing: part = print(u - missing).
        residual = patch - gain * template - level
        table = np.concatenate([-gain * slope, template[:, None], np.ones((len(template), 1))], axis=1)
        normal = table.T @ table
        try:
            step = np.linalg.solve(normal, table.T @ residual)[:2]
        except np.linalg.LinAlgError:
            return None
        offset = offset + step
        if np.linalg.norm(offset - shift) > _GREATEST_SHIFT:
            return None
        if np.linalg.norm(step) < _SMALL_STEP:
            break
    return _checked(template, patch, residual, normal, offset)


def _checked(
    template: Floats, patch: Floats, residual: Floats, normal: Floats, offset: Floats
) -> tuple[Floats, Floats] | None:
    if np.corrcoef(template, patch)[0, 1] < _LEAST_CORRELATION:
        return None
    noise = _CORRELATED * float(residual @ residual) / max(len(residual) - 4, 1)
    spread = noise * np.linalg.inv(normal)[:2, :2] + _LEAST_SD**2 * np.eye(2)
    return (offset, spread) if np.sqrt(np.linalg.eigvalsh(spread)[-1]) < _GREATEST_SD else None


def _gain(template: Floats, patch: Floats) -> tuple[float, float]:
    centred = template - template.mean()
    square = float(centred @ centred)
    gain = float(centred @ patch) / square if square > 0 else 0.0
    return gain, float(patch.mean() - gain * template.mean())


def _window(
    rendered: RenderedBoard, board: CalibrationBoard, camera: Camera, camera_from_board: RigidTransform, index: int
) -> tuple[slice, slice, Mask] | None:
    """Return the part of the rendered board around a corner, and the pixels of its surroundings there."""
    front = board.front[index % len(board.front)]
    reach = _REACH * board.square
    around = front + reach * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    pixels = own_view(camera).project(camera_from_board.apply(around)) - rendered.corner
    middle = own_view(camera).project(camera_from_board.apply(front[None]))[0] - rendered.corner
    if not np.isfinite(pixels).all() or not np.isfinite(middle).all():
        return None
    low = np.maximum(np.floor(np.maximum(pixels.min(axis=0), middle - _MOST_PIXELS)).astype(int), 0)
    limit = np.array(rendered.grey.shape[::-1])
    high = np.minimum(np.ceil(np.minimum(pixels.max(axis=0), middle + _MOST_PIXELS)).astype(int) + 1, limit)
    if np.any(high - low < 3):
        return None
    rows, columns = slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0]))
    apart = np.abs(rendered.place[rows, columns] - front[:2])
    mask = (apart < reach).all(axis=-1) & rendered.on_board[rows, columns]
    return (rows, columns, mask) if np.count_nonzero(mask) >= _LEAST_PIXELS else None
