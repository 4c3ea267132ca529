"""Pictures, or their rows, that were taken a part of a frame before or after their frame."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Floats, freeze_fields
from marey.body.articulation.pose import Pose, PosedBody
from marey.cameras.camera import Camera
from marey.cameras.shutter import Side, row_shares

ROW_ROUNDS = 3
"""Number of times that the row of each vertex is determined. Each one reduces the error by the ratio of the vertex'
speed in the image to that of the shutter, which is 1 to 30 for a hand at 5 m/s, 3 m in front of a camera of 1000 px
that needs 20 ms for 1000 rows."""


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
class RolledBody(PosedBody):
    """A body as a rolling shutter shows it: each vertex at the instant of the row in which it is seen.

    The pose is that at the instant of the middle row.
    """

    rolled: Floats
    """(V, 3) the skin [m, world]."""

    @property
    def vertices(self) -> Floats:
        """(V, 3) the skin [m, world]."""
        return self.rolled


@dataclass(frozen=True, eq=False)
class PictureMotion:
    """The known motion of a body from its frame until a camera exposes its picture."""

    change: Floats
    """(D,) change of the pose until the instant of the picture, which is that of its middle row."""
    ends: tuple[Floats, Floats] | None = None
    """The same (D,) until the instants of the first and of the last row; None for a global shutter."""
    camera: Camera | None = None
    """The camera, if its shutter is a rolling one."""
    side: Side = "top"
    """The side of the picture that is exposed first."""

    def after(self, posed: PosedBody) -> PosedBody:
        """Return a body after this motion; the given one if there is none."""
        late = replace(posed, pose=posed.pose.step(self.change)) if self.change.any() else posed
        if self.ends is None or self.camera is None:
            return late
        first, last = (replace(posed, pose=posed.pose.step(change)).vertices for change in self.ends)
        rolled = late.vertices
        for _ in range(ROW_ROUNDS):
            share = row_shares(self.side, self.camera.project(rolled), self.camera.size)
            # Vertices outside the picture and behind the camera are not seen.
            share = np.clip(np.nan_to_num(share), -0.5, 0.5)[:, None]
            bend = first + last - 2 * late.vertices
            rolled = late.vertices + share * (last - first) + 2 * share**2 * bend
        return RolledBody(posed.body, late.pose, np.ascontiguousarray(rolled))


@dataclass(frozen=True, eq=False, kw_only=True)
class PictureRows:
    """The rolling shutters of the cameras of a take."""

    cameras: tuple[Camera, ...]
    """C cameras, of images of any size."""
    readout: Floats
    """(C,) time from the first row to the last one [frames]; 0 for a global shutter."""
    sides: tuple[Side, ...]
    """The side of each camera's picture that is exposed first."""

    def __post_init__(self) -> None:
        freeze_fields(self, "readout")


@dataclass(frozen=True, eq=False)
class PictureTimes:
    """How long after each frame each camera has taken its picture of it.

    An observation of a late picture is predicted by the body in the pose that it has then, or of a rolling shutter at
    the instant of its row. It is stated as one of the frame itself: what is measured is changed by what the advance of
    the pose changes in the prediction. Its residual is thus that of the advanced pose, while its derivatives are taken
    in the frame's pose.
    """

    late: Floats
    """(C, F) [frames]."""
    rows: PictureRows | None = None
    """Rolling shutters; None if all rows of a picture are of one instant."""

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
        return [motion.after(posed) for motion in self._motions(frame, poses)]

    def known_motions(self, poses: Mapping[int, Pose]) -> dict[int, list[PictureMotion]]:
        """Return for each frame of a motion that of its body until each camera's picture."""
        return {frame: self._motions(frame, poses) for frame in poses}

    def of_pixels(self, camera: int, pixels: Floats) -> Floats:
        """Return how long after their frames the pixels of a camera were exposed.

        Args:
            camera: Number of the camera.
            pixels: (F, J, 2) of the first F frames, in its full image [px].

        Returns:
            (F, J) [frames].
        """
        late = np.repeat(self.late[camera, : len(pixels), None], pixels.shape[1], axis=1)
        if self.rows is None:
            return late
        size, side = self.rows.cameras[camera].size, self.rows.sides[camera]
        return np.asarray(late + self.rows.readout[camera] * row_shares(side, pixels, size))

    def _motions(self, frame: int, poses: Mapping[int, Pose]) -> list[PictureMotion]:
        pose, late = poses[frame], self.late[:, frame]
        half = np.zeros(len(late)) if self.rows is None else 0.5 * self.rows.readout
        instants = np.stack([late, late - half, late + half], axis=1)
        advanced = advanced_poses(poses, frame, instants.ravel().tolist())
        changes = [pose.change_to(other) if other is not pose else _still(pose) for other in advanced]
        motions = []
        for c, (middle, first, last) in enumerate(zip(changes[::3], changes[1::3], changes[2::3], strict=True)):
            if self.rows is None or not half[c]:
                motions.append(PictureMotion(middle))
            else:
                motions.append(PictureMotion(middle, (first, last), self.rows.cameras[c], self.rows.sides[c]))
        return motions


def _still(pose: Pose) -> Floats:
    return np.zeros(len(pose.angles) + 6)
