"""Made calibration sessions with faults: other clocks, moving cameras, rolling shutters, bad prints.

A board is carried through 4 m x 4 m, brought into the corners of each image, and laid on the floor. Its path is
a smooth curve, so that a camera can show it at any instant. Corners have independent errors of 0.1 px.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline
from tests.made_boards import FLOOR, STEEPEST, made_rig

from marey.arrays import Floats
from marey.calibration.boards.board import CalibrationBoard
from marey.calibration.boards.corners import BoardSighting, CornerSet
from marey.cameras.camera import Camera
from marey.cameras.rig import Rig
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform

BOARD = CalibrationBoard(kind="charuco", columns=6, rows=5, square=0.15, marker=0.11, dictionary="DICT_5X5_250")
"""The board: 20 corners, so that many sessions can be calibrated."""
RATE = 5.0
"""Pictures per second."""
WALK, NEAR, STEP = 40.0, 4.0, 0.5
"""Duration of the walk and of the board before each camera, and time between the poses that define the path [s]."""
ON_FLOOR = 10
"""Number of pictures of the board on the floor."""
NOISE = 0.1
"""Standard deviation of a corner [px]."""
NEAREST = 1.3
"""Distance of the board when it is brought into the corners of an image [m]."""


@dataclass(frozen=True, eq=False)
class BoardPath:
    """A smooth path of the middle of the board, which ends on the floor."""

    place: CubicSpline
    turn: RotationSpline
    end: float
    """Time at which the board lies on the floor [s]."""

    def poses(self, time: Floats) -> tuple[Floats, Floats]:
        """Return the rotations (n, 3, 3) and translations (n, 3) of the board at times (n,)."""
        turn, place = (
            np.array(self.turn(np.clip(time, 0, self.end)).as_matrix()),
            self.place(np.clip(time, 0, self.end)),
        )
        shift = place - turn @ BOARD.centre
        still = time > self.end
        turn[still], shift[still] = FLOOR.rotation, FLOOR.translation
        return turn, shift


def board_path(rig: Rig, rng: np.random.Generator, *, upright: bool = False, near: bool = True) -> BoardPath:
    """Make a path.

    Args:
        rig: The cameras.
        rng: Random numbers.
        upright: Whether the board is never tilted or rolled, and always faces the nearest camera squarely.
        near: Whether it is brought into the corners of each image.
    """
    phase, keys = rng.uniform(0, 2 * np.pi, 6), []
    for t in np.arange(0, WALK, STEP):
        place = np.array([1.6 * np.sin(2 * np.pi * t / 19 + phase[0]), 1.6 * np.sin(2 * np.pi * t / 13 + phase[1]),
                          1.1 + 0.4 * np.sin(2 * np.pi * t / 8 + phase[2])])  # fmt: skip
        heading = 2 * np.pi * t / 9 + phase[3]
        tilt = np.radians(90 + 35 * np.sin(2 * np.pi * t / 7 + phase[4]))
        roll = np.radians(40) * np.sin(2 * np.pi * t / 11 + phase[5])
        turn = rotations.about(np.array([0, 0, 1.0]), heading) @ rotations.about(np.array([1.0, 0, 0]), tilt)
        keys.append((place, _facing(rig, place) if upright else turn @ rotations.about(np.array([0, 0, 1.0]), roll)))
    for camera in rig if near else ():
        corners = camera.size * np.array([[0.12, 0.14], [0.88, 0.14], [0.88, 0.86], [0.12, 0.86]])
        for number in range(int(NEAR / STEP)):
            share, corner = np.modf(4 * number * STEP / NEAR)
            pixel = (1 - share) * corners[int(corner)] + share * corners[(int(corner) + 1) % 4]
            ray = np.array([*camera.undistort(pixel[None])[0], 1.0])
            away = RigidTransform(_tilted(1.3 * number, 1.9 * number), NEAREST * ray / np.linalg.norm(ray))
            pose = camera.camera_from_world.inverse() @ away
            keys.append((pose.translation, pose.rotation))
    time = STEP * np.arange(len(keys))
    turns = Rotation.from_matrix(np.stack([turn for _, turn in keys]))
    return BoardPath(CubicSpline(time, np.stack([place for place, _ in keys])), RotationSpline(time, turns), time[-1])


def _facing(rig: Rig, place: Floats) -> Floats:
    camera = min(rig, key=lambda each: float(np.linalg.norm(each.centre - place)))
    return np.asarray(camera.camera_from_world.rotation.T)


def _tilted(first: float, second: float) -> Floats:
    """Return the rotation of a board before a camera, tilted by up to 30 degrees."""
    return rotations.exp(np.radians(30) * np.array([np.sin(first), np.sin(second), 0.5 * np.sin(first + second)]))


@dataclass(frozen=True, eq=False, kw_only=True)
class Filming:
    """What is filmed, and how; a fault replaces one part of it."""

    rig: Rig
    path: BoardPath
    points: Floats
    """(P, 3) true corners of the print [m]."""
    pictures: int
    clock: Floats
    """(C, F) instant that each picture of each camera shows [s]."""
    readout: Floats
    """(C,) time from the first to the last row of a picture [s]."""
    camera_of: Callable[[int, int], Camera]
    """The camera, as it was at a picture: called with its number and that of the picture."""
    pixels_of: Callable[[int, int, Floats], Floats] = field(default=lambda camera, picture, pixels: pixels)
    """Moves pixels (n, 2): called with camera and picture."""
    noise: Callable[[int, int], float] = field(default=lambda camera, picture: NOISE)
    """Standard deviation of the corners of a picture [px]."""
    seed: int
    board: CalibrationBoard = BOARD


def clean_filming(seed: int, cameras: int = 4, *, rig: Rig | None = None, **path: bool) -> Filming:
    """Return a session without fault.

    Args:
        seed: Of the random numbers.
        cameras: Number of cameras.
        rig: The cameras, if they are not made.
        path: Arguments of `board_path`.
    """
    rng = np.random.default_rng(seed)
    made = made_rig(cameras, rng) if rig is None else rig
    moved = board_path(made, rng, **path)
    pictures = int(moved.end * RATE) + 1 + ON_FLOOR
    return Filming(
        rig=made, path=moved, points=BOARD.points, pictures=pictures, seed=seed,
        clock=np.tile(np.arange(pictures) / RATE, (len(made), 1)), readout=np.zeros(len(made)),
        camera_of=lambda camera, picture: made.cameras[camera],
    )  # fmt: skip


def filmed(filming: Filming) -> CornerSet:
    """Return the corners that the cameras see."""
    rng, rows = np.random.default_rng(filming.seed + 1000), []
    sizes = tuple(filming.camera_of(c, 0).size for c in range(len(filming.rig)))
    for picture in range(filming.pictures):
        for number in range(len(filming.rig)):
            corner, pixels = _seen(filming, number, picture)
            sd = filming.noise(number, picture)
            pixels = filming.pixels_of(number, picture, pixels) + rng.normal(0, sd, pixels.shape)
            inside = np.all((pixels > 3) & (pixels < np.array(sizes[number]) - 4), axis=1)
            if np.count_nonzero(inside) >= 4:
                spread = np.broadcast_to(np.eye(2) * sd**2, (int(inside.sum()), 2, 2))
                rows.append(
                    (picture, number, BoardSighting(corner=corner[inside], pixels=pixels[inside], covariance=spread))
                )
    names = tuple(f"frame {k}" for k in range(filming.pictures))
    return CornerSet.gather(filming.rig.names, sizes, names, rows)


def _seen(filming: Filming, number: int, picture: int) -> tuple[Floats, Floats]:
    """Return numbers (n,) and pixels (n, 2) of the corners that a camera sees from the front and not too steeply."""
    camera, points = filming.camera_of(number, picture), filming.points
    time = np.full(len(points), filming.clock[number, picture])
    pixels = np.zeros((len(points), 2))
    for _ in range(3 if filming.readout[number] else 1):
        turn, shift = filming.path.poses(time)
        places = np.einsum("nij,nj->ni", turn, points) + shift
        pixels = camera.project(places)
        late = filming.readout[number] * (np.nan_to_num(pixels[:, 1]) / camera.height - 0.5)
        time = filming.clock[number, picture] + late
    ray = camera.centre - places
    facing = -np.einsum("ni,ni->n", ray, turn[:, :, 2]) / np.linalg.norm(ray, axis=1)
    good = camera.sees(pixels, margin=4.0) & (facing > np.cos(np.radians(STEEPEST)))
    return np.flatnonzero(good), pixels[good]


def with_camera(filming: Filming, changed: Callable[[Camera, int], Camera], number: int) -> Filming:
    """Return a session in which one camera changes.

    Args:
        filming: The session.
        changed: Returns the camera at a picture.
        number: The camera.
    """
    before = filming.camera_of
    return replace(
        filming, camera_of=lambda c, p: changed(before(c, p), p) if c == number else before(c, p)
    )  # fmt: skip


def rearranged(corners: CornerSet, *, camera: Floats | None = None, picture: Floats | None = None) -> CornerSet:
    """Return corners with other cameras or pictures, without those whose picture does not exist."""
    camera = corners.camera if camera is None else camera
    picture = corners.picture if picture is None else picture
    moved = replace(corners, camera=camera, picture=picture).subset((picture >= 0) & (picture < len(corners.pictures)))
    return moved.ordered(np.lexsort((moved.corner, moved.camera, moved.picture)))
