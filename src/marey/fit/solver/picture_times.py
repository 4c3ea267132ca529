"""Pictures that were taken a part of a frame before or after their frame, by cameras with clocks of their own."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Floats, freeze_fields
from marey.body.articulation.pose import Pose, PosedBody


def advanced_poses(poses: Mapping[int, Pose], frame: int, late: Sequence[float]) -> list[Pose]:
    """Return poses a part of a frame after a frame, from a parabola through it and its two neighbours.

    With polynomials of the fourth and sixth order, through two and three neighbours on each side, the joints of `walk`
    in true silhouettes of 15 Hz, seen by two pairs of cameras half a frame apart, were 7.6 and 7.7 instead of 7.5 mm
    off.

    Args:
        poses: Poses by frame.
        frame: The frame.
        late: Times after the frame, negative before it [frames].

    Returns:
        The poses; that of the frame itself for a time of 0. With one neighbour only, the motion is uniform, and without
        any there is none.
    """
    pose = poses[frame]
    back, ahead = (None if f not in poses else pose.change_to(poses[f]) for f in (frame - 1, frame + 1))
    if back is None or ahead is None:
        step = ahead if ahead is not None else np.zeros(len(pose.angles) + 6) if back is None else -back
        back, ahead = -step, step
    return [pose.step(0.5 * at * (ahead - back) + 0.5 * at**2 * (ahead + back)) if at else pose for at in late]


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

    def known_motions(self, poses: Mapping[int, Pose]) -> dict[int, list[Floats]]:
        """Return for each frame of a motion the changes (D,) of its pose until each camera's picture."""
        return {
            frame: [pose.change_to(other) for other in advanced_poses(poses, frame, self.late[:, frame].tolist())]
            for frame, pose in poses.items()
        }


def after_motion(posed: PosedBody, motion: Floats) -> PosedBody:
    """Return a body after a change (D,) of its pose; the given one if there is none."""
    return replace(posed, pose=posed.pose.step(motion)) if motion.any() else posed
