"""Pictures that were taken a part of a frame before or after their frame, by cameras with clocks of their own."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Floats, freeze_fields
from marey.body.articulation.pose import Pose, PosedBody

REACH_FRAMES = 2
"""Neighbours on each side from which a pose between two frames is interpolated. With one on each side, the joints of
`walk`, filmed at 15 Hz by cameras half a frame apart, are INTERPOLATION_LOSS."""


def advanced_poses(poses: Mapping[int, Pose], frame: int, late: Sequence[float]) -> list[Pose]:
    """Return poses a part of a frame after a frame, from a polynomial through it and its neighbours.

    It is of the fourth order with two neighbours on each side, and of the second order with one. With neighbours on
    one side only the motion is uniform, and without any there is none.

    Args:
        poses: Poses by frame.
        frame: The frame.
        late: Times after the frame, negative before it [frames].

    Returns:
        The poses; that of the frame itself for a time of 0.
    """
    pose = poses[frame]
    around = _neighbours(poses, frame)
    changes = [pose.change_to(poses[frame + step]) for step in around]
    return [
        pose.step(np.array([_weight(at, step, around) for step in around]) @ changes) if at and around else pose
        for at in late
    ]


def _neighbours(poses: Mapping[int, Pose], frame: int) -> list[int]:
    """Return the steps to the frames through whose poses the motion is interpolated, without the frame itself."""
    reach = 0
    while reach < REACH_FRAMES and all(frame + sign * (reach + 1) in poses for sign in (-1, 1)):
        reach += 1
    return [step for step in range(-reach, reach + 1) if step] if reach else [s for s in (-1, 1) if frame + s in poses]


def _weight(at: float, step: int, around: Sequence[int]) -> float:
    """Return the weight of a neighbour in Lagrange's polynomial, which is zero at the frame itself."""
    others = [other for other in around if other != step]
    return at / step * float(np.prod([(at - other) / (step - other) for other in others]))


@dataclass(frozen=True, eq=False)
class PictureTimes:
    """How long after each frame each camera has taken its picture of it.

    An observation of a late picture is predicted by the body in the pose that it has then. It is stated as one of the
    frame itself: what is measured is changed by what the advance of the pose changes in the prediction. Its residual
    is thus that of the advanced pose, while its derivatives are taken in the frame's pose.
    """

    late: Floats
    """(C, F) [frames]."""

    def __post_init__(self) -> None:
        freeze_fields(self, "late")

    def posed(self, frame: int, posed: PosedBody, poses: Mapping[int, Pose]) -> list[PosedBody]:
        """Return the body in the pose of each camera's picture.

        Args:
            frame: The frame.
            posed: The body in the frame's pose.
            poses: Poses by frame.

        Returns:
            The C posed bodies; the given one itself for pictures of the frame's instant.
        """
        advanced = advanced_poses(poses, frame, self.late[:, frame].tolist())
        return [posed if pose is poses[frame] else replace(posed, pose=pose) for pose in advanced]

    def motions(self, frame: int, velocity: Floats) -> list[Floats]:
        """Return the changes (D,) of a pose from a frame until each camera's picture, for a change per frame (D,)."""
        return [late * velocity for late in self.late[:, frame]]

    def without(self, camera: int) -> "PictureTimes":
        """Return the times of the other cameras."""
        return PictureTimes(np.delete(self.late, camera, axis=0))
