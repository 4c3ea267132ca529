"""The pose of one frame: correspondence and least squares in turn, until they agree (figure 1 of the paper)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np
import scipy.linalg

from marey.arrays import Floats, Mask
from marey.body.articulation.pose import Pose, PosedBody
from marey.cameras.visibility import View
from marey.fit.solver.moments import Moments, gather_moments
from marey.fit.solver.normal_equations import normal_equations
from marey.fit.solver.pose_steps import DAMPING, LONGEST_TURN, Known, descend
from marey.fit.solver.side_by_side import together
from marey.fit.solver.weights import geman_mcclure
from marey.observations.correspondence import Matching, Residual, Sighting
from marey.observations.interior import see_all
from marey.observations.observation import AngleObservation, Observation, SurfaceObservation
from marey.observations.prior import JointLimits


@dataclass(frozen=True, kw_only=True)
class Schedule:
    """How the search narrows: distances shrink geometrically from their first to their last value."""

    iterations: int = 6
    gate: tuple[float, float] = (25.0, 6.0)
    """Greatest distance of a match [px]."""
    scale: tuple[float, float] = (10.0, 3.0)
    """Scale of the robust weights [px]."""
    cosine: float = 0.3
    sigma_px: float = 3.2
    """Standard deviation of a match; neighbours of a contour are alike, so it exceeds one pixel's own."""
    residual: Residual = "plane"
    """What a contour's pixel says: its tangent plane, or the paper's ray."""
    vote: bool = False
    """Whether neighbours decide where a contour pixel could belong to two limbs."""
    interior: bool = False
    """Whether edges inside of the silhouettes count: they were looked for about a body that is nearly in place."""

    def at(self, iteration: int) -> tuple[Matching, float]:
        """Give the matching and the robust scale of an iteration."""
        share = iteration / max(self.iterations - 1, 1)
        gate, scale = (first * (last / first) ** share for first, last in (self.gate, self.scale))
        matching = Matching(
            gate=gate, cosine=self.cosine, sigma_px=self.sigma_px, residual=self.residual, vote=self.vote,
            interior=self.interior,
        )  # fmt: skip
        return matching, scale


@dataclass(frozen=True, eq=False)
class PoseFit:
    """An estimated pose and the system that gave it."""

    posed: PosedBody
    hessian: Floats
    """(D, D) information of the pose from all observations."""
    matches: int
    """Pairs of rim and contour in the last iteration."""


OPEN = "the observations leave a coordinate open; a prior is missing"


def solve_step(hessian: Floats, gradient: Floats, *, degrees: int | None = None) -> Floats:
    """Solve for a Gauss-Newton step, shortened where it turns one of the pose's degrees of freedom too far."""
    damped = hessian.copy()
    np.einsum("ii->i", damped)[:] += DAMPING * np.trace(hessian) / len(hessian)
    factor, failed = scipy.linalg.lapack.dpotrf(damped)
    if failed:
        raise np.linalg.LinAlgError(OPEN)
    step = -scipy.linalg.lapack.dpotrs(factor, gradient)[0]
    longest = np.abs(step[3:degrees]).max()
    return step if longest <= LONGEST_TURN else step * (LONGEST_TURN / longest)


def add_dense(
    posed: PosedBody, observations: Sequence[Observation], hessian: Floats, gradient: Floats, *, shape: bool = False
) -> float:
    """Add observations that are no surface points to the equations of the pose (and the shape); give their cost."""
    cost = 0.0
    diagonal = np.einsum("ii->i", hessian)
    angles = slice(6, len(posed.body.skeleton))
    for observation in observations:
        if isinstance(observation, AngleObservation):
            residual, slope = observation.by_angle(posed)
            weight = 1.0 / observation.sigma**2
            diagonal[angles] += weight * slope**2
            gradient[angles] += weight * slope * residual
            cost += weight * float(residual @ residual)
            continue
        white = observation.whiten(posed, shape=shape)
        hessian += white.jacobian.T @ white.jacobian
        gradient += white.jacobian.T @ white.residual
        cost += float(white.residual @ white.residual)
    return cost


def solve_pose(
    posed: PosedBody, moments: Moments, others: Sequence[Observation], *, steps: int = 2, stop: float = 1e-5
) -> tuple[PosedBody, Floats]:
    """Find the pose for fixed correspondences ([Rosenhahn2006] eq. (12)) by Gauss-Newton.

    Args:
        posed: where to start.
        moments: of the surface observations.
        others: limits, priors and whatever else is known.
        steps: at most this many.
        stop: a shorter step [m, rad] ends the search.

    Returns:
        The body in the new pose, and the information (D, D) at the last linearisation.
    """
    known = Known.of(posed.body.skeleton, others)
    if known is None or steps == 0:
        return solve_pose_step_by_step(posed, moments, others, steps=steps, stop=stop)
    rotation, translation, angles, hessian, solved = descend(
        posed.body.packed, posed.body.joint_centres, posed.pose.rotation, posed.pose.translation, posed.pose.angles,
        moments.pairs, moments.products, moments.linear, known, steps, stop,
    )  # fmt: skip
    if not solved:
        raise np.linalg.LinAlgError(OPEN)
    return replace(posed, pose=Pose(translation, rotation, angles)), hessian


def solve_pose_step_by_step(
    posed: PosedBody, moments: Moments, others: Sequence[Observation], *, steps: int, stop: float
) -> tuple[PosedBody, Floats]:
    """Do what `solve_pose` does with observations of any kind; the plain meaning of its kernel."""
    hessian: Floats = np.zeros(0)
    for _ in range(steps):
        hessian, gradient, _ = normal_equations(posed, moments)
        add_dense(posed, others, hessian, gradient)
        step = solve_step(hessian, gradient)
        posed = replace(posed, pose=posed.pose.step(step))
        if np.abs(step).max() < stop:
            break
    return posed, hessian


def match_all(
    posed: PosedBody, sightings: Sequence[Sighting], matching: Matching, scale: float
) -> tuple[list[SurfaceObservation], list[Floats]]:
    """Match the surface in all cameras; give the matches and their weights: robust ones, twice where found twice."""
    found: list[SurfaceObservation] = []
    weights: list[Floats] = []
    for outline in chain.from_iterable(together(lambda sighting: see_all(posed, sighting, matching), sightings)):
        found.append(outline.match)
        weights.append(outline.counts * geman_mcclure(outline.match.residuals(posed), scale))
    return found, weights


def fit_pose(
    posed: PosedBody,
    sightings: Sequence[Sighting],
    others: Sequence[Observation] = (JointLimits(),),
    *,
    schedule: Schedule,
) -> PoseFit:
    """Fit the pose of one frame to its silhouettes.

    Args:
        posed: the body where the search starts.
        sightings: one for each camera that saw the person.
        others: further observations; a body whose views leave something open needs a prior.
        schedule: how the search narrows.
    """
    hessian: Floats = np.zeros(0)
    matches = 0
    for iteration in range(schedule.iterations):
        matching, scale = schedule.at(iteration)
        found, weights = match_all(posed, sightings, matching, scale)
        moments = gather_moments(posed, found, weights)
        matches = sum(len(match.where) for match in found)
        posed, hessian = solve_pose(posed, moments, others)
    return PoseFit(posed, hessian, matches)


def agreement(views: Sequence[View], masks: Sequence[Mask]) -> Floats:
    """Compare surface and silhouettes: intersection over union for each camera, NaN where both are empty."""
    return np.array([overlap(view, mask) for view, mask in zip(views, masks, strict=True)])


def overlap(view: View, mask: Mask) -> float:
    """Give intersection over union of a drawn surface and a silhouette (height, width)."""
    x, y = view.corner
    h, w = view.face.shape
    covered = view.covered
    both = int(np.count_nonzero(covered & mask[y : y + h, x : x + w]))
    union = int(np.count_nonzero(covered)) + int(np.count_nonzero(mask)) - both
    return both / union if union else float("nan")
