"""Uncertainty of a pose, projected into the images: how far the outline of each part may be from the drawn body."""

from collections.abc import Sequence

import numpy as np

from marey.arrays import Floats, Integers
from marey.body.articulation.pose import PosedBody, SkinPoints
from marey.body.articulation.skeleton import COLOUR_PARTS
from marey.body.articulation.surface import Body
from marey.cameras.camera import Camera

POINTS_PER_PART = 12
"""Number of surface points per part whose uncertainty is averaged. Chosen by hand."""


def part_deviations(posed: PosedBody, covariance: Floats, cameras: Sequence[Camera]) -> Floats:
    """Return the standard deviation of each part's surface in each image, from the covariance of the pose.

    Args:
        posed: The body in its pose.
        covariance: (D, D) of the pose, for the changes that `Pose.step` takes.
        cameras: C cameras.

    Returns:
        (C, P) root mean square over points of the part, per axis of the image [px]; NaN where the camera sees none or
        the body has no such part.
    """
    where, part = _points(posed.body)
    jacobian = posed.pose_jacobian(*posed.parts(where))
    spread = np.einsum("nid,de,nje->nij", jacobian, covariance, jacobian)
    places = posed.points(where)
    found = np.full((len(cameras), len(COLOUR_PARTS)), np.nan)
    for c, camera in enumerate(cameras):
        _, slope = camera.project_with_derivative(places)
        variance = 0.5 * np.einsum("nij,njk,nik->n", slope, spread, slope)
        for p in range(len(COLOUR_PARTS)):
            own = variance[part == p]
            own = own[np.isfinite(own)]
            if len(own):
                found[c, p] = np.sqrt(own.mean())
    return found


def _points(body: Body) -> tuple[SkinPoints, Integers]:
    """Return face centres that are evenly distributed over the list of faces of each part, and their parts."""
    faces = []
    for p in range(len(COLOUR_PARTS)):
        own = np.flatnonzero(body.face_colour_part == p)
        if len(own):
            faces.append(own[np.linspace(0, len(own) - 1, POINTS_PER_PART).astype(int)])
    chosen = np.concatenate(faces)
    weights = np.full((len(chosen), 3), 1 / 3)
    return SkinPoints(face=chosen, barycentric=weights), body.face_colour_part[chosen]
