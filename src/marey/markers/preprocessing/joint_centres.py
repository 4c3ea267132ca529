"""Joint centres from skin markers and measurements: the hip by regression, knee and ankle by the chord function."""

import numpy as np

from marey.arrays import Floats
from marey.errors import MareyError

_COEFFICIENTS = np.array([[-0.24, 0.0, 0.28], [0.0, -0.16, 0.16], [0.0, -0.04, 0.0]])
"""Coefficients of pelvis depth, pelvis width and leg length for x, y, z of the right hip ([Harrington2007])."""
_OFFSET_M = np.array([-9.9e-3, -7.1e-3, 7.9e-3])
"""Constant of the regression for x, y, z of the right hip [m] ([Harrington2007])."""


def harrington_hip_centre(depth_m: float, width_m: float, leg_length_m: float, *, left: bool) -> Floats:
    """Predict the centre of a hip in the frame of the pelvis by the regression of [Harrington2007].

    The coefficients of the regression on all three measurements; they were checked against their implementation in
    pyCGM2 (`harringtonRegression`, predictors `full`).

    Args:
        depth_m: Depth of the pelvis, from the middle of the anterior spines to that of the posterior ones [m].
        width_m: Width of the pelvis, between the anterior spines [m].
        leg_length_m: Length of the leg, from the anterior spine to the malleolus [m].
        left: Whether it is the left hip.

    Returns:
        (3,) the centre relative to the middle of the anterior spines [m]: x anterior, y up, z to the right.
    """
    right = np.array([depth_m, width_m, leg_length_m]) @ _COEFFICIENTS + _OFFSET_M
    return np.asarray(right * np.array([1.0, 1.0, -1.0]) if left else right)


def chord_centre(proximal: Floats, lateral: Floats, plane: Floats, distance_m: float) -> Floats:
    """Find a joint's centre from a lateral marker by the chord function of [Davis1991].

    The centre lies in the plane of the proximal centre, the lateral marker and a third marker; it has the given
    distance from the lateral marker, and the lines from it to that marker and to the proximal centre are perpendicular.
    Of the two such points it is the one on the other side than the third marker, which is lateral as well.

    Args:
        proximal: (..., 3) centre of the proximal joint [m].
        lateral: (..., 3) lateral marker of the joint [m].
        plane: (..., 3) marker on the lateral side of the proximal segment [m].
        distance_m: Distance of the lateral marker from the centre: half the width of the joint and half the diameter of
            the marker [m].

    Returns:
        (..., 3) the centre [m].

    Raises:
        MareyError: The lateral marker is nearer to the proximal centre than the distance, or the three are in a line.
    """
    upward, length = _unit(proximal - lateral)
    outward = plane - lateral
    outward = outward - upward * (outward * upward).sum(-1, keepdims=True)
    aside, off_line = _unit(outward)
    if (length <= distance_m).any() or (off_line < 1e-6).any():
        raise MareyError("The markers of the joint do not form a triangle of which the centre could be a corner.")
    along = distance_m / length
    return np.asarray(lateral + distance_m * (along * upward - np.sqrt(1 - along**2) * aside))


def _unit(vectors: Floats) -> tuple[Floats, Floats]:
    """Return vectors (..., 3) of length one, and their lengths (..., 1)."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.where(length > 0, length, 1.0)), np.asarray(length)
