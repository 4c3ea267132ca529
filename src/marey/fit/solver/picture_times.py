"""Pictures that were taken a part of a frame before or after their frame, by cameras with clocks of their own."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Floats, freeze_fields
from marey.body.articulation.pose import Pose, PosedBody


def advanced_pose(poses: Mapping[int, Pose], frame: int, late: float) -> Pose:
    """Return the pose a part of a frame after a frame, from a parabola through it and its two neighbours.

    Args:
        poses: Poses by frame.
        frame: The frame.
        late: Time after the frame, negative before it [frames].

    Returns:
        The pose; with one neighbour only, the motion is uniform, and without any there is none.
    """
    pose = poses[frame]
    back, ahead = (None if f not in poses else pose.change_to(poses[f]) for f in (frame - 1, frame + 1))
    if back is not None and ahead is not None:
        return pose.step(0.5 * late * (ahead - back) + 0.5 * late**2 * (ahead + back))
    if ahead is not None:
        return pose.step(late * ahead)
    return pose if back is None else pose.step(-late * back)


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
        return [
            posed if late == 0.0 else replace(posed, pose=advanced_pose(poses, frame, float(late)))
            for late in self.late[:, frame]
        ]

    def without(self, camera: int) -> "PictureTimes":
        """Return the times of the other cameras."""
        return PictureTimes(np.delete(self.late, camera, axis=0))
