"""Measured points of a visible surface, with their pixels and covariances."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Image, Integers, Mask, fields_of, freeze_fields
from marey.errors import SettingProblem


@dataclass(frozen=True, eq=False, kw_only=True)
class MeasuredPoints:
    """Points of a surface in one or several frames; the fields are the keys of `surface.npz`.

    Raises:
        SettingProblem: The arrays are inconsistent.
    """

    frame: Integers
    """(N,) frame of the video in which each point was measured, in ascending order."""
    points: Floats
    """(N, 3) in the world [m]."""
    covariance: Floats
    """(N, 3, 3) covariance from those of the matches [m2]."""
    camera_names: tuple[str, ...]
    """The C cameras, in the order of the rig."""
    pixels: Floats
    """(N, C, 2) pixel of the point in each camera [px]; NaN in views without a match."""
    correlation: Floats
    """(N, C) correlation with the template: exactly 1 in the camera whose image is the template, less in the others,
    NaN in views without a match."""
    residual_px: Floats
    """(N,) root mean square distance of the pixels from the projections of the point [px]."""
    colour: Image
    """(N, 3) red, green, blue of the template's pixel."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "camera_names", tuple(map(str, self.camera_names)))
        freeze_fields(self, "frame", dtype=np.int64)
        freeze_fields(self, "colour", dtype=np.uint8)
        freeze_fields(self, "points", "covariance", "pixels", "correlation", "residual_px")
        count, cameras = len(self.frame), len(self.camera_names)
        faults = [
            f"{name} has the shape {getattr(self, name).shape} instead of {(count, *shape)}"
            for name, shape in shapes(cameras).items()
            if getattr(self, name).shape != (count, *shape)
        ]
        if not faults and np.any(np.diff(self.frame) < 0):
            faults.append("the values of frame decrease; the points must be in the order of their frames")
        if faults:
            raise SettingProblem(f"The arrays of measured points are inconsistent: {'; '.join(faults)}.")

    def __len__(self) -> int:
        """Count the points."""
        return len(self.frame)

    def __getitem__(self, which: slice | Mask | Integers) -> "MeasuredPoints":
        arrays = {name: getattr(self, name)[which] for name in shapes(0)}
        return MeasuredPoints(camera_names=self.camera_names, **arrays)

    def of_frame(self, frame: int) -> "MeasuredPoints":
        """Return the points of one frame; none if nothing was measured."""
        first, end = np.searchsorted(self.frame, [frame, frame + 1])
        return self[first:end]

    @property
    def frames(self) -> Integers:
        """The frames with points, in ascending order."""
        return np.unique(self.frame)

    @property
    def template(self) -> Integers:
        """(N,) index in `camera_names` of the camera whose image was the template."""
        return np.asarray(np.nan_to_num(self.correlation, nan=-1.0).argmax(axis=1))

    @property
    def views(self) -> Integers:
        """(N,) number of cameras that see the point."""
        return np.asarray(np.count_nonzero(np.isfinite(self.correlation), axis=1))

    def arrays(self) -> dict[str, np.ndarray]:
        """Return all fields by name."""
        return fields_of(self)


def shapes(cameras: int) -> dict[str, tuple[int, ...]]:
    """Return the shape of each array after its first dimension, the N points."""
    return {
        "frame": (),
        "points": (3,),
        "covariance": (3, 3),
        "pixels": (cameras, 2),
        "correlation": (cameras,),
        "residual_px": (),
        "colour": (3,),
    }


def joined(parts: Iterable[MeasuredPoints]) -> MeasuredPoints:
    """Concatenate surfaces of the same cameras.

    Args:
        parts: At least one surface; frames must not decrease from one to the next.

    Returns:
        The joined surface.

    Raises:
        SettingProblem: There is no surface, their cameras differ, or frames decrease.
    """
    several = list(parts)
    if not several or any(part.camera_names != several[0].camera_names for part in several):
        raise SettingProblem("Only surfaces of the same cameras can be joined, and at least one is required.")
    arrays = {name: np.concatenate([getattr(part, name) for part in several]) for name in shapes(0)}
    return MeasuredPoints(camera_names=several[0].camera_names, **arrays)
