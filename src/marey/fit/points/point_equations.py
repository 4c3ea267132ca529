"""Normal equations of points on metaballs, summed point by point without an array of all derivatives.

A point's distance depends on a few numbers and on the motion of a few segments only. Its terms are added to a square
matrix over all numbers and all segments' shifts and rotations; finally, one product converts segments to the pose's
coordinates ([Plaenkers1999] eq. (2), (14)).
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from marey.arrays import Floats, Integers
from marey.body.articulation import kinematics
from marey.body.articulation.pose import PosedBody
from marey.body.articulation.skeleton import LIMBS
from marey.body.metaballs.metaball_field import THRESHOLD, distance_of_level, log_field
from marey.body.metaballs.metaball_person import MetaballSpace
from marey.body.metaballs.metaballs import Metaballs, PosedMetaballs
from marey.compiled.kernels import kernel
from marey.observations.metaball_points import PointsOnMetaballs

_LEAST_SHARE = 1e-6
"""Balls with a smaller share of a point's field are ignored; the effect on the normal equations is of this order."""


class NumbersOfBalls(NamedTuple):
    """Derivatives of the balls by the numbers that move them: ball m has the entries start[m] to start[m + 1]."""

    start: Integers
    """(M + 1,)."""
    number: Integers
    """(E,)."""
    radii: Floats
    """(E, 3) [m by unit of the number]."""
    centre: Floats
    """(E, 3)."""
    log_weight: Floats
    """(E,)."""

    @staticmethod
    def of(space: MetaballSpace, balls: Metaballs) -> "NumbersOfBalls":
        """List the nonzero derivatives of a space's balls by its numbers."""
        radii, log_weight = space.rates(balls)
        moves = np.any(radii != 0.0, axis=2) | np.any(space.centre_modes != 0.0, axis=2) | (log_weight != 0.0)
        ball, number = np.nonzero(moves.T)
        start = np.concatenate([[0], np.cumsum(np.bincount(ball, minlength=moves.shape[1]))])
        parts = (start, number, radii[number, ball], space.centre_modes[number, ball], log_weight[number, ball])
        return NumbersOfBalls(*(np.ascontiguousarray(part) for part in parts))


class BallsOfLimbs(NamedTuple):
    """Balls that contribute to the field at a point of each limb, see `Metaballs`; on the trunk, all balls."""

    start: Integers
    """(L + 1,)."""
    ball: Integers
    """(E,) indices of balls."""

    @staticmethod
    def of(limb: Integers) -> "BallsOfLimbs":
        """List the balls of the trunk and of each limb, given every ball's limb (M,)."""
        lists = [np.flatnonzero((limb == 0) | (limb == k) | (k == 0)) for k in range(len(LIMBS))]
        return BallsOfLimbs(np.concatenate([[0], np.cumsum([len(own) for own in lists])]), np.concatenate(lists))


@dataclass(frozen=True, eq=False)
class PointEquations:
    """Normal equations of measured points for pose and numbers."""

    hessian: Floats
    """(D + N, D + N)."""
    gradient: Floats
    """(D + N,)."""
    residual: Floats
    """(n,) residuals without weights: distances [m], or F - 1/2."""
    weight: Floats
    """(n,) robust weights."""


def point_equations(
    posed: PosedBody, observed: PointsOnMetaballs, *, scale: float = np.inf, as_distance: bool = True
) -> PointEquations:
    """Assemble the normal equations of measured points for pose and numbers.

    Args:
        posed: The body.
        observed: The points.
        scale: Residual at which a point has a quarter of its weight [m], see `weights.geman_mcclure`.
        as_distance: Whether the residual is a distance; else it is the paper's F - 1/2 ([Plaenkers1999] eq. (14)), with
            `spread` in its unit.
    """
    surface, space = observed.surface(posed), observed.space
    balls, numbers, segments = surface.balls, len(space), len(posed.body.skeleton.segment_names)
    size = numbers + 6 * segments
    square, linear = np.zeros((size, size)), np.zeros(size)
    residual, weight = np.empty(len(observed)), np.empty(len(observed))
    add_points(
        observed.points, observed.limb, observed.spread, scale, as_distance, BallsOfLimbs.of(balls.limb),
        NumbersOfBalls.of(space, balls), balls.limb, balls.segment, surface.place, surface.axes, balls.rotation,
        balls.radii, np.log(balls.weight), surface.segment_origin[0], len(LIMBS), numbers, square, linear, residual,
        weight,
    )  # fmt: skip
    by_parameters = _by_parameters(surface, space)
    used = np.flatnonzero(np.diag(square))
    by_parameters = by_parameters[used]
    whole = square[np.ix_(used, used)]
    whole = whole + np.triu(whole, 1).T
    hessian = by_parameters.T @ whole @ by_parameters
    return PointEquations(hessian, by_parameters.T @ linear[used], residual, weight)


def distances_of(posed: PosedBody, observed: PointsOnMetaballs) -> Floats:
    """Return the points' distances (n,) from the surface [m]."""
    return observed.surface(posed).distance(observed.points, observed.limb)


def _by_parameters(surface: PosedMetaballs, space: MetaballSpace) -> Floats:
    """Return the derivatives (N + 6 S, D + N) of `add_points`' columns by pose and numbers."""
    moves = moves_of_segments(surface, space)
    degrees, numbers = len(surface.balls.skeleton), len(space)
    alone = np.concatenate([np.zeros((numbers, degrees)), np.eye(numbers)], 1)
    return np.concatenate([alone, moves.reshape(-1, degrees + numbers)])


def moves_of_segments(surface: PosedMetaballs, space: MetaballSpace) -> Floats:
    """Return the derivatives (S, 6, D + N) of segments' shifts, and rotations about the root, by pose and numbers."""
    skeleton, numbers = surface.balls.skeleton, len(space)
    origin, axes = surface.segment_origin, surface.world_axes
    segments, degrees = len(origin), len(skeleton)
    moves = np.zeros((segments, 6, degrees + numbers))
    moves[:, :3, :3] = np.eye(3)
    moves[:, 3:, 3:6] = np.eye(3)
    above = skeleton.above()
    for q, k in enumerate(skeleton.coordinate_segment):
        carried = above[:, k]
        # A rotation about the joint is one about the root's origin, and a shift.
        moves[carried, :3, 6 + q] = np.cross(axes[q], origin[0] - origin[k])
        moves[carried, 3:, 6 + q] = axes[q]
    shifted, _ = kinematics.origin_modes(surface.balls.packed.parents, surface.segment_rotation, space.joint_modes)
    moves[:, :3, degrees:] = np.swapaxes(shifted, 1, 2)
    return moves


@kernel
def add_points(
    points, limbs, spread, scale, as_distance, of_limbs, of_balls, ball_limb, segment, place, axes, rotation, radii,
    log_weight, origin, limb_count, numbers, square, linear, residuals, weights,
):  # fmt: skip
    """Add the terms of points (n, 3) to the upper triangle of square and to linear; write residuals and robust weights.

    Columns: the numbers, then for each segment its shift and its rotation about the origin. The derivatives are those
    of `metaball_field.linearize`.
    """
    balls = radii.shape[0]
    local, rise, share = np.empty((balls, 3)), np.empty((balls, 3)), np.empty(balls)
    listed = np.empty(balls, np.int64)
    top, total, slope = np.empty(limb_count), np.empty(limb_count), np.empty(3)
    centre = _within_balls(of_balls, rotation)
    row, values = np.zeros(square.shape[0]), np.empty(square.shape[0])
    columns, moved = np.empty(square.shape[0], np.int64), np.zeros(square.shape[0], np.bool_)
    for i in range(points.shape[0]):
        limb = limbs[i]
        own = of_limbs.ball[of_limbs.start[max(limb, 0)] : of_limbs.start[max(limb, 0) + 1]]
        count, level = _evaluate_field(
            points[i],
            limb,
            own,
            ball_limb,
            place,
            axes,
            radii,
            log_weight,
            local,
            rise,
            share,
            top,
            total,
            slope,
            listed,
        )
        steep = slope[0] ** 2 + slope[1] ** 2 + slope[2] ** 2
        if as_distance:
            residual, first, second = distance_of_level(level, steep)
        else:
            residual, first, second = THRESHOLD * np.expm1(level), THRESHOLD * np.exp(level), 0.0
        residuals[i] = residual
        weights[i] = 1.0 / (1.0 + (residual / scale) ** 2) ** 2
        used = 0
        for j in range(count):
            used = _add_ball(
                listed[j], share[listed[j]], first, second, slope, steep, local, rise, axes, radii, segment, of_balls,
                centre, numbers, points[i], origin, row, moved, columns, used,
            )  # fmt: skip
        columns[:used].sort()
        weight = weights[i] / spread[i] ** 2
        for a in range(used):
            values[a] = row[columns[a]]
            row[columns[a]] = 0.0
            moved[columns[a]] = False
        for a in range(used):
            left = weight * values[a]
            linear[columns[a]] += left * residual
            line = square[columns[a]]
            for b in range(a, used):
                line[columns[b]] += left * values[b]


@kernel
def _within_balls(of_balls, rotation):
    """Return the derivatives (E, 3) of the balls' centres by the numbers, along the balls' axes."""
    turned = np.zeros_like(of_balls.centre)
    for m in range(len(rotation)):
        for e in range(of_balls.start[m], of_balls.start[m + 1]):
            for a in range(3):
                for b in range(3):
                    turned[e, a] += rotation[m, b, a] * of_balls.centre[e, b]
    return turned


@kernel
def _evaluate_field(
    point, limb, own, ball_limb, place, axes, radii, log_weight, local, rise, share, top, total, slope, listed
):  # fmt: skip
    """Evaluate the field at a point: write positions in the balls, gradients and shares, see `metaball_field`.

    Returns:
        The number of listed balls, and ln(F / T).
    """
    top[:] = -np.inf
    total[:] = 0.0
    for m in own:
        share[m] = log_field(m, point, place, axes, radii, log_weight[m], local)
        top[ball_limb[m]] = max(top[ball_limb[m]], share[m])
    best, level = limb, -np.inf
    for m in own:
        total[ball_limb[m]] += np.exp(max(share[m] - top[ball_limb[m]], -40.0))
    if limb < 1:
        for k in range(1, top.shape[0]):
            if total[k] > 0.0 and top[k] + np.log(total[k]) > level:
                best, level = k, top[k] + np.log(total[k])
    high = max(top[0], top[best])
    total_field = 0.0
    for k in (0, best):
        total_field += total[k] * np.exp(top[k] - high) if total[k] > 0.0 else 0.0
    level = high + np.log(total_field)
    count = 0
    slope[:] = 0.0
    for m in own:
        share[m] = np.exp(share[m] - level) if ball_limb[m] == 0 or ball_limb[m] == best else 0.0
        if share[m] > _LEAST_SHARE:
            listed[count] = m
            count += 1
            for b in range(3):
                rise[m, b] = 0.0
            for a in range(3):
                along = -4.0 * local[m, a] / radii[m, a] ** 2
                for b in range(3):
                    rise[m, b] += along * axes[m, a, b]
            for b in range(3):
                slope[b] += share[m] * rise[m, b]
    return count, level - np.log(THRESHOLD)


@kernel
def _add_ball(
    m, share, first, second, slope, steep, local, rise, axes, radii, segment, of_balls, centre, numbers, point, origin,
    row, moved, columns, used,
):  # fmt: skip
    """Add one ball's terms to a point's row; return the number of columns in use."""
    along = rise[m, 0] * slope[0] + rise[m, 1] * slope[1] + rise[m, 2] * slope[2]
    u = share * (first + second * (along - steep))
    v = share * second
    base = numbers + 6 * segment[m]
    if not moved[base]:
        for a in range(6):
            moved[base + a] = True
            columns[used + a] = base + a
        used += 6
    by_radius, by_place = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    shift0 = shift1 = shift2 = 0.0
    for a in range(3):
        g = axes[m, a, 0] * slope[0] + axes[m, a, 1] * slope[1] + axes[m, a, 2] * slope[2]
        curve = 4.0 / radii[m, a] ** 2
        along_radius = (u * local[m, a] + 2.0 * v * g) * local[m, a] * curve / radii[m, a]
        along_axis = curve * (u * local[m, a] + v * g)
        by_radius = (by_radius[1], by_radius[2], along_radius)
        by_place = (by_place[1], by_place[2], along_axis)
        shift0 += along_axis * axes[m, a, 0]
        shift1 += along_axis * axes[m, a, 1]
        shift2 += along_axis * axes[m, a, 2]
    grown, place = of_balls.radii, centre
    for e in range(of_balls.start[m], of_balls.start[m + 1]):
        number = of_balls.number[e]
        if not moved[number]:
            moved[number] = True
            columns[used] = number
            used += 1
        row[number] += (
            u * of_balls.log_weight[e]
            + by_radius[0] * grown[e, 0] + by_radius[1] * grown[e, 1] + by_radius[2] * grown[e, 2]
            + by_place[0] * place[e, 0] + by_place[1] * place[e, 1] + by_place[2] * place[e, 2]
        )  # fmt: skip
    turned0 = v * (rise[m, 1] * slope[2] - rise[m, 2] * slope[1])
    turned1 = v * (rise[m, 2] * slope[0] - rise[m, 0] * slope[2])
    turned2 = v * (rise[m, 0] * slope[1] - rise[m, 1] * slope[0])
    x, y, z = point[0] - origin[0], point[1] - origin[1], point[2] - origin[2]
    row[base] += shift0
    row[base + 1] += shift1
    row[base + 2] += shift2
    row[base + 3] += turned0 + y * shift2 - z * shift1
    row[base + 4] += turned1 + z * shift0 - x * shift2
    row[base + 5] += turned2 + x * shift1 - y * shift0
    return used
