"""Least squares for the pose of one frame, alternating with matching ([Rosenhahn2006] figure 1)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np
import scipy.linalg

from marey.arrays import Floats
from marey.body.articulation.pose import Pose, PosedBody
from marey.fit.solver.matched_moments import gives_moments, match_moments
from marey.fit.solver.moments import Moments, gather_moments
from marey.fit.solver.normal_equations import normal_equations
from marey.fit.solver.picture_times import PictureMotion
from marey.fit.solver.pose_steps import DAMPING, LONGEST_STEP_RAD, PackedPriors, descend
from marey.fit.solver.threads import map_in_two_threads
from marey.fit.solver.weights import match_weights
from marey.observations.correspondence import ObservedOutline, OutlineMatches, OutlineMatchSettings, Residual
from marey.observations.interior import all_matches
from marey.observations.observation import AngleObservation, Observation, SurfaceObservation
from marey.observations.prior import JointLimits


@dataclass(frozen=True, kw_only=True)
class Schedule:
    """Iterations of a fit: gate and scale shrink geometrically from their first to their last value."""

    iterations: int = 6
    """Number of times that correspondences are matched."""
    gate: tuple[float, float] = (25.0, 6.0)
    """Greatest distance of a match [px]."""
    scale: tuple[float, float] = (10.0, 3.0)
    """Scale of the robust weights [px]."""
    cosine: float = 0.3
    """Least cosine between the normals of a match."""
    sigma_px: float = 3.2
    """Standard deviation of a match [px]; above one pixel's own, because neighbours on a contour are correlated."""
    residual: Residual = "plane"
    """Residual of a contour pixel: the distance from its tangent plane ("plane"), or from its ray as in the paper
    ("ray")."""
    vote: bool = False
    """Whether neighbours decide to which of two limbs a contour pixel belongs."""
    interior: bool = False
    """Whether edges inside the silhouettes are used. They are extracted near a body that is nearly in place."""

    def at(self, iteration: int) -> tuple[OutlineMatchSettings, float]:
        """Return the match settings and the robust scale [px] of an iteration."""
        share = iteration / max(self.iterations - 1, 1)
        gate, scale = (first * (last / first) ** share for first, last in (self.gate, self.scale))
        matching = OutlineMatchSettings(
            gate=gate, cosine=self.cosine, sigma_px=self.sigma_px, residual=self.residual, vote=self.vote,
            interior=self.interior,
        )  # fmt: skip
        return matching, scale


@dataclass(frozen=True, eq=False)
class PoseFit:
    """An estimated pose with the information about it."""

    posed: PosedBody
    """The body in the estimated pose."""
    hessian: Floats
    """(D, D) information of the pose from all observations."""
    matches: int
    """Number of pairs of rim and contour points in the last iteration."""


UNDETERMINED = "the observations do not determine every coordinate; add a prior"
"""Text of the error raised if the normal equations are singular."""


def solve_step(hessian: Floats, gradient: Floats, *, degrees: int | None = None) -> Floats:
    """Solve for a Gauss-Newton step, shortened so that no angle of the pose changes by more than `LONGEST_STEP_RAD`."""
    damped = hessian.copy()
    np.einsum("ii->i", damped)[:] += DAMPING * np.trace(hessian) / len(hessian)
    factor, failed = scipy.linalg.lapack.dpotrf(damped)
    if failed:
        raise np.linalg.LinAlgError(UNDETERMINED)
    step = -scipy.linalg.lapack.dpotrs(factor, gradient)[0]
    longest = np.abs(step[3:degrees]).max()
    return np.asarray(step if longest <= LONGEST_STEP_RAD else step * (LONGEST_STEP_RAD / longest))


def add_dense(
    posed: PosedBody, observations: Sequence[Observation], hessian: Floats, gradient: Floats, *, shape: bool = False
) -> float:
    """Add observations other than surface points to the equations of the pose (and the shape); return their cost."""
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
    """Estimate the pose for fixed correspondences ([Rosenhahn2006] eq. (12)) by Gauss-Newton.

    Args:
        posed: Body at the start.
        moments: Moments of the surface observations.
        others: Joint limits, priors and other observations.
        steps: Largest number of steps.
        stop: A shorter step ends the iteration [m, rad].

    Returns:
        The body in the new pose, and the information (D, D) at the last linearisation.

    Raises:
        numpy.linalg.LinAlgError: The observations do not determine the pose.
    """
    known = PackedPriors.of(posed.body.skeleton, others)
    if known is None or steps == 0:
        return solve_pose_step_by_step(posed, moments, others, steps=steps, stop=stop)
    rotation, translation, angles, hessian, solved = descend(
        posed.body.packed, posed.body.joint_centres, posed.pose.rotation, posed.pose.translation, posed.pose.angles,
        moments.pairs, moments.products, moments.linear, known, steps, stop,
    )  # fmt: skip
    if not solved:
        raise np.linalg.LinAlgError(UNDETERMINED)
    return replace(posed, pose=Pose(translation, rotation, angles)), hessian


def solve_pose_step_by_step(
    posed: PosedBody, moments: Moments, others: Sequence[Observation], *, steps: int, stop: float
) -> tuple[PosedBody, Floats]:
    """Solve as `solve_pose` does, for observations of any kind; the reference implementation of its kernel."""
    hessian: Floats = np.zeros(0)
    for _ in range(steps):
        hessian, gradient, _ = normal_equations(posed, moments)
        add_dense(posed, others, hessian, gradient)
        step = solve_step(hessian, gradient)
        posed = replace(posed, pose=posed.pose.step(step))
        if np.abs(step).max() < stop:
            break
    return posed, hessian


CameraMatches = tuple[list[SurfaceObservation], list[Floats]]
"""Matches of one camera, and their weights (n,)."""


def match_cameras(
    posed: PosedBody, sightings: Sequence[ObservedOutline], matching: OutlineMatchSettings, scale: float,
    late: Sequence[PosedBody] | None = None,
) -> list[CameraMatches]:  # fmt: skip
    """Match the surface in each camera; return the matches and their weights, camera by camera.

    A weight is the robust weight of the residual, times two for a pair that was found from both sides.

    Args:
        posed: The body.
        sightings: One for each camera.
        matching: Limits of a match.
        scale: Scale of the robust weights [px].
        late: The body in the pose in which each camera saw it, if that is another one: the matches are those of this
            pose, less the motion since then.
    """

    def weighted(outlines: list[OutlineMatches]) -> CameraMatches:
        return [outline.match for outline in outlines], [_weights(posed, outline, scale) for outline in outlines]

    if late is not None:
        tasks = zip(late, sightings, strict=True)
        seen = map_in_two_threads(lambda task: _matches_before_motion(posed, *task, matching), tasks)
    else:
        seen = map_in_two_threads(lambda sighting: all_matches(posed, sighting, matching), sightings)
    return [weighted(outlines) for outlines in seen]


def _weights(posed: PosedBody, outline: OutlineMatches, scale: float) -> Floats:
    match = outline.match
    return np.asarray(match_weights(
        *match.constraints(posed), posed.vertices, posed.body.faces, match.where.face, match.where.barycentric,
        outline.counts, scale,
    ))  # fmt: skip


def _matches_before_motion(
    posed: PosedBody, late: PosedBody, sighting: ObservedOutline, matching: OutlineMatchSettings
) -> list[OutlineMatches]:
    found = all_matches(late, sighting, matching)
    if late is posed:
        return found
    return [
        OutlineMatches(
            outline.match.before_motion(late.points(outline.match.where) - posed.points(outline.match.where)),
            outline.counts,
        )
        for outline in found
    ]


def joined_matches(cameras: Sequence[CameraMatches]) -> CameraMatches:
    """Return the matches of all cameras as those of one."""
    return list(chain.from_iterable(found for found, _ in cameras)), list(
        chain.from_iterable(weights for _, weights in cameras)
    )


def match_all(
    posed: PosedBody, sightings: Sequence[ObservedOutline], matching: OutlineMatchSettings, scale: float
) -> CameraMatches:
    """Match the surface in all cameras; return the matches and their weights, see `match_cameras`."""
    return joined_matches(match_cameras(posed, sightings, matching, scale))


def fit_pose(
    posed: PosedBody,
    sightings: Sequence[ObservedOutline],
    others: Sequence[Observation] = (JointLimits(),),
    *,
    schedule: Schedule,
    motions: Sequence[PictureMotion] | None = None,
) -> PoseFit:
    """Fit the pose of one frame to its silhouettes.

    Args:
        posed: Body at the start of the search.
        sightings: One for each camera in which the person was detected.
        others: Further observations; a body that the views do not determine needs a prior.
        schedule: Schedule by which gates and scales narrow.
        motions: Known motion of the body until each camera's picture; None if all pictures are of the frame's instant.
    """
    hessian: Floats = np.zeros(0)
    matches = 0
    for iteration in range(schedule.iterations):
        matching, scale = schedule.at(iteration)
        if motions is None and gives_moments(matching):
            moments, matches, *_ = match_moments(posed, sightings, matching, scale)
        else:
            late = None if motions is None else [motion.after(posed) for motion in motions]
            found, weights = joined_matches(match_cameras(posed, sightings, matching, scale, late))
            moments = gather_moments(posed, found, weights)
            matches = sum(len(match.where) for match in found)
        posed, hessian = solve_pose(posed, moments, others)
    return PoseFit(posed, hessian, matches)
