"""Where the fit of a shape begins: from a person that silhouettes showed, or from joints that somebody clicked."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from marey.arrays import Floats, Integers
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.surface import Body
from marey.fit.points.carry import CarrySettings, follow_points, settled
from marey.fit.points.levenberg import fit_points
from marey.fit.points.shape import Shaped, ShapeSettings, freed, metaballs_like, with_coordinates
from marey.fit.points.surface_points import FramePoints, PersonPoints, spread_over
from marey.observations.observation import Observation

FIRST_SCALE_M = 0.05
"""Distance at which a point counts a quarter while the pose comes from clicked joints [m]."""


def begun_from_person(body: Body, poses: Mapping[int, Pose], settings: ShapeSettings) -> Shaped:
    """Let metaballs take over a person's shape and motion; the trunk may turn from here on."""
    whole = freed(body)
    turned = {f: with_coordinates(pose, body, whole) for f, pose in poses.items()}
    return Shaped(metaballs_like(whole), turned, settings.begin_model_sd_m, settings.sequence.sigma_px)


def begun_from_clicks(
    posed: PosedBody, clicked: Mapping[int, Sequence[Observation]], points: Mapping[int, FramePoints],
    settings: ShapeSettings,
) -> Shaped:  # fmt: skip
    """Fit all metaballs to points and clicked joints of one frame.

    One frame's pose and shape come right from farther off by the damped steps of `fit_points` than by those of the
    sequence's system, which refines what is nearly in place. Unlike [Plaenkers1999] section 4.4, whose simplified limbs
    come first, these are the learned person's numbers: seen from one side, limbs of free width slide along
    themselves (docs/accuracy.md).

    Args:
        posed: a learned body in the pose that the clicked joints tell.
        clicked: the joints, by their one frame.
        points: measured, by frame.
        settings: of the shape.
    """
    (frame, joints), whole = next(iter(clicked.items())), freed(posed.body)
    pose = with_coordinates(posed.pose, posed.body, whole)
    one = PersonPoints(by_frame={frame: spread_over(points[frame], settings.points_a_frame)}, scale_m=FIRST_SCALE_M)
    first = fit_points(one, metaballs_like(whole), {frame: pose}, others=joints)
    return Shaped(first.body, first.poses, settings.begin_model_sd_m, settings.sequence.sigma_px)


def carried_on(
    begun: Shaped, frames: Integers, position: Floats, points: Mapping[int, FramePoints], settings: ShapeSettings,
    *, done: Callable[[int], None] = lambda frame: None,
) -> Shaped:  # fmt: skip
    """Follow a body from its one frame by trajectories, brought onto the measured points every some frames.

    Args:
        begun: with the pose of one frame.
        frames: (F,) of the trajectories, rising.
        position: (F, N, 3) in the world [m], NaN where not measured.
        points: measured, by frame: poses of other frames are not kept.
        settings: of the shape.
        done: told of every frame.
    """
    carry, body = CarrySettings(), begun.body
    few = {f: spread_over(given, settings.points_a_frame) for f, given in points.items()}
    given = PersonPoints(by_frame=few, scale_m=FIRST_SCALE_M)
    poses = follow_points(
        body, next(iter(begun.poses.items())), [int(f) for f in frames], np.asarray(position, float), settings=carry,
        anchor=lambda frame, pose: settled(PosedBody(body, pose), given, frame, carry), done=done,
    )  # fmt: skip
    return replace(begun, poses={f: pose for f, pose in poses.items() if f in points})
