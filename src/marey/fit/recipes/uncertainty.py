"""Uncertainty of a pose: projected into the images, and from contradictions between the cameras and with the prior."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from marey.arrays import Floats, Integers
from marey.body.articulation.pose import PosedBody, SkinPoints
from marey.body.articulation.skeleton import COLOUR_PARTS
from marey.body.articulation.surface import Body
from marey.cameras.camera import Camera
from marey.fit.recipes.sequence import SequenceFit

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


def part_displacements(before: PosedBody, after: PosedBody, cameras: Sequence[Camera]) -> Floats:
    """Return how far each part's surface moves in each image from one pose and shape of a body to another.

    Args:
        before: The body in its first pose.
        after: The same body, possibly of another shape, in its second pose.
        cameras: C cameras.

    Returns:
        (C, P) root mean square over points of the part, per axis of the image [px], comparable with `part_deviations`;
        NaN where the camera sees none or the body has no such part.
    """
    where, part = _points(after.body)
    found = np.full((len(cameras), len(COLOUR_PARTS)), np.nan)
    for c, camera in enumerate(cameras):
        change = camera.project(after.points(where)) - camera.project(before.points(where))
        squares = 0.5 * np.sum(change**2, axis=1)
        for p in range(len(COLOUR_PARTS)):
            own = squares[part == p]
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


SMOOTHED = 0.5
"""Time before and after a frame over which the covariance between the cameras is averaged [s]. With few cameras it has
few degrees of freedom in one frame. After one more round of refinement of its result, the intervals of `stealth`
without camera 4 hold 82 % without this covariance, 91 % with that of the frame itself, 92 % averaged over 0.25 s, and
93 % over 0.5 s; those of `stealth` with all cameras 96, 98, 98 and 98 %."""


def with_camera_contradictions(fit: SequenceFit, *, rate: float) -> SequenceFit:
    """Return a fit whose covariances include what the contradictions between the cameras reveal.

    The errors of silhouettes that follow a wrong colour, another person or the prior are alike at all points of an
    outline and in neighbouring frames, which the normal equations do not know. Without one camera, the poses are
    different by what its silhouettes alone support: with the changes d_c of the pose without camera c of C, the
    covariance is (C - 1) / C times the sum of d_c d_c'. It contains little where all cameras agree, and much where one
    of them decides. The changes follow from the equations of the last round of the refinement, see
    `BandedSystem.jackknife`, which costs almost no time.

    Args:
        fit: The fit of some frames.
        rate: Frame rate [Hz].

    Returns:
        The fit with the sum of both; unchanged with fewer than three cameras.
    """
    between = fit.between_cameras
    if between is None or len(between) == 0:
        return fit
    reach, first, count = round(SMOOTHED * rate), np.arange(len(between)), len(between)
    total = np.concatenate([np.zeros_like(between[:1]), np.cumsum(between, 0)])
    low, high = np.maximum(first - reach, 0), np.minimum(first + reach + 1, count)
    mean = (total[high] - total[low]) / (high - low)[:, None, None]
    covariance, degrees = np.array(fit.covariance), between.shape[1]
    covariance[:, :degrees, :degrees] += mean
    return replace(fit, covariance=covariance)


OUTLINED_BY_SHOULDERS = ("clavicle_elevation", "clavicle_protraction")
"""Coordinates that move no outline but that of a shoulder, which clothes, the arm and other people hide."""
USUAL_DEVIATION = 1.0
"""Departure from the usual value up to which such a coordinate is usual, in standard deviations of the prior.
Chosen on `office` without images of the empty room, whose intervals hold 84 % without the enlargement and 88 % with
it (`python -m bench run capture/rooms`); those of the other takes change by at most 1 %."""


def with_unusual_shoulders(fit: SequenceFit) -> SequenceFit:
    """Return a fit whose covariances include that unusual shoulders may be the work of wrong silhouettes.

    Silhouettes without images of the empty room are wrong alike at all points of a shoulder's outline, so that a few
    of them raise a clavicle by 30 degrees, with a stated standard deviation of one degree. The covariance is enlarged
    by d d', with the change d of the pose that brings coordinate k back to the range of usual postures: the excess
    times column k of the covariance, divided by its diagonal element. This change moves the other coordinates so that
    the rest of the body stays where it was observed.

    Args:
        fit: The fit of some frames.

    Returns:
        The fit with enlarged covariances; those of usual postures are unchanged.
    """
    skeleton, covariance = fit.body.skeleton, np.array(fit.covariance)
    mean, sd = skeleton.habit
    chosen = [k for k, c in enumerate(skeleton.coordinates) if c.name.endswith(OUTLINED_BY_SHOULDERS)]
    for f, pose in enumerate(fit.poses):
        excess = np.maximum(np.abs(pose.angles - mean) - USUAL_DEVIATION * sd, 0.0)
        for k in chosen:
            own = fit.covariance[f, :, 6 + k]
            if excess[k] > 0 and own[6 + k] > 0:
                change = own * (excess[k] / own[6 + k])
                covariance[f] += np.outer(change, change)
    return replace(fit, covariance=covariance)
