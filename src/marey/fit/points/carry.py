"""The start of a motion from trajectories: what lies on one segment moves with it from frame to frame."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from marey.arrays import Floats, Integers
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.surface import Body
from marey.fit.points.surface_points import PersonPoints
from marey.fit.solver.pose_solver import add_dense, solve_step
from marey.fit.solver.weights import geman_mcclure
from marey.observations.carried_points import CarriedPoints, fasten
from marey.observations.observation import Observation
from marey.observations.prior import Habit, JointLimits, NearPose


@dataclass(frozen=True, kw_only=True)
class CarrySettings:
    """How trajectories move a body."""

    sigma_m: float = 0.003
    """Standard deviation of a point that its segment carries: skin slides, and bends near joints [m]."""
    scale_m: float = 0.01
    """Distance at which a point counts a quarter: some trajectories slip [m]."""
    near_m: float = 0.05
    """Points farther from the skin belong to nobody [m]."""
    patch: float = 30.0
    """Neighbours that slide alike: so many are worth one."""
    step_m: float = 0.1
    step_rad: float = 0.3
    """How far a coordinate may move from one frame to the next, as a standard deviation, where nothing says so."""
    rounds: int = 5
    unanchored: int = 10
    """Frames after which a body that only trajectories move is brought onto the measured surface again."""


def carrying_segments(posed: PosedBody, points: Floats, *, near_m: float) -> Integers:
    """Give the segment (n,) on whose skin each point (n, 3) lies, -1 where it lies on none."""
    body = posed.body
    used = np.unique(body.faces)
    strongest = body.vertex_segments[used, np.argmax(body.vertex_weights[used], axis=1)]
    away, which = cKDTree(posed.vertices[used]).query(points)
    return np.where(away < near_m, strongest[which], -1)


def carried(
    posed: PosedBody, before: Floats, after: Floats, settings: CarrySettings, *, segments: Integers | None = None
) -> Pose:
    """Move a body as points on it moved.

    Args:
        posed: where the points stood before.
        before: (n, 3) in the world [m].
        after: (n, 3) of the same points.
        settings: how.
        segments: (n,) that carry them, found by the skin when None.

    Returns:
        The pose after; where no point says anything, the body follows its neighbours.
    """
    on = carrying_segments(posed, before, near_m=settings.near_m) if segments is None else segments
    kept = on >= 0
    degrees = len(posed.body.skeleton)
    spread = np.array([settings.step_m] * 3 + [settings.step_rad] * (degrees - 3))
    others: list[Observation] = [JointLimits(), NearPose(pose=posed.pose, spread=spread)]
    seen = CarriedPoints(
        segments=on[kept], places=fasten(posed, on[kept], before[kept]), points=after[kept],
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


def settled(posed: PosedBody, points: PersonPoints, frame: int, settings: CarrySettings) -> Pose:
    """Bring a posed body of metaballs onto the points that were measured in a frame; its shape stays."""
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
    done: Callable[[int], None] = lambda frame: None,
) -> dict[int, Pose]:
    """Follow a body from one frame to both ends by the trajectories on it ([Plaenkers1999] section 4.2).

    Args:
        body: whose shape stays as it is.
        start: a frame, and the pose in it.
        frames: (F,) of the trajectories, rising.
        position: (F, N, 3) in the world [m], NaN where not measured.
        settings: how.
        anchor: brings a pose onto what else was measured in its frame; called every some frames.
        done: told of every frame.
    """
    settings = settings or CarrySettings()
    at = list(frames).index(start[0])
    poses = {start[0]: start[1]}
    done(start[0])
    for order in (range(at + 1, len(frames)), range(at - 1, -1, -1)):
        last = at
        for count, row in enumerate(order, 1):
            both = np.isfinite(position[row]).all(1) & np.isfinite(position[last]).all(1)
            posed = PosedBody(body, poses[frames[last]])
            pose = carried(posed, position[last, both], position[row, both], settings)
            poses[frames[row]] = anchor(frames[row], pose) if count % settings.unanchored == 0 else pose
            done(frames[row])
            last = row
    return dict(sorted(poses.items()))
