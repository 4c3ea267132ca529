"""Pose and shape of one frame together, by dense normal equations."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from marey.arrays import Floats
from marey.body.pose import PosedBody
from marey.fit.pose_solver import Schedule, add_dense, match_all, solve_step
from marey.observations.correspondence import Sighting
from marey.observations.observation import Observation, SurfaceObservation


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
    sightings: Sequence[Sighting],
    others: Sequence[Observation],
    *,
    schedule: Schedule,
    clip: float = 3.0,
) -> PosedBody:
    """Fit pose and shape of one frame to its silhouettes.

    Args:
        posed: the body where the search starts.
        sightings: one for each camera.
        others: priors of pose and shape; both need one.
        schedule: how the search narrows.
        clip: no shape number goes farther from the prior's mean than so many standard deviations.
    """
    degrees = len(posed.body.skeleton)
    space = posed.body.space
    reach = clip * np.sqrt(np.diag(space.prior_covariance))
    for iteration in range(schedule.iterations):
        matching, scale = schedule.at(iteration)
        found, weights = match_all(posed, sightings, matching, scale)
        hessian, gradient, _ = dense_equations(posed, found, weights, others)
        step = solve_step(hessian, gradient, degrees=degrees)
        numbers = posed.body.numbers + step[degrees:]
        numbers = np.clip(numbers, space.prior_mean - reach, space.prior_mean + reach)
        posed = replace(posed, body=posed.body.with_numbers(numbers), pose=posed.pose.step(step[:degrees]))
    return posed
