"""Levenberg-Marquardt for poses and one common shape, from points on a surface ([Plaenkers1999] section 4).

Steps are damped, and those that raise the cost are rejected, so that it converges from a clicked start that is
centimetres off. Estimates that are nearly in place are refined by `fit.recipes.sequence`, which uses time and
silhouettes.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import scipy.linalg

from marey.arrays import Floats, Mask
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.surface import Body
from marey.body.metaballs.metaball_person import required_metaballs
from marey.body.metaballs.metaballs import THRESHOLD
from marey.fit.points.point_equations import distances_of, point_equations
from marey.fit.points.surface_points import MISFIT_PATCH_M, PersonPoints, thinned_evenly
from marey.fit.recipes.sequence import SequenceSettings
from marey.fit.solver.body_solver import STEP_SD_M, STEP_SD_RAD, bounded_step, shape_reach
from marey.fit.solver.pose_solver import add_dense
from marey.fit.solver.pose_steps import LONGEST_STEP_RAD
from marey.fit.solver.threads import map_in_threads
from marey.observations.metaball_points import PointsOnMetaballs
from marey.observations.observation import Observation
from marey.observations.prior import Habit, JointLimits, ShapePrior

Order = Literal["together", "in turn"]
"""Order in which sizes and skeleton are solved."""


@dataclass(frozen=True, kw_only=True)
class LevenbergSettings:
    """Settings of the iteration.

    The defaults were chosen by hand unless a field says otherwise; results were not measured against other values.
    """

    iterations: int = 30
    """Largest number of iterations."""
    order: Order = "together"
    """Whether widths and skeleton are solved together or in turn. The paper found that in turn converges better;
    here together does (docs/accuracy/rejected.md)."""
    few: int = 6000
    """Number of points per frame, evenly chosen, in a first fit that precedes the fit to all points."""
    last: int = 6
    """Number of iterations with all points after that."""
    segment_every: int = 3
    """Number of iterations after which points are assigned to limbs again."""
    damping: float = 1e-3
    """Initial damping (Marquardt), as a share of each parameter's own information."""
    stop: float = 1e-4
    """Relative decrease of the cost below which the iteration ends, once the robust scale is narrow."""
    habit: float = SequenceSettings.habit
    """Weight of the usual joint angles, as a number of observations; as in the refinement of a sequence."""
    residual: Literal["distance", "potential"] = "distance"
    """Residual of a point: the distance from the surface, or the paper's F - 1/2 ([Plaenkers1999] eq. (14)),
    weighted as if the slope of the field were `FIELD_PER_METRE` everywhere."""
    trials: int = 10
    """Largest number of rejected steps in one iteration."""
    misfit_patch_m: float = MISFIT_PATCH_M
    """Size of the patches over which the person deviates from the fitted metaballs by the same amount [m]; it counts in
    the stated covariance."""
    least_damping: float = 1e-6
    """Lower limit of the damping, as a share of each parameter's information."""
    clip: float = SequenceSettings.clip
    """Largest distance of a shape parameter from the prior's mean, in standard deviations."""


@dataclass(frozen=True, eq=False)
class LevenbergFit:
    """Fitted poses and body, with the course of the iteration."""

    body: Body
    poses: dict[int, Pose]
    cost: float
    """Final cost: weighted sum of squared residuals."""
    costs: tuple[float, ...]
    """Cost after each iteration, with its standard deviations, see `PersonPoints.with_sd_of_scale`."""
    stopped: str
    """Reason for which the iteration ended."""
    covariance: Floats
    """(N, N) covariance of the shape parameters. It includes that the skin deviates from the metaballs by the same
    amount throughout a patch, as much as the residuals show."""


@dataclass(frozen=True, eq=False)
class _System:
    """Normal equations of all frames, each (D + N), and those of the shape prior."""

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
    progress: Callable[[], None] = lambda: None,
) -> LevenbergFit:
    """Fit the shape parameters that all frames share, and each frame's pose, to points ([Plaenkers1999] eq. (12)).

    Args:
        points: Points by frame; their space is the body's.
        body: Body at the start.
        poses: Approximate pose for each frame.
        settings: Settings of the iteration.
        others: Further observations of each frame, besides limits, usual angles and the prior of the shape.
        progress: Called after each iteration.
    """
    settings = settings or LevenbergSettings()
    if any(len(of_frame) > settings.few for of_frame in points.by_frame.values()):
        few = {f: thinned_evenly(of_frame, settings.few) for f, of_frame in points.by_frame.items()}
        first = fit_points(
            replace(points, by_frame=few), body, poses, settings=settings, others=others, progress=progress
        )  # fmt: skip
        body, poses, points = first.body, first.poses, points.with_narrower_scale(0.0)
        settings = replace(settings, iterations=settings.last)
    known = (JointLimits(), Habit(share=settings.habit), *others)
    bodies = {f: PosedBody(body, pose) for f, pose in poses.items()}
    damping, costs, stopped = settings.damping, [], "all iterations were made"
    free_numbers = _free_numbers(body, settings.order)
    observed = _observed(points, bodies)
    system = _assemble(points, bodies, observed, known, settings)
    for iteration in range(settings.iterations):
        if iteration and iteration % settings.segment_every == 0:
            points = points.with_narrower_scale(0.5)
            observed = _observed(points, bodies)
            system = _assemble(points, bodies, observed, known, settings)
        for _ in range(settings.trials):
            free = free_numbers[iteration % len(free_numbers)]
            moved = _take_step(bodies, system, damping, free, settings.clip)
            cost = _cost(points, moved, observed, known, settings)
            if cost < system.cost:
                break
            damping = 10.0 * max(damping, settings.least_damping)
        else:
            if points.has_wide_scale:
                damping = settings.damping
                continue
            stopped = "no further step lowers the cost"
            break
        damping = max(damping / 10.0, settings.least_damping)
        fall = (system.cost - cost) / system.cost
        bodies = moved
        system = _assemble(points, bodies, observed, known, settings)
        costs.append(system.cost)
        progress()
        if fall < settings.stop and (iteration + 1) % len(free_numbers) == 0 and not points.has_wide_scale:
            stopped = f"the cost fell by less than {settings.stop:g} of itself"
            break
    at = next(iter(bodies.values())).body
    return LevenbergFit(
        at, {f: posed.pose for f, posed in bodies.items()}, system.cost, tuple(costs), stopped,
        _covariance(_with_misfit(points, bodies, known, settings)),
    )  # fmt: skip


def _with_misfit(
    points: PersonPoints, bodies: Mapping[int, PosedBody], known: Sequence[Observation], settings: LevenbergSettings
) -> _System:
    """Assemble the equations with the model's standard deviation that the residuals show, the same in a patch of skin.

    The standard deviation that was given remains the lower limit.
    """
    shown = points.reestimated(bodies)
    model = max(points.model_sd_m, shown.model_sd_m)
    shown = replace(points, model_sd_m=model, patch_m=max(points.patch_m, settings.misfit_patch_m))
    return _assemble(shown, bodies, _observed(shown, bodies), known, settings)


_UNFIXED_SD = 1e3
"""Prior standard deviation of a pose coordinate in the covariance of the numbers: so large that it is free [m, rad]."""


def _free_numbers(body: Body, order: Order) -> list[Mask]:
    """List the numbers (N,) that are free in each kind of iteration; if no length is free, the poses are fixed too."""
    count = len(body.space)
    if order == "together":
        return [np.ones(count, bool)]
    lengths = np.array([name.endswith("_length") for name in body.space.names])
    return [~lengths, lengths]


def _observed(points: PersonPoints, bodies: Mapping[int, PosedBody]) -> dict[int, PointsOnMetaballs | None]:
    """Assign the points of each frame to limbs, with the standard deviation that belongs to the robust scale."""
    weighed = points.with_sd_of_scale()
    return {f: weighed.observed(f, posed) for f, posed in bodies.items()}


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
            unit, distance = _residual_unit(settings), settings.residual == "distance"
            found = point_equations(posed, seen, scale=unit * points.scale_m, as_distance=distance)
            hessian, gradient = found.hessian / unit**2, found.gradient / unit**2
            cost = _robust_cost(found.residual / unit, seen, points.scale_m)
        cost += add_dense(posed, known, hessian, gradient, shape=True)
        return hessian, gradient, cost

    parts = list(map_in_threads(of_frame, bodies.items()))
    posed = next(iter(bodies.values()))
    white = ShapePrior().whiten(posed, shape=True)
    jacobian = white.jacobian[:, len(posed.body.skeleton) :]
    own = float(white.residual @ white.residual)
    shape = jacobian.T @ jacobian, jacobian.T @ white.residual
    return _System([part[:2] for part in parts], shape, own + sum(part[2] for part in parts))


FIELD_PER_METRE = 17.0
"""Slope of the field F at the surface of a limb of radius 0.04 m [1/m]: there F is 1/2, and ln F decreases by 1.4
over the radius."""


def _residual_unit(settings: LevenbergSettings) -> float:
    """Return the factor from metres to the residual's unit."""
    return 1.0 if settings.residual == "distance" else FIELD_PER_METRE


def _residuals(posed: PosedBody, seen: PointsOnMetaballs, settings: LevenbergSettings) -> Floats:
    """Return the residuals (n,) in metres; those of the field are converted."""
    if settings.residual == "distance":
        return distances_of(posed, seen)
    return (seen.surface(posed).field(seen.points, seen.limb) - THRESHOLD) / FIELD_PER_METRE


def _robust_cost(residual: Floats, seen: PointsOnMetaballs, scale: float) -> float:
    """Return the robust cost, whose gradient has the weights of `weights.geman_mcclure`."""
    squared = residual**2
    return float(np.sum(squared / (1.0 + squared / scale**2) / seen.spread**2))


def _cost(
    points: PersonPoints, bodies: Mapping[int, PosedBody], observed: Mapping[int, PointsOnMetaballs | None],
    known: Sequence[Observation], settings: LevenbergSettings,
) -> float:  # fmt: skip
    def of_frame(item: tuple[int, PosedBody]) -> float:
        frame, posed = item
        seen = observed[frame]
        cost = 0.0 if seen is None else _robust_cost(_residuals(posed, seen, settings), seen, points.scale_m)
        for observation in known:
            white = observation.whiten(posed)
            cost += float(white.residual @ white.residual)
        return cost

    posed = next(iter(bodies.values()))
    if not required_metaballs(posed.body).is_possible(posed.body.numbers):
        return float("inf")
    white = ShapePrior().whiten(posed)
    return float(white.residual @ white.residual) + sum(map_in_threads(of_frame, bodies.items()))


def _take_step(
    bodies: Mapping[int, PosedBody], system: _System, damping: float, free: Mask, clip: float
) -> dict[int, PosedBody]:
    """Solve for a step with the poses eliminated, and apply it."""
    body = next(iter(bodies.values())).body
    degrees = len(body.skeleton)
    resting = not any(name.endswith("_length") for name in np.array(body.space.names)[free])
    information, gradient = system.shape[0].copy(), system.shape[1].copy()
    answers = []
    step_sd = np.diag(1.0 / np.array([STEP_SD_M] * 3 + [STEP_SD_RAD] * (degrees - 3)) ** 2)
    for hessian, pull in system.frames:
        information += hessian[degrees:, degrees:]
        gradient += pull[degrees:]
        own = hessian[:degrees, :degrees] + damping * np.diag(np.diag(hessian)[:degrees]) + step_sd
        right = np.column_stack([pull[:degrees], hessian[:degrees, degrees:]])
        answers.append(np.zeros_like(right) if resting else scipy.linalg.solve(own, right, assume_a="pos"))
    for (hessian, _), answer in zip(system.frames, answers, strict=True):
        information -= hessian[degrees:, :degrees] @ answer[:, 1:]
        gradient -= hessian[degrees:, :degrees] @ answer[:, 0]
    index = np.flatnonzero(free)
    part = information[np.ix_(index, index)]
    numbers = np.zeros(len(free))
    least, greatest = shape_reach(body, clip)
    numbers[index] = bounded_step(
        part + damping * np.diag(np.diag(part)), gradient[index], least[index], greatest[index]
    )
    changed = body.with_numbers(body.numbers + numbers)
    steps = [-(answer[:, 0] + answer[:, 1:] @ numbers) for answer in answers]
    return {
        frame: PosedBody(changed, posed.pose.step(np.clip(step, -LONGEST_STEP_RAD, LONGEST_STEP_RAD)))
        for (frame, posed), step in zip(bodies.items(), steps, strict=True)
    }


def _covariance(system: _System) -> Floats:
    """Return the covariance (N, N) of the numbers with the poses free."""
    count = len(system.shape[1])
    information = system.shape[0].copy()
    for hessian, pull in system.frames:
        degrees = len(pull) - count
        cross = hessian[:degrees, degrees:]
        own = hessian[:degrees, :degrees] + np.diag(1.0 / _UNFIXED_SD**2 * np.ones(degrees))
        information += hessian[degrees:, degrees:] - cross.T @ np.linalg.solve(own, cross)
    return np.asarray(np.linalg.inv(0.5 * (information + information.T)))
