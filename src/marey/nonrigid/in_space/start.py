"""Where the homogeneous factorisation begins: the mean shape and its rigid motion, of what can be placed at all."""

import numpy as np

from marey.arrays import Floats, Mask
from marey.errors import MareyError
from marey.nonrigid.core.alignment import mean_shape
from marey.nonrigid.in_space.measured_places import MeasuredPlaces
from marey.nonrigid.in_space.model import HomogeneousModel, rigid_model

FAR = 6.0
"""Distance from the rigid shape, in median ones, beyond which a point does not count for the start."""
LEAST_USUAL = 1e-3
"""The least median distance, as a share of the mean shape's size."""
KEPT_IN_FRAME = 4
RESTARTS = 2


def start(places: MeasuredPlaces) -> tuple[HomogeneousModel, Mask, Mask]:
    """Fit the rigid shape.

    Args:
        places: What is measured.

    Returns:
        The model of one basis shape, of the frames (F,) and points (P,) that have a pose and a place, and which those
        are.

    Raises:
        MareyError: Fewer than two frames have three points in common.
    """
    known = places.known
    present: Mask = np.asarray(np.isfinite(known).all(-1))
    if not present.any():
        raise MareyError("No point is placed in any frame.")
    mean, rotation, translation = mean_shape(known, present)
    for _ in range(RESTARTS if np.isfinite(rotation).any() else 0):
        mean, rotation, translation = mean_shape(known, _near(known, present, mean, rotation, translation))
    mean, rotation, translation = places.placed(mean, rotation, translation)
    frames, kept = np.isfinite(rotation[:, 0, 0]), np.isfinite(mean[:, 0])
    if frames.sum() < 2 or kept.sum() < 3:
        raise MareyError("Fewer than two frames have three points in common that do not lie on one line.")
    inner = places.among(frames, kept)
    return rigid_model(mean[kept], rotation[frames], translation[frames], inner), frames, kept


def _near(known: Floats, present: Mask, mean: Floats, rotation: Floats, translation: Floats) -> Mask:
    """Leave out of the start what lies far from the rigid shape, against the rest; a frame keeps enough points."""
    away = np.linalg.norm(np.einsum("fij,pj->fpi", rotation, mean) + translation[:, None] - known, axis=-1)
    usual = max(float(np.nanmedian(away)), LEAST_USUAL * float(np.sqrt(np.nanmean(mean**2))))
    near = present & (away <= FAR * usual)
    few = near.sum(1) < KEPT_IN_FRAME
    # a point that would vanish altogether stays
    return np.asarray(np.where(few[:, None] | (near.sum(0) < 2), present, near))


def most_shapes(places: MeasuredPlaces) -> int:
    """Say how many basis shapes so many frames and points can tell at most."""
    frames, points = places.seen.shape
    return 1 + min(frames - 1, 3 * points - 6)
