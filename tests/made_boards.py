"""Made calibration sessions: true cameras around a board that is walked about, and exact or noisy corners."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats
from marey.calibration.boards.board import CalibrationBoard
from marey.calibration.boards.corners import BoardSighting, CornerSet
from marey.cameras.camera import Camera
from marey.cameras.rig import Rig
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform
from tests.worlds import looking_at

BOARD = CalibrationBoard(kind="charuco", columns=9, rows=6, square=0.1, marker=0.075, dictionary="DICT_5X5_250")
FLOOR = RigidTransform(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
"""The board on the floor: its x is the world's x, its y the world's -y, its z points down."""
STEEPEST = 75.0
"""Angle [deg] between the board's normal and the view beyond which corners are not found."""


@dataclass(frozen=True, eq=False, kw_only=True)
class MadeSession:
    """True cameras and board poses, and the corners that the cameras found."""

    rig: Rig
    world_from_board: tuple[RigidTransform, ...]
    """One pose per picture."""
    corners: CornerSet
    board: CalibrationBoard


def made_rig(cameras: int, rng: np.random.Generator, *, radius: float = 4.0, lens: bool = True) -> Rig:
    """Cameras of 1280 x 720 px on a ring around a 4 m x 4 m floor, at 1.5 to 2.5 m, with lenses like real ones."""
    made = []
    for k in range(cameras):
        bearing = 2 * np.pi * (k + 0.3 * rng.random()) / cameras
        centre = np.array([radius * np.cos(bearing), radius * np.sin(bearing), rng.uniform(1.5, 2.5)])
        plain = looking_at(np.array([0.0, 0.0, 1.0]) + rng.normal(0, 0.1, 3), centre, name=f"cam{k + 1:02d}",
                           size=(1280, 720), focal=rng.uniform(850, 1000))  # fmt: skip
        matrix = np.array(plain.matrix)
        matrix[1, 1] *= 1 + rng.normal(0, 0.001)
        matrix[:2, 2] += rng.normal(0, 8, 2)
        bending = np.array([rng.uniform(-0.2, 0.05), rng.uniform(0, 0.08), *rng.normal(0, 5e-4, 2)])
        made.append(
            Camera(name=plain.name, size=plain.size, matrix=matrix, distortion=bending if lens else np.zeros(4),
                   camera_from_world=plain.camera_from_world)
        )  # fmt: skip
    return Rig(tuple(made))


def walked(
    pictures: int, rng: np.random.Generator, board: CalibrationBoard, *, floor: int = 12
) -> list[RigidTransform]:
    """Poses of a board that is walked through 4 m x 4 m facing different ways, and at last laid on the floor."""
    time = np.linspace(0, 1, pictures - floor)
    phase = rng.uniform(0, 2 * np.pi, 6)
    place = np.stack([1.6 * np.sin(9.1 * np.pi * time + phase[0]), 1.6 * np.sin(13.7 * np.pi * time + phase[1]),
                      1.1 + 0.5 * np.sin(23 * np.pi * time + phase[2])], -1)  # fmt: skip
    heading = 2 * np.pi * 11.3 * time + phase[3]
    tilt = np.radians(90 + 35 * np.sin(31 * np.pi * time + phase[4]))
    roll = np.radians(40) * np.sin(17 * np.pi * time + phase[5])
    poses = []
    for k in range(len(time)):
        turn = rotations.about(np.array([0, 0, 1.0]), heading[k]) @ rotations.about(np.array([1.0, 0, 0]), tilt[k])
        turn = turn @ rotations.about(np.array([0, 0, 1.0]), roll[k])
        poses.append(RigidTransform(turn, place[k] - turn @ board.centre))
    return poses + [FLOOR] * floor


def seen_corners(camera: Camera, world_from_board: RigidTransform, board: CalibrationBoard) -> tuple[Floats, Floats]:
    """Indices and exact pixels of the corners that a camera sees from the front, not too steeply, inside the image."""
    points = world_from_board.apply(board.front)
    pixels = camera.project(points)
    to_camera = camera.centre - points
    facing = -(to_camera @ world_from_board.rotation[:, 2]) / np.linalg.norm(to_camera, axis=1)
    good = camera.sees(pixels, margin=4.0) & (facing > np.cos(np.radians(STEEPEST)))
    return np.flatnonzero(good), pixels[good]


def made_session(
    *, cameras: int = 4, pictures: int = 150, seed: int = 0, noise: float = 0.1, board: CalibrationBoard = BOARD,
    floor: int = 12, lens: bool = True, rig: Rig | None = None, poses: list[RigidTransform] | None = None,
) -> MadeSession:  # fmt: skip
    """A session with independent errors of the corners of a standard deviation [px]."""
    rng = np.random.default_rng(seed)
    rig = made_rig(cameras, rng, lens=lens) if rig is None else rig
    poses = walked(pictures, rng, board, floor=floor) if poses is None else poses
    rows = []
    for k, pose in enumerate(poses):
        for c, camera in enumerate(rig):
            index, pixels = seen_corners(camera, pose, board)
            if len(index) >= 4:
                found = pixels + rng.normal(0, noise, pixels.shape)
                spread = np.broadcast_to(np.eye(2) * max(noise, 1e-3) ** 2, (len(index), 2, 2))
                rows.append((k, c, BoardSighting(corner=index, pixels=found, covariance=spread)))
    names = tuple(f"{k:04d}" for k in range(len(poses)))
    corners = CornerSet.gather(rig.names, tuple(camera.size for camera in rig), names, rows)
    return MadeSession(rig=rig, world_from_board=tuple(poses), corners=corners, board=board)
