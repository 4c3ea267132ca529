"""Initial motion from trajectories: points on one segment move with it from frame to frame."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from marey.arrays import Floats, Integers
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.surface import Body
from marey.fit.points.surface_points import PersonPoints
from marey.fit.progress import FrameProgress, no_progress
from marey.fit.solver.pose_solver import add_dense, solve_step
from marey.fit.solver.weights import geman_mcclure
from marey.observations.carried_points import CarriedPoints, local_places
from marey.observations.observation import Observation
from marey.observations.prior import Habit, JointLimits, NearPose


@dataclass(frozen=True, kw_only=True)
class CarrySettings:
    """Settings of the motion from trajectories. Chosen by hand; other values were not measured."""

    sigma_m: float = 0.003
    """Standard deviation of a point relative to its segment: skin slides, and bends near joints [m]."""
    scale_m: float = 0.01
    """Residual at which a point has a quarter of its weight: some trajectories slip [m]."""
    near_m: float = 0.05
    """Points farther from the skin are ignored [m]."""
    patch: float = 30.0
    """Effective number of neighbouring points that slide together and count as one observation."""
    step_m: float = 0.1
    """Prior standard deviation of the pelvis' motion from one frame to the next, per axis [m]."""
    step_rad: float = 0.3
    """Prior standard deviation of an angle's change from one frame to the next [rad]."""
    rounds: int = 5
    """Largest number of Gauss-Newton steps per frame."""
    unanchored: int = 10
    """Number of frames after which the body is aligned with the measured surface again."""


def carrying_segments(posed: PosedBody, points: Floats, *, near_m: float) -> Integers:
    """Return the segment (n,) on whose skin each point (n, 3) lies, -1 if it is farther from the skin."""
    body = posed.body
    used = np.unique(body.faces)
    strongest = body.vertex_segments[used, np.argmax(body.vertex_weights[used], axis=1)]
    away, which = cKDTree(posed.vertices[used]).query(points)
    return np.where(away < near_m, strongest[which], -1)


def pose_from_points(
    posed: PosedBody, before: Floats, after: Floats, settings: CarrySettings, *, segments: Integers | None = None
) -> Pose:
    """Estimate the pose after a frame step from the motion of points on the body.

    Args:
        posed: Body in the pose before.
        before: (n, 3) points before, in the world [m].
        after: (n, 3) the same points after.
        settings: Weights of the points and of the prior.
        segments: (n,) segments that carry the points; those of the nearest skin if None.

    Returns:
        The pose after; a segment without points follows its neighbours.
    """
    on = carrying_segments(posed, before, near_m=settings.near_m) if segments is None else segments
    kept = on >= 0
    degrees = len(posed.body.skeleton)
    spread = np.array([settings.step_m] * 3 + [settings.step_rad] * (degrees - 3))
    others: list[Observation] = [JointLimits(), NearPose(pose=posed.pose, spread=spread)]
    seen = CarriedPoints(
        segments=on[kept], places=local_places(posed, on[kept], before[kept]), points=after[kept],
        sigma_m=settings.sigma_m * np.sqrt(settings.patch),
    )  # fmt: skip
    moved = posed
    for _ in range(settings.rounds):
        hessian, gradient = np.zeros((degrees, degrees)), np.zeros(degrees)
        white = seen.whiten(moved)
        weight = geman_mcclure(seen.sigma * white.residual.reshape(-1, 3), settings.scale_m)
        rows = white.jacobian * np.repeat(weight, 3)[:, None]
        hessian += rows.T @ white.jacobian
        gradient += rows.T @ white.residual
        add_dense(moved, others, hessian, gradient)
        step = solve_step(hessian, gradient)
        moved = replace(moved, pose=moved.pose.step(step))
        if np.abs(step).max() < 1e-5:
            break
    return moved.pose


def pose_on_surface(posed: PosedBody, points: PersonPoints, frame: int, settings: CarrySettings) -> Pose:
    """Fit the pose of a body of metaballs to the points measured in a frame; its shape is kept."""
    degrees = len(posed.body.skeleton)
    spread = np.array([settings.step_m] * 3 + [settings.step_rad] * (degrees - 3))
    others: list[Observation] = [JointLimits(), Habit(share=0.1), NearPose(pose=posed.pose, spread=spread)]
    for _ in range(settings.rounds):
        hessian, gradient = (part[..., :degrees] for part in points.terms(frame, posed))
        hessian = hessian[:degrees].copy()
        add_dense(posed, others, hessian, gradient)
        posed = replace(posed, pose=posed.pose.step(solve_step(hessian, gradient)))
    return posed.pose


def follow_points(
    body: Body,
    start: tuple[int, Pose],
    frames: Sequence[int],
    position: Floats,
    *,
    settings: CarrySettings | None = None,
    anchor: Callable[[int, Pose], Pose] = lambda frame, pose: pose,
    progress: FrameProgress = no_progress,
) -> dict[int, Pose]:
    """Track a body from one frame to both ends by the trajectories on it ([Plaenkers1999] section 4.2).

    Args:
        body: Body of fixed shape.
        start: Frame and pose of the start.
        frames: (F,) of the trajectories, ascending.
        position: (F, N, 3) in the world [m], NaN where not measured.
        settings: Weights of the points and of the prior.
        anchor: Aligns a pose with the other measurements of its frame; called every `unanchored` frames.
        progress: Called with each frame.

    Returns:
        Poses by frame.
    """
    settings = settings or CarrySettings()
    at = list(frames).index(start[0])
    poses = {start[0]: start[1]}
    progress(start[0])
    for order in (range(at + 1, len(frames)), range(at - 1, -1, -1)):
        last = at
        for count, row in enumerate(order, 1):
            both = np.isfinite(position[row]).all(1) & np.isfinite(position[last]).all(1)
            posed = PosedBody(body, poses[frames[last]])
            pose = pose_from_points(posed, position[last, both], position[row, both], settings)
            poses[frames[row]] = anchor(frames[row], pose) if count % settings.unanchored == 0 else pose
            progress(frames[row])
            last = row
    return dict(sorted(poses.items()))
