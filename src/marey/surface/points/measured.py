"""Measured points: places of a visible surface, with the pixels that show them and how well each is known."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields

import numpy as np

from marey.arrays import Floats, Image, Integers, Mask, freeze_fields
from marey.errors import SettingProblem


@dataclass(frozen=True, eq=False, kw_only=True)
class MeasuredPoints:
    """Points of a surface, of one frame or of many; the keys of `surface.npz`.

    Raises:
        SettingProblem: The arrays do not belong together.
    """

    frame: Integers
    """(N,) in which frame of the video each point was measured; never falling."""
    points: Floats
    """(N, 3) in the world [m]."""
    covariance: Floats
    """(N, 3, 3) [m2], from the matches' own covariance."""
    camera_names: tuple[str, ...]
    """The C cameras, in the order of the rig."""
    pixels: Floats
    """(N, C, 2) where each camera shows the point [px]; NaN where that view has no match."""
    correlation: Floats
    """(N, C) of the patch with the template's; exactly 1 in the camera whose picture is the template, less in the
    others, NaN where that view has no match."""
    residual_px: Floats
    """(N,) root mean square distance of the pixels from the point's projections [px]."""
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
            faults.append("frame falls; the points stand frame by frame")
        if faults:
            raise SettingProblem(f"Measured points do not belong together: {'; '.join(faults)}.")

    def __len__(self) -> int:
        """Count the points."""
        return len(self.frame)

    def __getitem__(self, which: slice | Mask | Integers) -> "MeasuredPoints":
        arrays = {name: getattr(self, name)[which] for name in shapes(0)}
        return MeasuredPoints(camera_names=self.camera_names, **arrays)

    def of_frame(self, frame: int) -> "MeasuredPoints":
        """Give the points of one frame; none where nothing was measured."""
        first, end = np.searchsorted(self.frame, [frame, frame + 1])
        return self[first:end]

    @property
    def frames(self) -> Integers:
        """The frames that have points, rising."""
        return np.unique(self.frame)

    @property
    def template(self) -> Integers:
        """(N,) the camera, as an index of `camera_names`, whose picture was the template."""
        return np.asarray(np.nan_to_num(self.correlation, nan=-1.0).argmax(axis=1))

    @property
    def views(self) -> Integers:
        """(N,) how many cameras show the point."""
        return np.asarray(np.count_nonzero(np.isfinite(self.correlation), axis=1))

    def arrays(self) -> dict[str, np.ndarray]:
        """Give all fields by name."""
        return {field.name: np.asarray(getattr(self, field.name)) for field in fields(self)}


def shapes(cameras: int) -> dict[str, tuple[int, ...]]:
    """Say which shape each array has behind the N points."""
    return {
        "frame": (),
        "points": (3,),
        "covariance": (3, 3),
        "pixels": (cameras, 2),
        "correlation": (cameras,),
        "residual_px": (),
        "colour": (3,),
    }


def no_points(camera_names: Sequence[str]) -> MeasuredPoints:
    """Give a surface of which nothing was measured."""
    empty: dict[str, np.ndarray] = {name: np.zeros((0, *shape)) for name, shape in shapes(len(camera_names)).items()}
    return MeasuredPoints(camera_names=tuple(camera_names), **empty)


def joined(parts: Iterable[MeasuredPoints]) -> MeasuredPoints:
    """Put surfaces of the same cameras one behind the other.

    Args:
        parts: At least one; frames must not fall from one to the next.

    Raises:
        SettingProblem: There is none, their cameras differ, or frames fall.
    """
    several = list(parts)
    if not several or any(part.camera_names != several[0].camera_names for part in several):
        raise SettingProblem("Surfaces can be joined where there is one at least, and all have the same cameras.")
    arrays = {name: np.concatenate([getattr(part, name) for part in several]) for name in shapes(0)}
    return MeasuredPoints(camera_names=several[0].camera_names, **arrays)
