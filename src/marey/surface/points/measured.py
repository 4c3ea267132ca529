"""Measured points of a visible surface, with their pixels and covariances."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from marey.arrays import Floats, Image, Integers, Mask, fields_of, freeze_fields
from marey.cameras.camera import Camera
from marey.errors import SettingProblem

SAME_PLACE_SPACINGS = 0.75
"""Distance in a template's image within which a point of another template shows the same place, in spacings of the
points: nodes of two grids over one surface are at most 0.71 spacings apart. Derived, not tuned."""
SAME_DEPTH_SDS = 5.0
"""Largest difference of the depths of two measurements of one place, in standard deviations of the difference. Chosen
by hand."""
SAME_DEPTH_SPACINGS = 3.0
"""Least value of that difference, in spacings of the points: the two places lie beside each other on a surface that
may be oblique. Chosen by hand."""


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


def without_repeats(points: MeasuredPoints, cameras: Sequence[Camera], *, spacing: float) -> MeasuredPoints:
    """Keep one of the points that several templates have measured at the same place of one instant's surface.

    Templates are added one after the other. Where a point of a template lies beside one that is already there, seen
    from the new template's camera, the one with the larger variance is removed.

    Args:
        points: Points of one frame.
        cameras: C cameras.
        spacing: Distance of neighbouring points of one template [px].

    Returns:
        The remaining points, in their order.
    """
    template = points.template
    kept = np.zeros(len(points), bool)
    variance = np.trace(points.covariance, axis1=1, axis2=2)
    for view in np.unique(template):
        own, others = np.flatnonzero(template == view), np.flatnonzero(kept)
        kept[own] = True
        if not len(others):
            continue
        near = _same_places(points, cameras[view], own, others, spacing)
        pair = np.flatnonzero(near >= 0)
        mine, theirs = own[pair], others[near[pair]]
        better = variance[mine] < variance[theirs]
        kept[mine[~better]] = False
        kept[theirs[better]] = False
    return points[kept]


def _same_places(points: MeasuredPoints, camera: Camera, own: Integers, others: Integers, spacing: float) -> Integers:
    """Return for each own point (n,) the index in `others` of the point at the same place; -1 without one."""
    there = points.points[others]
    pixels = camera.project(there)
    near = np.full(len(own), -1)
    known = np.flatnonzero(np.isfinite(pixels).all(axis=1))
    if not len(known):
        return near
    away, which = cKDTree(pixels[known]).query(camera.project(points.points[own]))
    index = known[which]
    ray = points.points[own] - camera.centre
    distance = np.linalg.norm(ray, axis=1)
    ray = ray / distance[:, None]
    behind = np.abs(np.einsum("na,na->n", ray, there[index] - points.points[own]))
    both = points.covariance[own] + points.covariance[others[index]]
    allowed = np.maximum(
        SAME_DEPTH_SDS * np.sqrt(np.einsum("na,nab,nb->n", ray, both, ray)),
        SAME_DEPTH_SPACINGS * spacing * distance / camera.matrix[0, 0],
    )  # fmt: skip
    same = (away <= SAME_PLACE_SPACINGS * spacing) & (behind <= allowed)
    near[same] = index[same]
    return near
