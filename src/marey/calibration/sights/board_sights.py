"""Poses of the board before each camera from each view alone, and the relative poses of two cameras that they support.

No relative pose of cameras and no common solution is needed, so that a fault of one camera does not spread to others.
"""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Mask, freeze_fields
from marey.calibration.adjustment.start import SAME_ANGLE, SAME_SHIFT, plane_poses
from marey.calibration.boards.board import CalibrationBoard
from marey.calibration.boards.corners import CornerSet
from marey.geometry import rotations

_MOST_CANDIDATES = 40
"""Number of pictures whose relative poses are tried as that of two cameras; chosen by hand."""
_ROUNDS = 4
"""Number of times that the pictures are weighted anew for the relative pose of two cameras; chosen by hand."""
_HALF_WEIGHT = 0.3
"""Deviation at which a picture has half the weight, in those up to which relative poses agree; chosen by hand."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BoardSights:
    """The pose of the board in the axes of each camera and picture, from the corners of that view alone."""

    rotation: Floats
    """(C, F, 3, 3), NaN where it is unknown or where two poses fit."""
    centre: Floats
    """(C, F, 3) of the board [m]."""

    def __post_init__(self) -> None:
        freeze_fields(self, "rotation", "centre")

    @property
    def known(self) -> Mask:
        """(C, F) whether the pose is known."""
        return np.asarray(np.isfinite(self.centre[..., 0]))

    def at(self, camera: int, time: Floats) -> tuple[Floats, Floats]:
        """Return rotations (..., 3, 3) and centres (..., 3) between the pictures of a camera, NaN where unknown.

        Args:
            camera: The camera.
            time: (...) number of the picture, with fractions.
        """
        count = self.centre.shape[1]
        inside = (time >= 0) & (time <= count - 1)
        low = np.clip(np.floor(time).astype(int), 0, count - 1)
        share = time - low
        # A whole number needs no second picture.
        high = np.where(share > 0, np.minimum(low + 1, count - 1), low)
        first, second = self.rotation[camera, low], self.rotation[camera, high]
        unknown = ~(inside & self.known[camera, low] & self.known[camera, high])
        first = np.where(unknown[..., None, None], np.eye(3), first)
        second = np.where(unknown[..., None, None], np.eye(3), second)
        step = rotations.log(np.swapaxes(first, -1, -2) @ second)
        turn = first @ rotations.exp(share[..., None] * step)
        place = (1.0 - share[..., None]) * self.centre[camera, low] + share[..., None] * self.centre[camera, high]
        return np.where(unknown[..., None, None], np.nan, turn), np.where(unknown[..., None], np.nan, place)


def board_sights(corners: CornerSet, board: CalibrationBoard, lenses: Floats) -> BoardSights:
    """Place the board before each camera.

    Args:
        corners: The corners of all pictures.
        board: The board.
        lenses: (C, 9) approximate lenses.
    """
    shape = len(corners.cameras), len(corners.pictures)
    turn, middle = np.full((*shape, 3, 3), np.nan), np.full((*shape, 3), np.nan)
    for view, (camera, picture) in enumerate(zip(corners.view_camera, corners.view_picture, strict=True)):
        found = plane_poses(corners, board, lenses, view)
        if len(found) == 1:
            turn[camera, picture], middle[camera, picture] = found[0].rotation, found[0].apply(board.centre)
    return BoardSights(rotation=turn, centre=middle)


@dataclass(frozen=True, eq=False, kw_only=True)
class PoseReadings:
    """Relative poses of two cameras, by one or several readings of each picture."""

    rotation: Floats
    """(..., 3, 3) second camera from first camera."""
    first: Floats
    """(..., 3) centre of the board before the first camera [m]; NaN where the reading does not exist."""
    second: Floats
    """(..., 3) the same before the second camera."""

    def __post_init__(self) -> None:
        freeze_fields(self, "rotation", "first", "second")

    @staticmethod
    def between(first: tuple[Floats, Floats], second: tuple[Floats, Floats]) -> "PoseReadings":
        """Return the readings of boards (rotations and centres) before two cameras."""
        turn, _ = np.broadcast_arrays(second[0] @ np.swapaxes(first[0], -1, -2), first[0])
        a, b = np.broadcast_arrays(first[1], second[1])
        known = np.isfinite(a[..., :1]) & np.isfinite(b[..., :1])
        return PoseReadings(
            rotation=np.where(known[..., None], turn, np.nan), first=np.where(known, a, np.nan),
            second=np.where(known, b, np.nan),
        )  # fmt: skip

    @property
    def exists(self) -> Mask:
        """(...) whether both cameras show the board."""
        return np.asarray(np.isfinite(self.first[..., 0]))

    def deviations(self, rotation: Floats, translation: Floats) -> Floats:
        """Return how far readings are from relative poses, as the squares of shares of what counts as agreement.

        Args:
            rotation: (n, 3, 3) second camera from first camera.
            translation: (n, 3) [m].

        Returns:
            (n, ...) infinite where a reading does not exist.
        """
        shape = self.first.shape[:-1]
        turn = np.nan_to_num(self.rotation).reshape(-1, 9)
        a, b = np.nan_to_num(self.first).reshape(-1, 3), np.nan_to_num(self.second).reshape(-1, 3)
        angle = np.arccos(np.clip((rotation.reshape(-1, 9) @ turn.T - 1.0) / 2.0, -1.0, 1.0))
        # |R a + t - b|^2, multiplied out: one product of matrices instead of three, and no sums of large arrays.
        back = np.einsum("nij,ni->nj", rotation, translation)
        size = np.sum(np.square(translation), axis=1, keepdims=True)
        poses = np.concatenate([rotation.reshape(-1, 9), back, translation, size, np.ones_like(size)], axis=1)
        both = (b[:, :, None] * a[:, None, :]).reshape(-1, 9)
        far = np.sum(np.square(a) + np.square(b), axis=1, keepdims=True)
        apart = poses @ np.concatenate([-2.0 * both, 2.0 * a, -2.0 * b, np.ones_like(far), far], axis=1).T
        np.maximum(apart, 0.0, out=apart)
        square = np.square(angle / SAME_ANGLE)
        square += apart / np.maximum(np.square(SAME_SHIFT * np.linalg.norm(b, axis=1)), 1e-12)
        square[:, ~self.exists.ravel()] = np.inf
        return np.asarray(square.reshape(len(rotation), *shape))


def common_pose(readings: PoseReadings) -> tuple[Floats, Floats] | None:
    """Find the relative pose that explains one reading each of as many pictures as possible.

    Args:
        readings: (F, L) the L readings of each picture.

    Returns:
        Rotation (3, 3) and translation (3,) [m]; None if no picture has a reading.
    """
    pictures = np.flatnonzero(readings.exists.any(axis=1))
    if not len(pictures):
        return None
    tried = pictures[np.unique(np.linspace(0, len(pictures) - 1, min(len(pictures), _MOST_CANDIDATES)).astype(int))]
    own = readings.exists[tried]
    turn = readings.rotation[tried][own]
    shift = readings.second[tried][own] - np.einsum("nij,nj->ni", turn, readings.first[tried][own])
    cost = np.minimum(readings.deviations(turn, shift)[:, pictures].min(axis=2), 1.0).sum(axis=1)
    best = int(np.argmin(cost))
    return refined_pose(readings, turn[best], shift[best])


def refined_pose(readings: PoseReadings, turn: Floats, shift: Floats) -> tuple[Floats, Floats]:
    """Return the relative pose that fits the readings near another one best.

    Args:
        readings: (F, L) the L readings of each picture, of which the nearest one counts.
        turn: (3, 3) start value of the rotation.
        shift: (3,) start value of the translation [m].

    Returns:
        Rotation and translation.
    """
    pictures = np.flatnonzero(readings.exists.any(axis=1))
    for _ in range(_ROUNDS):
        square = readings.deviations(turn[None], shift[None])[0][pictures]
        reading = np.argmin(square, axis=1) if square.size else np.zeros(0, np.int64)
        least = square[np.arange(len(pictures)), reading]
        near = least < 1.0
        if not near.any():
            break
        at = pictures[near], reading[near]
        weight = 1.0 / (1.0 + least[near] / _HALF_WEIGHT**2)
        turn = rotations.nearest(np.einsum("n,nij->ij", weight, readings.rotation[at]))
        shift = weight @ (readings.second[at] - readings.first[at] @ turn.T) / weight.sum()
    return turn, shift
