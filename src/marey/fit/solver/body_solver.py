"""Least squares for pose and shape of one frame together, by dense normal equations."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy.linalg
import scipy.optimize

from marey.arrays import Floats
from marey.body.articulation.pose import PosedBody
from marey.body.articulation.surface import Body
from marey.fit.solver.pose_solver import Schedule, add_dense, match_all, solve_step
from marey.fit.solver.pose_steps import LONGEST_STEP_RAD
from marey.observations.correspondence import ObservedOutline
from marey.observations.observation import Observation, SurfaceObservation

STEP_SD_M, STEP_SD_RAD = 0.1, 0.2
"""Standard deviation of a pose coordinate's step, which damps what the observations do not determine [m, rad].
Chosen by hand; other values were not measured."""


def dense_equations(
    posed: PosedBody, found: Sequence[SurfaceObservation], weights: Sequence[Floats], others: Sequence[Observation]
) -> tuple[Floats, Floats, float]:
    """Assemble H (D + M, D + M), g (D + M,) and the cost of pose and shape together."""
    size = len(posed.body.skeleton) + len(posed.body.space)
    hessian, gradient, cost = np.zeros((size, size)), np.zeros(size), 0.0
    for observation, weight in zip(found, weights, strict=True):
        row = observation.linearize(posed, shape=True)
        scale = np.repeat(np.sqrt(weight), len(row.residual) // len(weight)) / observation.sigma
        jacobian, residual = row.jacobian, row.residual * scale
        jacobian *= scale[:, None]
        hessian += jacobian.T @ jacobian
        gradient += jacobian.T @ residual
        cost += float(residual @ residual)
    return hessian, gradient, cost + add_dense(posed, others, hessian, gradient, shape=True)


def fit_body(
    posed: PosedBody,
    sightings: Sequence[ObservedOutline],
    others: Sequence[Observation],
    *,
    schedule: Schedule,
    clip: float = 3.0,
) -> PosedBody:
    """Fit pose and shape of one frame to its silhouettes.

    Args:
        posed: Body at the start of the search.
        sightings: One per camera.
        others: Priors of pose and shape; both need one.
        schedule: Schedule by which gates and scales narrow.
        clip: Largest distance of a shape parameter from the prior's mean, in standard deviations.
    """
    degrees = len(posed.body.skeleton)
    for iteration in range(schedule.iterations):
        matching, scale = schedule.at(iteration)
        found, weights = match_all(posed, sightings, matching, scale)
        hessian, gradient, _ = dense_equations(posed, found, weights, others)
        step = bounded_body_step(hessian, gradient, degrees, shape_reach(posed.body, clip))
        numbers = posed.body.numbers + step[degrees:]
        posed = replace(posed, body=posed.body.with_numbers(numbers), pose=posed.pose.step(step[:degrees]))
    return posed


def shape_reach(body: Body, clip: float) -> tuple[Floats, Floats]:
    """Return the smallest and the largest step (M,) that the shape parameters may take."""
    space = body.space
    reach = clip * np.sqrt(np.diag(space.prior_covariance))
    from_mean = body.numbers - space.prior_mean
    return np.minimum(-reach - from_mean, 0.0), np.maximum(reach - from_mean, 0.0)


def bounded_step(information: Floats, gradient: Floats, least: Floats, greatest: Floats) -> Floats:
    """Minimise a quadratic within bounds.

    Args:
        information: (M, M) positive definite.
        gradient: (M,) at zero.
        least: (M,) lower bounds, not above zero.
        greatest: (M,) upper bounds, not below zero.
    """
    upper = scipy.linalg.cholesky(information)
    target = -scipy.linalg.solve_triangular(upper, gradient, trans="T")
    # The solver requires a gap between the bounds.
    found = scipy.optimize.lsq_linear(upper, target, (least - 1e-9, greatest + 1e-9), method="bvls").x
    return np.asarray(np.clip(found, least, greatest))


def bounded_body_step(hessian: Floats, gradient: Floats, degrees: int, reach: tuple[Floats, Floats]) -> Floats:
    """Solve for a Gauss-Newton step (D + M,) whose shape stays within bounds; the pose's step is optimal for it.

    Clipping the shape afterwards would leave in the pose the response to a change of shape that is not made.
    """
    step = solve_step(hessian, gradient, degrees=degrees)
    least, greatest = reach
    if np.all((step[degrees:] >= least) & (step[degrees:] <= greatest)):
        return step
    pose, cross = hessian[:degrees, :degrees], hessian[:degrees, degrees:]
    answer = np.linalg.solve(pose, np.column_stack([gradient[:degrees], cross]))
    information = hessian[degrees:, degrees:] - cross.T @ answer[:, 1:]
    shape = bounded_step(information, gradient[degrees:] - cross.T @ answer[:, 0], least, greatest)
    whole = np.concatenate([-(answer[:, 0] + answer[:, 1:] @ shape), shape])
    longest = np.abs(whole[3:degrees]).max()
    return whole if longest <= LONGEST_STEP_RAD else whole * (LONGEST_STEP_RAD / longest)
