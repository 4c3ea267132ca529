"""Levenberg-Marquardt for poses and the one shape they share, from points on a surface ([Plaenkers1999] section 4).

It damps its steps and takes back those that raise the cost, and therefore comes right from a clicked start that lies
centimetres off; all that is nearly in place is refined by `fit.sequence`, which knows time and silhouettes.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import scipy.linalg

from marey.arrays import Floats, Mask
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.surface import Body
from marey.body.metaballs.metaballs import THRESHOLD
from marey.fit.points.point_equations import distances_of, point_equations
from marey.fit.points.surface_points import PersonPoints, spread_over
from marey.fit.solver.body_solver import bounded_step, shape_reach
from marey.fit.solver.pose_solver import add_dense
from marey.fit.solver.pose_steps import LONGEST_TURN
from marey.fit.solver.side_by_side import side_by_side
from marey.observations.metaball_points import PointsOnMetaballs
from marey.observations.observation import Observation
from marey.observations.prior import Habit, JointLimits, ShapePrior

Order = Literal["together", "in turn"]


@dataclass(frozen=True, kw_only=True)
class LevenbergSettings:
    """How the solution is sought."""

    iterations: int = 30
    order: Order = "together"
    """Whether sizes across and skeleton are solved together, or in turn as in the paper, which found that to converge
    better; here together does (docs/accuracy.md)."""
    few: int = 6000
    """Of more points in a frame, first so many are fitted, spread over all: they bring it nearly there."""
    last: int = 6
    """Iterations with all points after that."""
    segment_every: int = 3
    """After so many iterations points are assigned to limbs anew."""
    damping: float = 1e-3
    """Marquardt's, at the start: a share of each parameter's own information."""
    stop: float = 1e-4
    """A smaller relative fall of the cost ends the search, once no point changes its limb."""
    habit: float = 0.1
    """How many observations the joints' habits are worth."""
    residual: Literal["distance", "potential"] = "distance"
    """What is minimised: the distance from the surface, or the paper's F - 1/2 ([Plaenkers1999] eq. (14)), weighed as
    if the field fell everywhere by `FIELD_PER_METRE`."""


@dataclass(frozen=True, eq=False)
class LevenbergFit:
    """Poses and body, and how they were found."""

    body: Body
    poses: dict[int, Pose]
    cost: float
    costs: tuple[float, ...]
    """After each iteration."""
    stopped: str
    """Why, in a sentence."""
    covariance: Floats
    """(N, N) of the numbers."""


@dataclass(frozen=True, eq=False)
class _System:
    """The normal equations of all frames, each (D + N), and the shape's own."""

    frames: list[tuple[Floats, Floats]]
    shape: tuple[Floats, Floats]
    cost: float


def fit_points(
    points: PersonPoints,
    body: Body,
    poses: Mapping[int, Pose],
    *,
    settings: LevenbergSettings | None = None,
    others: Sequence[Observation] = (),
    done: Callable[[], None] = lambda: None,
) -> LevenbergFit:
    """Fit the numbers that all frames share, and each frame's pose, to measured points ([Plaenkers1999] eq. (12)).

    Args:
        points: of the frames; their space is the body's.
        body: where the search starts.
        poses: a rough one for each frame.
        settings: how the solution is sought.
        others: what else is known of each frame, beside limits, habits and the prior of the shape.
        done: told of every iteration.
    """
    settings = settings or LevenbergSettings()
    if any(len(of_frame) > settings.few for of_frame in points.by_frame.values()):
        few = {f: spread_over(of_frame, settings.few) for f, of_frame in points.by_frame.items()}
        first = fit_points(
            replace(points, by_frame=few), body, poses, settings=settings, others=others, done=done
        )  # fmt: skip
        body, poses, points = first.body, first.poses, points.narrowed(0.0)
        settings = replace(settings, iterations=settings.last)
    known = (JointLimits(), Habit(share=settings.habit), *others)
    bodies = {f: PosedBody(body, pose) for f, pose in poses.items()}
    damping, costs, stopped = settings.damping, [], "all iterations were made"
    turns = _turns(body, settings.order)
    observed = {f: points.observed(f, posed) for f, posed in bodies.items()}
    system = _assemble(points, bodies, observed, known, settings)
    for iteration in range(settings.iterations):
        if iteration and iteration % settings.segment_every == 0:
            points = points.narrowed(0.5)
            observed = {f: points.observed(f, posed) for f, posed in bodies.items()}
            system = _assemble(points, bodies, observed, known, settings)
        for _ in range(_TRIALS):
            moved = _moved(bodies, system, damping, turns[iteration % len(turns)])
            cost = _cost(points, moved, observed, known, settings)
            if cost < system.cost:
                break
            damping = 10.0 * max(damping, LEAST_DAMPING)
        else:
            stopped = "no step lowers the cost any more"
            break
        damping = max(damping / 10.0, LEAST_DAMPING)
        fall = (system.cost - cost) / system.cost
        bodies = moved
        system = _assemble(points, bodies, observed, known, settings)
        costs.append(system.cost)
        done()
        if fall < settings.stop and (iteration + 1) % len(turns) == 0:
            stopped = f"the cost fell by less than {settings.stop:g} of itself"
            break
    at = next(iter(bodies.values())).body
    return LevenbergFit(
        at, {f: posed.pose for f, posed in bodies.items()}, system.cost, tuple(costs), stopped, _covariance(system)
    )


_NOWHERE = 1e3
"""How far a coordinate may lie that nothing fixes [m, rad]."""
_TRIALS, LEAST_DAMPING = 10, 1e-6
TRUST_M, TRUST_RAD = 0.1, 0.2
"""How far one step may go where the points leave it open [m, rad]."""
CLIP = 3.0
"""No number goes farther from what is expected than so many standard deviations."""


def _turns(body: Body, order: Order) -> list[Mask]:
    """List which numbers (N,) move in which iteration; where none of the lengths does, the poses rest too."""
    count = len(body.space)
    if order == "together":
        return [np.ones(count, bool)]
    lengths = np.array([name.endswith("_length") for name in body.space.names])
    return [~lengths, lengths]


def _assemble(
    points: PersonPoints, bodies: Mapping[int, PosedBody], observed: Mapping[int, PointsOnMetaballs | None],
    known: Sequence[Observation], settings: LevenbergSettings,
) -> _System:  # fmt: skip
    def of_frame(item: tuple[int, PosedBody]) -> tuple[Floats, Floats, float]:
        frame, posed = item
        size = len(posed.body.skeleton) + len(posed.body.space)
        hessian: Floats = np.zeros((size, size))
        gradient: Floats = np.zeros(size)
        cost = 0.0
        seen = observed[frame]
        if seen is not None:
            unit, distance = _unit(settings), settings.residual == "distance"
            found = point_equations(posed, seen, scale=unit * points.scale_m, as_distance=distance)
            hessian, gradient = found.hessian / unit**2, found.gradient / unit**2
            cost = _robust(found.residual / unit, seen, points.scale_m)
        cost += add_dense(posed, known, hessian, gradient, shape=True)
        return hessian, gradient, cost

    parts = list(side_by_side(of_frame, bodies.items()))
    posed = next(iter(bodies.values()))
    white = ShapePrior().whiten(posed, shape=True)
    jacobian = white.jacobian[:, len(posed.body.skeleton) :]
    own = float(white.residual @ white.residual)
    shape = jacobian.T @ jacobian, jacobian.T @ white.residual
    return _System([part[:2] for part in parts], shape, own + sum(part[2] for part in parts))


FIELD_PER_METRE = 17.0
"""How fast the field falls at the surface of a limb four centimetres thick [1/m]: ln F by 1.4 over its radius."""


def _unit(settings: LevenbergSettings) -> float:
    return 1.0 if settings.residual == "distance" else FIELD_PER_METRE


def _off(posed: PosedBody, seen: PointsOnMetaballs, settings: LevenbergSettings) -> Floats:
    """Give the residuals (n,), those of the field as if they were metres."""
    if settings.residual == "distance":
        return distances_of(posed, seen)
    return (seen.surface(posed).field(seen.points, seen.limb) - THRESHOLD) / FIELD_PER_METRE


def _robust(residual: Floats, seen: PointsOnMetaballs, scale: float) -> float:
    """Give the cost whose slope the weights of `robust.geman_mcclure` have."""
    squared = residual**2
    return float(np.sum(squared / (1.0 + squared / scale**2) / seen.spread**2))


def _cost(
    points: PersonPoints, bodies: Mapping[int, PosedBody], observed: Mapping[int, PointsOnMetaballs | None],
    known: Sequence[Observation], settings: LevenbergSettings,
) -> float:  # fmt: skip
    def of_frame(item: tuple[int, PosedBody]) -> float:
        frame, posed = item
        seen = observed[frame]
        cost = 0.0 if seen is None else _robust(_off(posed, seen, settings), seen, points.scale_m)
        for observation in known:
            white = observation.whiten(posed)
            cost += float(white.residual @ white.residual)
        return cost

    posed = next(iter(bodies.values()))
    white = ShapePrior().whiten(posed)
    return float(white.residual @ white.residual) + sum(side_by_side(of_frame, bodies.items()))


def _moved(bodies: Mapping[int, PosedBody], system: _System, damping: float, free: Mask) -> dict[int, PosedBody]:
    """Solve for a step, the poses eliminated, and take it."""
    body = next(iter(bodies.values())).body
    degrees = len(body.skeleton)
    resting = not any(name.endswith("_length") for name in np.array(body.space.names)[free])
    information, gradient = system.shape[0].copy(), system.shape[1].copy()
    answers = []
    trust = np.diag(1.0 / np.array([TRUST_M] * 3 + [TRUST_RAD] * (degrees - 3)) ** 2)
    for hessian, pull in system.frames:
        information += hessian[degrees:, degrees:]
        gradient += pull[degrees:]
        own = hessian[:degrees, :degrees] + damping * np.diag(np.diag(hessian)[:degrees]) + trust
        right = np.column_stack([pull[:degrees], hessian[:degrees, degrees:]])
        answers.append(np.zeros_like(right) if resting else scipy.linalg.solve(own, right, assume_a="pos"))
    for (hessian, _), answer in zip(system.frames, answers, strict=True):
        information -= hessian[degrees:, :degrees] @ answer[:, 1:]
        gradient -= hessian[degrees:, :degrees] @ answer[:, 0]
    index = np.flatnonzero(free)
    part = information[np.ix_(index, index)]
    numbers = np.zeros(len(free))
    least, greatest = shape_reach(body, CLIP)
    numbers[index] = bounded_step(
        part + damping * np.diag(np.diag(part)), gradient[index], least[index], greatest[index]
    )
    changed = body.with_numbers(body.numbers + numbers)
    steps = [-(answer[:, 0] + answer[:, 1:] @ numbers) for answer in answers]
    return {
        frame: PosedBody(changed, posed.pose.step(np.clip(step, -LONGEST_TURN, LONGEST_TURN)))
        for (frame, posed), step in zip(bodies.items(), steps, strict=True)
    }


def _covariance(system: _System) -> Floats:
    """Give the numbers' covariance (N, N), the poses free."""
    count = len(system.shape[1])
    information = system.shape[0].copy()
    for hessian, pull in system.frames:
        degrees = len(pull) - count
        cross = hessian[:degrees, degrees:]
        own = hessian[:degrees, :degrees] + np.diag(1.0 / _NOWHERE**2 * np.ones(degrees))
        information += hessian[degrees:, degrees:] - cross.T @ np.linalg.solve(own, cross)
    return np.asarray(np.linalg.inv(0.5 * (information + information.T)))
