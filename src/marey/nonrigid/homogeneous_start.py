"""Where the homogeneous factorisation begins: the mean shape and its rigid motion, of what can be placed at all."""

import numpy as np

from marey.arrays import Mask
from marey.errors import MareyError
from marey.nonrigid.alignment import mean_shape
from marey.nonrigid.homogeneous_model import HomogeneousModel, rigid_model
from marey.nonrigid.measured_places import MeasuredPlaces


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
    mean, rotation, translation = places.placed(*mean_shape(known, present))
    frames, kept = np.isfinite(rotation[:, 0, 0]), np.isfinite(mean[:, 0])
    if frames.sum() < 2 or kept.sum() < 3:
        raise MareyError("Fewer than two frames have three points in common that do not lie on one line.")
    inner = places.among(frames, kept)
    return rigid_model(mean[kept], rotation[frames], translation[frames], inner), frames, kept


def most_shapes(places: MeasuredPlaces) -> int:
    """Say how many basis shapes so many frames and points can tell at most."""
    frames, points = places.seen.shape
    return 1 + min(frames - 1, 3 * points - 6)
