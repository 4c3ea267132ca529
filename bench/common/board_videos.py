"""Rendered videos of a board that is carried before several cameras, made with plain OpenCV warps.

The pictures are independent of `marey.calibration.boards.printed`: the board is drawn by OpenCV, and each pixel's ray
is found by `cv2.undistortPoints` and intersected with the plane of the board. A dark figure that carries the board
covers the textured room behind it. Blur by motion and focus, noise of 2 grey levels and H.264 compression are added.
"""

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from tests.made_boards import BOARD, made_rig, walked

from marey.arrays import Floats
from marey.calibration.boards.board import CalibrationBoard
from marey.calibration.boards.detection import charuco_of, known_dictionary
from marey.cameras.camera import Camera
from marey.cameras.rig import Rig
from marey.geometry.rigid import RigidTransform
from marey.io.calibration.readers import write_cameras_toml
from marey.io.video.video_writer import VideoWriter

TEXELS = 112
"""Resolution of the printed board [texels per square]: a marker of three quarters has 7 cells of 12 texels."""
SAMPLES = 2
"""Samples per pixel along either axis."""
NOISE = 2.0
"""Standard deviation of the image noise [grey levels]."""
EXPOSURE = 0.006
"""Exposure of a picture [s]."""
BACK = 150.0
"""Grey level of the back of the board."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BoardVideos:
    """The folder of a made session and its truth."""

    folder: Path
    """The videos and `board.json`."""
    truth: Path
    """The true cameras, as cameras.toml."""
    pictures: int
    cameras: int


def make_board_videos(
    folder: Path, *, cameras: int = 8, seconds: float = 60.0, rate: float = 10.0, seed: int = 5
) -> BoardVideos:
    """Render a session; a folder that is complete is used again.

    Args:
        folder: The folder for `session` and `truth.toml`.
        cameras: Number of cameras.
        seconds: Length of the videos.
        rate: Pictures per second.
        seed: Of the random numbers.
    """
    session, truth, pictures = folder / "session", folder / "truth.toml", round(seconds * rate)
    made = BoardVideos(folder=session, truth=truth, pictures=pictures, cameras=cameras)
    if truth.is_file():
        return made
    session.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(seed)
    rig = made_rig(cameras, rng)
    poses = walked(pictures, rng, BOARD, floor=max(round(2 * rate), 3))
    write_description(session / "board.json", BOARD)
    for camera in rig:
        _write_video(session / f"{camera.name}.mp4", camera, poses, rate, rng)
    write_cameras_toml(Rig(rig.cameras), truth)
    return made


def write_description(path: Path, board: CalibrationBoard) -> None:
    """Write board.json of a ChArUco board."""
    content = {
        "type": "ChArUco", "columns": board.columns, "rows": board.rows, "dictionary": board.dictionary,
        "square_m": board.square, "marker_m": board.marker,
    }  # fmt: skip
    path.write_text(json.dumps(content))


def _write_video(
    path: Path, camera: Camera, poses: list[RigidTransform], rate: float, rng: np.random.Generator
) -> None:
    rays, room = pixel_rays(camera), _room(camera, rng)
    noise = [rng.normal(0, NOISE, room.shape).astype(np.float32) for _ in range(6)]
    pattern = printed_board(BOARD)
    with VideoWriter(path, camera.size, rate=rate) as writer:
        for number, pose in enumerate(poses):
            later = poses[min(number + 1, len(poses) - 1)]
            image = board_picture(camera, pose, later, room=room, rays=rays, pattern=pattern, share=EXPOSURE * rate)
            grain = np.roll(noise[rng.integers(len(noise))], tuple(rng.integers(0, 700, 2)), axis=(0, 1))
            grey = np.clip(np.round(image + grain), 0, 255).astype(np.uint8)
            writer.add(np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), np.uint8))


def printed_board(board: CalibrationBoard) -> list[Floats]:
    """Draw a ChArUco board from squares and OpenCV's markers, and the same at halved resolutions [grey levels].

    OpenCV's own drawing of the whole board places the cells of the markers to a texel only.
    """
    odd = np.add.outer(np.arange(board.rows), np.arange(board.columns)) % 2
    drawn = np.kron(255 * odd, np.ones((TEXELS, TEXELS))).astype(np.float32)
    made, side = charuco_of(board), round(TEXELS * board.marker / board.square)
    dictionary = known_dictionary(board.dictionary)
    for number, points in zip(np.ravel(made.getIds()), made.getObjPoints(), strict=True):
        x, y = (round(float(v) / board.square * TEXELS) for v in np.asarray(points)[0, :2])
        drawn[y : y + side, x : x + side] = cv2.aruco.generateImageMarker(dictionary, int(number), side)
    levels: list[Floats] = [35.0 + 180.0 / 255.0 * drawn]
    while min(levels[-1].shape) % 2 == 0 and max(levels[-1].shape) % 2 == 0:
        levels.append(np.asarray(cv2.resize(levels[-1], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)))
    return levels


def pixel_rays(camera: Camera) -> Floats:
    """Return the directions (H, W, 2) of all pixels in the camera's axes, as x / z and y / z."""
    x, y = np.meshgrid(np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float))
    points = np.stack([x.ravel(), y.ravel()], axis=-1)[:, None]
    found = cv2.undistortPoints(points, camera.matrix, camera.distortion, criteria=(3, 30, 1e-9))
    return np.asarray(found.reshape(camera.height, camera.width, 2))


def _room(camera: Camera, rng: np.random.Generator) -> Floats:
    """Draw a room of random rectangles, some of strong contrast."""
    image = np.full((camera.height, camera.width), 110.0, np.float32)
    for _ in range(90):
        x, y = (int(v) for v in rng.integers(0, [camera.width, camera.height]))
        width, height = (int(v) for v in rng.integers(15, 260, 2))
        cv2.rectangle(image, (x, y), (x + width, y + height), float(rng.uniform(30, 200)), -1)
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 1.2))


def board_picture(
    camera: Camera, pose: RigidTransform, later: RigidTransform, *, room: Floats, rays: Floats, pattern: list[Floats],
    share: float,
) -> Floats:  # fmt: skip
    """Render one picture (H, W) without noise: room, carrier and board, blurred by a share of the motion to a pose."""
    image = room.copy()
    _draw_carrier(image, camera, pose)
    part = _board_part(camera, pose, rays, pattern)
    if part is not None:
        x, y, grey, cover = part
        area = image[y : y + grey.shape[0], x : x + grey.shape[1]]
        area[...] = cover * grey + (1 - cover) * area
        area[...] = _moved_blur(area, share * _motion(camera, pose, later))
    return np.asarray(image)


def _draw_carrier(image: Floats, camera: Camera, pose: RigidTransform) -> None:
    """Draw the person who carries the board, 0.35 m behind it, as an upright dark figure; none with a still board."""
    middle = pose.apply(BOARD.centre)
    if middle[2] < 0.2:
        return
    behind = middle + 0.35 * pose.rotation[:, 2]
    column = np.array([[behind[0], behind[1], z] for z in (0.05, 0.9, 1.45, 1.65)])
    pixels = camera.project(column)
    depth = camera.camera_from_world.apply(column)[:, 2]
    if depth.min() < 0.5 or not np.isfinite(pixels).all():
        return
    widths = np.array([0.16, 0.22, 0.2, 0.11]) * camera.matrix[0, 0] / depth
    for k in range(3):
        start, end = (tuple(int(v) for v in pixels[j]) for j in (k, k + 1))
        cv2.line(image, start, end, 40.0 + 15 * k, int(max(2 * widths[k], 2)), cv2.LINE_AA)


def _board_part(
    camera: Camera, pose: RigidTransform, rays: Floats, pattern: list[Floats]
) -> tuple[int, int, Floats, Floats] | None:
    """Render the board: x and y of the first pixel, grey levels (h, w) and the covered share (h, w)."""
    near = camera.camera_from_world @ pose
    along = np.linspace(-0.03, 1.03, 7)
    outline = np.array([[x * BOARD.extent[0], y * BOARD.extent[1], 0.0] for x in along for y in along])
    if near.apply(outline)[:, 2].min() < 0.3:
        return None
    pixels = camera.project(pose.apply(outline))
    if not np.isfinite(pixels).all():
        return None
    low = np.maximum(np.floor(pixels.min(0)).astype(int) - 6, 0)
    high = np.minimum(np.ceil(pixels.max(0)).astype(int) + 7, camera.size)
    if np.any(high - low < 12):
        return None
    width, height = (int(v) for v in high - low)
    own = rays[low[1] : high[1], low[0] : high[0]]
    fine = cv2.resize(own, (SAMPLES * width, SAMPLES * height), interpolation=cv2.INTER_LINEAR)
    normal = near.rotation[:, 2]
    depth = (normal @ near.translation) / (fine[..., 0] * normal[0] + fine[..., 1] * normal[1] + normal[2])
    points = np.stack([fine[..., 0] * depth, fine[..., 1] * depth, depth], axis=-1) - near.translation
    place = np.asarray(points @ near.rotation[:, :2], np.float32)
    inside = np.asarray(((place > 0) & (place < BOARD.extent)).all(axis=-1), np.float32)
    if normal @ near.apply(BOARD.centre) < 0:
        grey: Floats = np.full(inside.shape, BACK, np.float32)
    else:
        step = np.abs(np.diff(place[::8, ::8], axis=1)).max() / 8 * TEXELS / BOARD.square
        level = int(np.clip(np.round(np.log2(max(step, 1e-6))), 0, len(pattern) - 1))
        texels = TEXELS / BOARD.square / 2**level
        x, y = (np.asarray(place[..., axis] * texels - 0.5, np.float32) for axis in (0, 1))
        grey = np.asarray(cv2.remap(pattern[level], x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
    shown = cv2.resize(grey * inside, (width, height), interpolation=cv2.INTER_AREA)
    cover = cv2.resize(inside, (width, height), interpolation=cv2.INTER_AREA)
    return int(low[0]), int(low[1]), np.asarray(shown / np.maximum(cover, 1e-3)), np.asarray(cover)


def _motion(camera: Camera, pose: RigidTransform, later: RigidTransform) -> Floats:
    """Return the motion of the board's middle in the image from one pose to another [px]."""
    both = camera.project(np.stack([pose.apply(BOARD.centre), later.apply(BOARD.centre)]))
    step = both[1] - both[0]
    return np.asarray(step if np.isfinite(step).all() else np.zeros(2))


def _moved_blur(image: Floats, motion: Floats) -> Floats:
    """Blur an image by its motion and a focus blur of 0.6 px."""
    length = float(np.linalg.norm(motion))
    sharp = np.asarray(cv2.GaussianBlur(image, (0, 0), 0.6))
    if length < 0.3:
        return sharp
    count = 2 * int(np.ceil(length / 2)) + 3
    kernel = np.zeros((count, count), np.float32)
    for share in np.linspace(-0.5, 0.5, 4 * count):
        x, y = count // 2 + share * motion
        i, j = int(np.floor(x)), int(np.floor(y))
        for di, dj in ((0, 0), (1, 0), (0, 1), (1, 1)):
            weight = abs(1 - di - (x - i)) * abs(1 - dj - (y - j))
            if 0 <= j + dj < count and 0 <= i + di < count:
                kernel[j + dj, i + di] += weight
    return np.asarray(cv2.filter2D(sharp, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE))


