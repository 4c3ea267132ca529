"""Ray casting from within the body to the metaballs' surface."""

import numpy as np

from marey.arrays import Floats
from marey.body.articulation.skeleton import LIMBS
from marey.body.metaballs.metaballs import ANY_LIMB, THRESHOLD, PosedMetaballs
from marey.compiled.kernels import kernel

_LIMB_COUNT = len(LIMBS)
"""Number of limbs, as a compile-time constant of the kernels."""
_STEPS = 32
"""Number of points at which a ray is tried."""
_ROUNDS = 8
"""Largest number of false-position steps that narrow the interval of the exit."""
_FAR = 50.0
"""Exponent beyond which a ball's field is negligible beside the threshold: exp(-50) is 2e-22."""


def exits(posed: PosedMetaballs, origins: Floats, directions: Floats, limb: int = ANY_LIMB, *, reach: float) -> Floats:
    """Return the points where rays first leave the surface ([Plaenkers1999] section 3.1).

    Args:
        posed: The metaballs.
        origins: (..., 3) [m], inside, or before the interval that is inside.
        directions: (..., 3) of any length.
        limb: Limb whose field is added to the trunk's, see `PosedMetaballs.field`.
        reach: Length of the rays [m]. Parts thinner than a thirtieth of it may be missed.

    Returns:
        (..., 3) [m], NaN where a ray is never inside or does not leave the body within reach.
    """
    shape = np.broadcast_shapes(np.shape(origins), np.shape(directions))
    start = np.ascontiguousarray(np.broadcast_to(origins, shape).reshape(-1, 3), float)
    along = np.broadcast_to(directions, shape).reshape(-1, 3)
    along = np.ascontiguousarray(along / np.linalg.norm(along, axis=1, keepdims=True))
    balls = posed.balls
    active = np.isin(balls.limb, (0, limb)) if limb > 0 else np.ones(len(balls), bool)
    # Points in units of the radii along each ball's axes. A separate sum, because rays need the level only, for which
    # `metaball_field.log_field` takes 1/6 longer.
    inward = np.ascontiguousarray((posed.axes / balls.radii[:, :, None])[active])
    place, weight = np.ascontiguousarray(posed.place[active]), np.ascontiguousarray(balls.weight[active])
    found = first_exits(start, along, float(reach), np.ascontiguousarray(balls.limb[active]), place, inward, weight)
    return np.asarray((start + found[:, None] * along).reshape(shape))


@kernel
def _level(point, ball_limb, place, inward, weight, total):
    """Return ln(F / T) of the trunk's balls and those of the limb with the greatest field; total (L,) is scratch."""
    total[:] = 0.0
    for m in range(weight.shape[0]):
        d = 0.0
        for a in range(3):
            y = 0.0
            for b in range(3):
                y += inward[m, a, b] * (point[b] - place[m, b])
            d += y * y
        if 2.0 * d < _FAR:
            total[ball_limb[m]] += weight[m] * np.exp(-2.0 * d)
    field = total[0] + total[1:].max()
    return np.log(max(field, 1e-300) / THRESHOLD)


@kernel
def first_exits(origins, ways, reach, ball_limb, place, inward, weight):
    """Return the distances (n,) along rays where the level first changes from positive to negative, NaN for none.

    Points along the rays are tried in turn; the interval of the exit is narrowed by false position, in which an end
    that is kept again counts half (Illinois).
    """
    found = np.full(origins.shape[0], np.nan)
    total = np.empty(_LIMB_COUNT)
    for i in range(origins.shape[0]):
        near, near_level = 0.0, _level(origins[i], ball_limb, place, inward, weight, total)
        for k in range(1, _STEPS + 1):
            far = reach * k / _STEPS
            far_level = _level(origins[i] + far * ways[i], ball_limb, place, inward, weight, total)
            if near_level > 0.0 and far_level <= 0.0:
                break
            near, near_level = far, far_level
        else:
            continue
        kept = 0
        for _ in range(_ROUNDS):
            middle = (near * far_level - far * near_level) / (far_level - near_level)
            level = _level(origins[i] + middle * ways[i], ball_limb, place, inward, weight, total)
            if level > 0.0:
                near, near_level = middle, level
                far_level *= 0.5 if kept > 0 else 1.0
                kept = 1
            else:
                far, far_level = middle, level
                near_level *= 0.5 if kept < 0 else 1.0
                kept = -1
            if abs(level) < 1e-9:
                break
        found[i] = middle
    return found
