"""The printed pattern of a board as an image, and its appearance in a camera."""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from marey.arrays import Floats, Mask
from marey.calibration.boards.board import CalibrationBoard
from marey.calibration.boards.detection import charuco_of, known_dictionary
from marey.cameras.camera import Camera
from marey.geometry.rigid import RigidTransform

_TEXELS = 112
"""Resolution of the pattern [texels per square]; a multiple of the 4 to 8 cells of most markers. Chosen by hand."""
_MOST_TEXELS = 4096
"""Largest width or height of the pattern [texels]; chosen by hand."""
_SAMPLES = 3
"""Samples of the pattern per pixel along either axis; chosen by hand."""
_NODE = 8
"""Distance of the nodes at which the lens is inverted, between which positions are interpolated [px]; by hand."""
_MARGIN = 6
"""Width of the border around the board in its rendered image [px]; chosen by hand."""
_STEEPEST = np.cos(np.radians(80.0))
"""Cosine of the angle between the board's normal and the view beyond which no corner is measured; chosen by hand."""


@lru_cache(maxsize=8)
def printed_pattern(board: CalibrationBoard) -> tuple[tuple[Floats, ...], float]:
    """Return the pattern of the front as grey levels from 0 (black) to 1.

    Args:
        board: The board.

    Returns:
        Images of halved resolution, the finest first, and the finest resolution [texels/m].
    """
    finest = min(_TEXELS / board.square, _MOST_TEXELS / float(board.extent.max()))
    width, height = (round(float(side) * finest) for side in board.extent)
    image = _drawn(board, width, height).astype(np.float32) / 255.0
    if board.inverted:
        image = 1.0 - image
    levels: list[Floats] = [image]
    while min(levels[-1].shape) > 32:
        smaller = cv2.resize(levels[-1], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        levels.append(np.asarray(smaller, np.float32))
    return tuple(levels), finest


def _drawn(board: CalibrationBoard, width: int, height: int) -> np.ndarray:
    """Draw the print with every edge at its exact place, to within a texel."""
    x = (np.arange(width) + 0.5) * board.extent[0] / width
    y = (np.arange(height) + 0.5) * board.extent[1] / height
    if board.kind == "markers":
        image = np.full((height, width), 255, np.uint8)
    else:
        odd = np.floor(x / board.square)[None] + np.floor(y / board.square)[:, None]
        flipped = board.kind == "charuco" and board.legacy and board.rows % 2 == 0
        image = np.where(odd % 2 == (1 if flipped else 0), 0, 255).astype(np.uint8)
    for number, left, top, side in _markers(board):
        cells = _cells(board.dictionary, number)
        columns, rows = (x >= left) & (x < left + side), (y >= top) & (y < top + side)
        column = np.minimum(((x[columns] - left) / side * len(cells)).astype(int), len(cells) - 1)
        row = np.minimum(((y[rows] - top) / side * len(cells)).astype(int), len(cells) - 1)
        image[np.ix_(rows, columns)] = cells[np.ix_(row, column)]
    return image


def _markers(board: CalibrationBoard) -> list[tuple[int, float, float, float]]:
    """Return number, left and upper edge and side [m] of every marker."""
    if board.kind == "chessboard":
        return []
    if board.kind == "markers":
        corners = board.front.reshape(-1, 4, 3)[:, 0]
        return [(board.first_marker + k, float(x), float(y), board.square) for k, (x, y, _) in enumerate(corners)]
    made = charuco_of(board)
    places = [np.asarray(points, float)[0] for points in made.getObjPoints()]
    numbers = np.ravel(made.getIds()).tolist()
    return [(int(n), float(p[0]), float(p[1]), board.marker) for n, p in zip(numbers, places, strict=True)]


def _cells(dictionary: str, number: int) -> np.ndarray:
    """Return the cells of a marker with its border as grey levels (n, n)."""
    known = known_dictionary(dictionary)
    side = known.markerSize + 2
    return np.asarray(cv2.aruco.generateImageMarker(known, number, side, borderBits=1))


@dataclass(frozen=True, eq=False, kw_only=True)
class RenderedBoard:
    """The appearance of a board in the part of an image that contains it."""

    corner: tuple[int, int]
    """x, y of the first pixel of the part."""
    grey: Floats
    """(h, w) grey levels from 0 to 1; plain paper beside the print."""
    on_board: Mask
    """(h, w) true on the printed pattern, and on the margin of a grid of markers."""
    place: Floats
    """(h, w, 2) position on the board of each pixel, x and y [m]; NaN where there is none."""


def visible_corners(
    board: CalibrationBoard, own: Camera, camera_from_board: RigidTransform
) -> tuple[np.ndarray, Floats]:
    """Return which corners a camera may see, by the side of the board that faces it.

    Args:
        board: The board.
        own: A camera whose world is its own axes, see `own_view`.
        camera_from_board: Pose of the board before the camera.

    Returns:
        Indices (n,) in `board.points`, and pixels (n, 2) inside the image.
    """
    count = len(board.front)
    middle = camera_from_board.apply(board.centre)
    normal = camera_from_board.rotation[:, 2]
    facing = float(normal @ middle / np.linalg.norm(middle))
    if abs(facing) < _STEEPEST or (facing < 0 and not board.two_sided):
        return np.zeros(0, np.int64), np.zeros((0, 2))
    side = np.arange(count) if facing > 0 else count + np.arange(count)
    pixels = own.project(camera_from_board.apply(board.points[side]))
    inside = own.sees(pixels, margin=3.0)
    return side[inside], pixels[inside]


def own_view(camera: Camera) -> Camera:
    """Return a camera whose world is its own axes."""
    return camera.moved(camera.camera_from_world)


def render_board(board: CalibrationBoard, own: Camera, camera_from_board: RigidTransform) -> RenderedBoard | None:
    """Render the side of a board that faces a camera.

    Args:
        board: The board.
        own: A camera whose world is its own axes, see `own_view`.
        camera_from_board: Pose of the board before the camera.

    Returns:
        The rendered part of the image, or None where the board is outside of the image.
    """
    box = _box(board, own, camera_from_board)
    if box is None:
        return None
    x0, y0, width, height = box
    fine = _places(board, own, camera_from_board, x0, y0, width, height)
    (levels, finest), extent = printed_pattern(board), board.extent
    level = _level(fine, finest, len(levels))
    image = levels[level]
    scale = (np.array([image.shape[1], image.shape[0]]) / extent).astype(np.float32)
    sample = cv2.remap(
        image, fine[..., 0] * scale[0] - np.float32(0.5), fine[..., 1] * scale[1] - np.float32(0.5),
        cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE,
    )  # fmt: skip
    inside = _within(fine, extent, 0.0)
    # Detection needs a margin of plain paper around the print.
    sample = np.where(inside, sample, 0.0 if board.inverted else 1.0).astype(np.float32)
    grey = cv2.resize(sample, (width, height), interpolation=cv2.INTER_AREA)
    # The outermost corners of a grid of markers need the paper beside them.
    middle = fine[_SAMPLES // 2 :: _SAMPLES, _SAMPLES // 2 :: _SAMPLES]
    known = _within(middle, extent, 0.5 * board.gap)
    return RenderedBoard(
        corner=(x0, y0), grey=grey.astype(float),
        on_board=np.ascontiguousarray(known),
        place=np.ascontiguousarray(middle),
    )  # fmt: skip


def _within(places: Floats, extent: Floats, margin: float) -> Mask:
    """Return which places (h, w, 2) on the board lie on its print, or up to a margin beside it [m]."""
    x, y = places[..., 0], places[..., 1]
    width, height = extent.astype(np.float32) + np.float32(margin)
    return np.asarray((x > -margin) & (x < width) & (y > -margin) & (y < height))


def _box(board: CalibrationBoard, own: Camera, camera_from_board: RigidTransform) -> tuple[int, int, int, int] | None:
    """Return x, y, width and height of the part of the image that contains the board."""
    along = np.linspace(0, 1, 9)
    x, y = np.meshgrid(along * board.extent[0], along * board.extent[1])
    outline = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=-1)
    pixels = own.project(camera_from_board.apply(outline))
    seen = pixels[np.isfinite(pixels).all(axis=1)]
    if not len(seen):
        return None
    low = np.maximum(np.floor(seen.min(axis=0)).astype(int) - _MARGIN, 0)
    high = np.minimum(np.ceil(seen.max(axis=0)).astype(int) + _MARGIN + 1, own.size)
    if np.any(high - low < 2 * _MARGIN):
        return None
    return int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1])


def _places(
    board: CalibrationBoard, own: Camera, pose: RigidTransform, x0: int, y0: int, width: int, height: int
) -> Floats:
    """Return the positions on the board (h S, w S, 2) of the samples of a part of an image [m]."""
    columns, rows = -(-width // _NODE) + 2, -(-height // _NODE) + 2
    x = x0 - 0.5 + _NODE * (np.arange(columns) - 0.5)
    y = y0 - 0.5 + _NODE * (np.arange(rows) - 0.5)
    nodes = np.stack(np.meshgrid(x, y), axis=-1)
    straight = own.undistort(nodes)
    directions = np.concatenate([straight, np.ones_like(straight[..., :1])], axis=-1)
    normal = pose.rotation[:, 2]
    depth = (normal @ pose.translation) / (directions @ normal)
    depth = np.where(depth > 0, depth, np.nan)
    points = (directions * depth[..., None] - pose.translation) @ pose.rotation
    fine = cv2.resize(
        points[..., :2].astype(np.float32),
        None,
        fx=_NODE * _SAMPLES,
        fy=_NODE * _SAMPLES,
        interpolation=cv2.INTER_LINEAR,
    )
    start = _NODE * _SAMPLES
    return np.asarray(fine[start : start + height * _SAMPLES, start : start + width * _SAMPLES])


def _level(fine: Floats, finest: float, levels: int) -> int:
    """Choose the resolution at which neighbouring samples are about one texel apart."""
    coarse = fine[::_NODE, ::_NODE].astype(float)
    down, across = coarse[1:, :-1] - coarse[:-1, :-1], coarse[:-1, 1:] - coarse[:-1, :-1]
    area = np.abs(down[..., 0] * across[..., 1] - down[..., 1] * across[..., 0])
    step = np.sqrt(np.nanmedian(area)) / _NODE
    return int(np.clip(np.round(np.log2(max(step * finest, 1e-9))), 0, levels - 1))
