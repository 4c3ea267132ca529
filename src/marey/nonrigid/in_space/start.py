"""Initial solution of the homogeneous factorisation: the mean shape and its rigid motion."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Mask
from marey.errors import MareyError
from marey.nonrigid.core.alignment import mean_shape
from marey.nonrigid.in_space.measured_places import MeasuredPlaces
from marey.nonrigid.in_space.model import HomogeneousModel, HomogeneousModelSettings, rigid_model

KEPT_IN_FRAME = 4
"""Least number of points that a frame keeps when some are excluded or held out, if it has as many. Chosen by hand;
results were not measured against other values."""


@dataclass(frozen=True, kw_only=True)
class RigidStartSettings:
    """Settings of the rigid initial solution; chosen by hand, results were not measured against other values."""

    far: float = 6.0
    """Points farther from the rigid shape than this times the median distance are excluded."""
    least_median: float = 1e-3
    """Least value of that median distance, as a fraction of the mean shape's size."""
    restarts: int = 2
    """Number of times that far points are excluded and the shape is fitted again."""


def rigid_start(
    places: MeasuredPlaces,
    settings: RigidStartSettings = RigidStartSettings(),
    model: HomogeneousModelSettings | None = None,
) -> tuple[HomogeneousModel, Mask, Mask]:
    """Fit one rigid shape.

    Args:
        places: Measured points.
        settings: Exclusion of far points.
        model: Settings of the returned model; the defaults if None.

    Returns:
        The model of one basis shape for the frames that have a pose and the points that have a position, and the masks
        (F,) and (P,) of these.

    Raises:
        MareyError: Fewer than two frames have three points in common.
    """
    known = places.known
    present: Mask = np.asarray(np.isfinite(known).all(-1))
    if not present.any():
        raise MareyError("No point has a known position in any frame. At least three points in two frames are needed.")
    mean, rotation, translation = mean_shape(known, present)
    for _ in range(settings.restarts if np.isfinite(rotation).any() else 0):
        near = _near(known, present, mean, rotation, translation, settings)
        mean, rotation, translation = mean_shape(known, near)
    mean, rotation, translation = places.placed(mean, rotation, translation)
    frames, kept = np.isfinite(rotation[:, 0, 0]), np.isfinite(mean[:, 0])
    if frames.sum() < 2 or kept.sum() < 3:
        raise MareyError("Fewer than two frames have three points in common that do not lie on one line.")
    inner = places.among(frames, kept)
    settings_of_model = model or HomogeneousModelSettings()
    rigid = rigid_model(mean[kept], rotation[frames], translation[frames], inner, settings_of_model)
    return rigid, frames, kept


def _near(
    known: Floats,
    present: Mask,
    mean: Floats,
    rotation: Floats,
    translation: Floats,
    settings: RigidStartSettings,
) -> Mask:
    """Exclude points that are far from the rigid shape, unless a frame or a point would keep too little."""
    away = np.linalg.norm(np.einsum("fij,pj->fpi", rotation, mean) + translation[:, None] - known, axis=-1)
    usual = max(float(np.nanmedian(away)), settings.least_median * float(np.sqrt(np.nanmean(mean**2))))
    near = present & (away <= settings.far * usual)
    few = near.sum(1) < KEPT_IN_FRAME
    # a point that would be excluded in nearly all frames is kept
    return np.asarray(np.where(few[:, None] | (near.sum(0) < 2), present, near))


def most_shapes(places: MeasuredPlaces) -> int:
    """Compute the largest number of basis shapes that the numbers of frames and points determine."""
    frames, points = places.seen.shape
    return int(1 + min(frames - 1, 3 * points - 6))
