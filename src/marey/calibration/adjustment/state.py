"""The unknowns of a calibration: lenses, camera poses, board poses and the shape of the board."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Floats, freeze_fields
from marey.cameras.camera import Camera
from marey.cameras.rig import Rig
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform

LENS_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
"""Parameters of a lens in the order of their columns; the first four in pixels."""
LENS = len(LENS_NAMES)
"""Number of parameters of a lens: see `LENS_NAMES`."""
CAMERA = LENS + 6
"""Number of parameters of a camera: its lens, then rotation [rad] and translation [m] from world to camera."""
SHAPE_NAMES = ("stretch", "bend_xx", "bend_xy", "bend_yy")
"""Parameters of the board's shape in the order of their columns: ratio minus one, then three curvatures [1/m]."""
SHAPE = len(SHAPE_NAMES)
"""Number of parameters of the board's shape: see `SHAPE_NAMES`."""


def shape_unknowns(cameras: int) -> slice:
    """Return where the parameters of the board's shape are among the common unknowns of C cameras."""
    return slice(CAMERA * cameras, CAMERA * cameras + SHAPE)


def delay_unknowns(cameras: int) -> slice:
    """Return where the delays are among the common unknowns of C cameras: behind all others."""
    return slice(CAMERA * cameras + SHAPE, common_size(cameras))


def common_size(cameras: int) -> int:
    """Return the number of common unknowns of C cameras."""
    return CAMERA * cameras + SHAPE + cameras


@dataclass(frozen=True, eq=False, kw_only=True)
class SessionState:
    """Values of all unknowns."""

    lens: Floats
    """(C, 9) parameters in the order of `LENS_NAMES`."""
    camera_rotation: Floats
    """(C, 3, 3) from world to camera."""
    camera_translation: Floats
    """(C, 3) from world to camera [m]."""
    board_rotation: Floats
    """(B, 3, 3) from board to world, for each board pose."""
    board_translation: Floats
    """(B, 3) from board to world [m]."""
    shape: Floats
    """(4,) in the order of `SHAPE_NAMES`."""
    delay: Floats
    """(C,) by how much each camera is later than its corners are taken to be [pictures]."""

    def __post_init__(self) -> None:
        freeze_fields(self, "lens", "camera_rotation", "camera_translation", "delay")
        freeze_fields(self, "board_rotation", "board_translation", "shape")

    @property
    def cameras(self) -> int:
        """Number of cameras."""
        return len(self.lens)

    @property
    def poses(self) -> int:
        """Number of board poses."""
        return len(self.board_rotation)

    @property
    def size(self) -> int:
        """Number of common unknowns, 16 C + 4: cameras, the board's shape, and delays."""
        return common_size(self.cameras)

    def stepped(self, common: Floats, board: Floats) -> "SessionState":
        """Return the state after a step.

        Args:
            common: (16 C + 4,) steps of the cameras, the board's shape and the delays; rotations turn on the left.
            board: (B, 6) steps of rotation [rad] and translation [m] of the board poses.

        Returns:
            The new state.
        """
        own = common[: CAMERA * self.cameras].reshape(-1, CAMERA)
        return SessionState(
            lens=self.lens + own[:, :LENS],
            camera_rotation=rotations.exp(own[:, LENS : LENS + 3]) @ self.camera_rotation,
            camera_translation=self.camera_translation + own[:, LENS + 3 :],
            board_rotation=rotations.exp(board[:, :3]) @ self.board_rotation,
            board_translation=self.board_translation + board[:, 3:],
            shape=self.shape + common[shape_unknowns(self.cameras)],
            delay=self.delay + common[delay_unknowns(self.cameras)],
        )

    def moved(self, new_from_old: RigidTransform) -> "SessionState":
        """Return the same cameras and boards in another world frame.

        Args:
            new_from_old: Transform from the present world frame to the new one.
        """
        back = new_from_old.inverse()
        return replace(
            self,
            camera_rotation=self.camera_rotation @ back.rotation,
            camera_translation=self.camera_translation + self.camera_rotation @ back.translation,
            board_rotation=new_from_old.rotation @ self.board_rotation,
            board_translation=new_from_old.apply(self.board_translation),
        )

    def of_cameras(self, cameras: Sequence[int]) -> "SessionState":
        """Return the state with some of the cameras only.

        Args:
            cameras: Their indices.
        """
        keep = list(cameras)
        return replace(
            self, lens=self.lens[keep], camera_rotation=self.camera_rotation[keep],
            camera_translation=self.camera_translation[keep], delay=self.delay[keep],
        )  # fmt: skip

    def board_pose(self, pose: int) -> RigidTransform:
        """Return the transform from the board to the world for one pose."""
        return RigidTransform(self.board_rotation[pose], self.board_translation[pose])

    def rig(self, names: Sequence[str], sizes: Sequence[tuple[int, int]]) -> Rig:
        """Return the cameras.

        Args:
            names: Names of the cameras.
            sizes: Width and height of their images [px].

        Raises:
            SettingProblem: A lens is not invertible in its image.
        """
        return Rig(tuple(self._camera(k, name, size) for k, (name, size) in enumerate(zip(names, sizes, strict=True))))

    def _camera(self, index: int, name: str, size: tuple[int, int]) -> Camera:
        fx, fy, cx, cy, *bending = self.lens[index]
        pose = RigidTransform(self.camera_rotation[index], self.camera_translation[index])
        distortion = np.array(bending if bending[4] else bending[:4])
        matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        return Camera(name=name, size=size, matrix=matrix, distortion=distortion, camera_from_world=pose)


def shaped_points(points: Floats, shape: Floats, centre: Floats) -> tuple[Floats, Floats]:
    """Return the corners of a board that is stretched and bent, with their derivatives.

    The stretch multiplies y, measured from the centre, by one plus its value; the surface leaves the plane by
    bend_xx x^2 + bend_xy x y + bend_yy y^2.

    Args:
        points: (n, 3) corners of the ideal board [m].
        shape: (4,) in the order of `SHAPE_NAMES`.
        centre: (3,) centre of the board [m].

    Returns:
        Points (n, 3) [m] and their derivatives (n, 3, 4).
    """
    x, y = points[:, 0] - centre[0], points[:, 1] - centre[1]
    slope = np.zeros((len(points), 3, SHAPE))
    slope[:, 1, 0] = y
    slope[:, 2, 1], slope[:, 2, 2], slope[:, 2, 3] = x * x, x * y, y * y
    return points + slope @ shape, slope
