"""Start of the fit of a shape, from a person captured from silhouettes or from clicked joints."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from marey.arrays import Floats, Integers
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.surface import Body
from marey.fit.points.carry import CarrySettings, follow_points, pose_on_surface
from marey.fit.points.levenberg import fit_points
from marey.fit.points.shape import ShapeEstimate, ShapeSettings, metaballs_like, with_coordinates, with_free_trunk
from marey.fit.points.surface_points import FramePoints, PersonPoints, thinned_evenly
from marey.fit.progress import FrameProgress, no_progress
from marey.observations.observation import Observation


def start_from_person(body: Body, poses: Mapping[int, Pose], settings: ShapeSettings) -> ShapeEstimate:
    """Convert a captured person's shape and motion to metaballs, with the trunk free to rotate."""
    whole = with_free_trunk(body)
    turned = {f: with_coordinates(pose, body, whole) for f, pose in poses.items()}
    return ShapeEstimate(
        metaballs_like(whole, settings=settings), turned, settings.begin_model_sd_m, settings.sequence.sigma_px
    )


def start_from_clicked_joints(
    posed: PosedBody, clicked: Mapping[int, Sequence[Observation]], points: Mapping[int, FramePoints],
    settings: ShapeSettings,
) -> ShapeEstimate:  # fmt: skip
    """Fit all metaballs to points and clicked joints of one frame.

    The damped steps of `fit_points` converge from larger errors of one frame's pose and shape than those of the
    sequence's system, which refines estimates that are nearly in place. Unlike [Plaenkers1999] section 4.4, whose
    simplified limbs come first, these are the learned person's numbers: seen from one side, limbs of free width slide
    along themselves (docs/accuracy/rejected.md).

    Args:
        posed: Learned body in the pose of the clicked joints.
        clicked: The joints, by their one frame.
        points: Measured points, by frame.
        settings: Settings of the shape.
    """
    (frame, joints), whole = next(iter(clicked.items())), with_free_trunk(posed.body)
    pose = with_coordinates(posed.pose, posed.body, whole)
    few = thinned_evenly(points[frame], settings.points_a_frame)
    one = PersonPoints(by_frame={frame: few}, scale_m=settings.first_scale_m)
    first = fit_points(one, metaballs_like(whole, settings=settings), {frame: pose}, others=joints)
    return ShapeEstimate(first.body, first.poses, settings.begin_model_sd_m, settings.sequence.sigma_px)


def extend_by_trajectories(
    begun: ShapeEstimate, frames: Integers, position: Floats, points: Mapping[int, FramePoints],
    settings: ShapeSettings, *, progress: FrameProgress = no_progress,
) -> ShapeEstimate:  # fmt: skip
    """Track a body from its one frame by trajectories, aligned with the measured points every few frames.

    Args:
        begun: Estimate with the pose of one frame.
        frames: (F,) of the trajectories, ascending.
        position: (F, N, 3) in the world [m], NaN where not measured.
        points: Measured points, by frame; poses of other frames are dropped.
        settings: Settings of the shape.
        progress: Called with each frame.
    """
    carry, body = CarrySettings(), begun.body
    few = {f: thinned_evenly(given, settings.points_a_frame) for f, given in points.items()}
    given = PersonPoints(by_frame=few, scale_m=settings.first_scale_m)
    poses = follow_points(
        body, next(iter(begun.poses.items())), [int(f) for f in frames], np.asarray(position, float), settings=carry,
        anchor=lambda frame, pose: pose_on_surface(PosedBody(body, pose), given, frame, carry), progress=progress,
    )  # fmt: skip
    return replace(begun, poses={f: pose for f, pose in poses.items() if f in points})
