"""Start from joint centres that were clicked or detected, used as observations besides the silhouettes."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from marey.arrays import Floats
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.skeleton import JOINT_OF_SEGMENT
from marey.body.articulation.surface import Body
from marey.cameras.camera import Camera
from marey.cameras.triangulate import triangulate
from marey.errors import MareyError
from marey.fit.recipes.person import PersonSettings, SilhouetteTake
from marey.fit.search.levels import SilhouetteLevel, level_factor
from marey.fit.search.search import Candidate, Search
from marey.fit.solver.body_solver import dense_equations, fit_body
from marey.fit.solver.pose_solver import Schedule, solve_step
from marey.geometry import rotations
from marey.observations.joint_point import JointPoints
from marey.observations.observation import Observation
from marey.observations.prior import Habit, JointLimits, ShapePrior

SIGMA_SHARE = 0.03
"""Standard deviation of a clicked joint centre, as a share of the person's height in the image. Chosen by hand."""
CLICKED_SD_M = 0.01
"""Standard deviation of a clicked joint from the joint's centre in space, per axis [m].

Chosen by hand. In the clicked frame of `arm3` shoulder, elbow and wrist were 9, 7 and 7 mm off with the clicks observed
at this value, and 9, 10 and 14 mm without them; other values were not measured, and the script was not kept.
"""
START_YAWS = 12
"""Headings, evenly spaced, from which the fit to the joints starts. Chosen by hand; others were not measured."""
JOINT_FIT_STEPS = 40
"""Gauss-Newton steps from each heading. Chosen by hand; other values were not measured."""


def start_from_joints(
    take: SilhouetteTake, frame: int, joint_names: Sequence[str], pixels: Floats, body: Body, settings: PersonSettings
) -> tuple[int, Candidate]:
    """Estimate the pose and rough shape in the frame whose joints are given.

    Args:
        take: Cameras and silhouettes; a frame without silhouettes starts from its joints alone.
        frame: Number of the frame.
        joint_names: (J,) names of joint centres as in results.
        pixels: (C, J, 2) in the order of the take's cameras, NaN where a joint is not given [px].
        body: Body at its prior's mean.
        settings: Settings of the capture.

    Returns:
        The frame and its candidate.

    Raises:
        MareyError: Fewer than three joints are given in two cameras each, or no posture fits them.
    """
    masks = take.masks_of(frame)
    height = max([np.count_nonzero(mask.any(1)) for mask in masks] + [100])
    points = _joint_points(take, joint_names, pixels, body, SIGMA_SHARE * height)
    priors: list[Observation] = [JointLimits(), Habit(share=0.1), ShapePrior()]
    posed = _from_points(body, _known_centre(take, pixels), [*points, *priors])
    level = SilhouetteLevel.of(take.cameras, masks, level_factor(masks, settings.track_height))
    small = _joint_points(
        replace(take, cameras=level.cameras), joint_names, _scaled(pixels, take, level), body,
        SIGMA_SHARE * settings.track_height,
    )  # fmt: skip
    schedule = Schedule(iterations=12, gate=(25.0, 5.0), scale=(10.0, 3.0))
    fitted = fit_body(posed, level.sightings, [*small, *priors], schedule=schedule)
    return frame, Search(level, settings.start).judge(fitted)


def clicked_joints(
    cameras: Sequence[Camera], joint_names: Sequence[str], pixels: Floats, posed: PosedBody
) -> list[JointPoints]:
    """Return clicked joints as observations with the uncertainty of a click in space (`CLICKED_SD_M`).

    Args:
        cameras: (C,).
        joint_names: (J,) names of joint centres as in results.
        pixels: (C, J, 2), NaN where a joint is not given [px].
        posed: Body in its approximate pose, which gives the distance from each camera.
    """
    found = []
    for camera, own in zip(cameras, pixels, strict=True):
        away = np.linalg.norm(posed.segment_origin.mean(0) - camera.centre)
        sigma = CLICKED_SD_M * camera.matrix[0, 0] / away
        found += _joint_points_of([camera], joint_names, own[None], posed.body, float(sigma))
    return found


def _joint_points(
    take: SilhouetteTake, joint_names: Sequence[str], pixels: Floats, body: Body, sigma: float
) -> list[JointPoints]:
    return _joint_points_of(take.cameras, joint_names, pixels, body, sigma)


def _joint_points_of(
    cameras: Sequence[Camera], joint_names: Sequence[str], pixels: Floats, body: Body, sigma: float
) -> list[JointPoints]:
    segment_of = {joint: segment for segment, joint in JOINT_OF_SEGMENT.items()}
    segments = np.array([body.skeleton.segment(segment_of[name]) for name in joint_names])
    found = []
    for camera, own in zip(cameras, pixels, strict=True):
        given = np.isfinite(own[:, 0])
        if given.any():
            found.append(JointPoints(camera=camera, segments=segments[given], pixels=own[given], sigma_px=sigma))
    return found


def _scaled(pixels: Floats, take: SilhouetteTake, level: SilhouetteLevel) -> Floats:
    """Convert pixels (C, J, 2) to the scaled images, whose pixel centres have integer coordinates too."""
    factors = [small.width / large.width for small, large in zip(level.cameras, take.cameras, strict=True)]
    factor = np.array(factors)[:, None, None]
    return np.asarray((pixels + 0.5) * factor - 0.5)


def _known_centre(take: SilhouetteTake, pixels: Floats) -> Floats:
    """Return the mean position (3,) of the joints that are given in two cameras [m]."""
    twice = np.isfinite(pixels[:, :, 0]).sum(0) >= 2
    if twice.sum() < 3:
        raise MareyError("The start needs at least three joints that are given in two cameras each.")
    points = triangulate(take.cameras, pixels[:, twice], sigma_px=1.0).points
    return np.asarray(np.nanmean(points, axis=0))


def _from_points(body: Body, centre: Floats, observations: Sequence[Observation]) -> PosedBody:
    """Fit pose and shape to the joints alone from several headings, and return the result of least cost."""
    best, least = None, np.inf
    rest = body.joint_centres.mean(0)
    for yaw in np.arange(START_YAWS) * 2 * np.pi / START_YAWS:
        turn = rotations.about(np.array([0.0, 0.0, 1.0]), yaw)
        posed = PosedBody(body, Pose(centre - turn @ rest, turn, np.zeros(len(body.skeleton) - 6)))
        cost = np.inf
        for _ in range(JOINT_FIT_STEPS):
            hessian, gradient, cost = dense_equations(posed, [], [], observations)
            posed = posed.moved(solve_step(hessian, gradient, degrees=len(body.skeleton)))
        if cost < least:
            best, least = posed, cost
    if best is None:
        raise MareyError("No posture of the body fits the given joints. Check their names and cameras.")
    return best
