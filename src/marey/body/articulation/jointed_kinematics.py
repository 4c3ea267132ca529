"""Forward kinematics of a jointed body, with the derivatives by every coordinate."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Integers
from marey.body.articulation.jointed_body import JointedBody
from marey.geometry import rotations, twists
from marey.geometry.rotations import turn_about
from marey.kernels import kernel


@dataclass(frozen=True, eq=False, kw_only=True)
class PlacedBodies:
    """A jointed body in one posture."""

    rotation: Floats
    """(B, 3, 3) ground from body."""
    origin: Floats
    """(B, 3) in the ground [m]."""
    twists: Floats
    """(B, N, 6) derivative of each body's motion by each coordinate: velocity of the ground's origin, then angular
    velocity, per [rad] or [m]."""


def place(body: JointedBody, values: Floats) -> PlacedBodies:
    """Compute the position of each body; the reference implementation of the kernel `place_bodies`.

    Each joint is a chain of twists whose sizes are functions of the coordinates ([Lu1999], in the exponentials of
    [Rosenhahn2006] eq. (12)). Twists are the derivatives, with couplings by the chain rule.

    Args:
        body: The body.
        values: (N,) the coordinates, with couplings applied [rad or m].
    """
    count, number = len(body.bodies), len(body.coordinates)
    rotation, origin = np.empty((count, 3, 3)), np.empty((count, 3))
    moved = np.zeros((count, number, 6))
    slopes = coordinate_slopes(body, values)
    for k, part in enumerate(body.bodies):
        parent = None if part.parent is None else body.body_names.index(part.parent)
        turn, start = (np.eye(3), np.zeros(3)) if parent is None else (rotation[parent], origin[parent])
        if parent is not None:
            moved[k] = moved[parent]
        start = start + turn @ part.before.translation
        turn = turn @ part.before.rotation
        for motion in part.motions:
            index = None if motion.coordinate is None else body.coordinate(motion.coordinate)
            size, slope = motion.function.at(0.0 if index is None else values[index])
            axis = turn @ motion.axis
            if index is not None:
                twist = twists.about_axis(start, axis) if motion.turns else np.concatenate([axis, np.zeros(3)])
                moved[k] += slope * slopes[index][:, None] * twist
            if motion.turns:
                turn = turn @ rotations.about(motion.axis, size)
            else:
                start = start + axis * size
        origin[k] = start + turn @ part.after.translation
        rotation[k] = turn @ part.after.rotation
    return PlacedBodies(rotation=rotation, origin=origin, twists=moved)


def coordinate_slopes(body: JointedBody, values: Floats) -> Floats:
    """Return the derivatives (N, N) of the coordinates by those that are not coupled to another one."""
    packed = body.packed
    functions = {c.dependent: c.function for c in body.couplings}
    slopes = np.eye(len(body.coordinates))
    for c in packed.order:
        if packed.source[c] >= 0:
            slopes[c] = functions[body.coordinates[c].name].at(values[packed.source[c]])[1] * slopes[packed.source[c]]
    return slopes


@kernel
def function_at(functions, which, x):
    """Return value and slope of one of several packed functions at x."""
    begin, end = functions.first[which], functions.first[which + 1]
    piece = begin
    while piece + 1 < end and functions.starts[piece + 1] <= x:
        piece += 1
    distance = x - functions.starts[piece]
    value = slope = 0.0
    for k in range(functions.coefficients.shape[1] - 1, -1, -1):
        slope = slope * distance + value
        value = value * distance + functions.coefficients[piece, k]
    return value, slope


@kernel
def follow(packed, values, variable, slope):
    """Apply the couplings, and write for each coordinate the free one it depends on (N,) and its slope (N,)."""
    for n in range(packed.order.shape[0]):
        c = packed.order[n]
        source = packed.source[c]
        variable[c] = c
        slope[c] = 1.0
        if source >= 0:
            values[c], own = function_at(packed.coupling_functions, c, values[source])
            variable[c] = variable[source]
            slope[c] = own * slope[source]


@kernel
def place_bodies(packed, values, rotation, origin, world_axes, world_points, motion_slope):
    """Place the bodies: rotation (B, 3, 3), origin (B, 3); axes and points (E, 3) in the ground, slopes (E,)."""
    turn, product = np.empty((3, 3)), np.empty((3, 3))
    now, start = np.empty((3, 3)), np.empty(3)
    for k in range(packed.parents.shape[0]):
        parent = packed.parents[k]
        if parent < 0:
            now[:] = packed.before_rotation[k]
            start[:] = packed.before_translation[k]
        else:
            _product(rotation[parent], packed.before_rotation[k], now)
            for a in range(3):
                start[a] = origin[parent, a] + _row(rotation[parent], a, packed.before_translation[k])
        for e in range(packed.first[k], packed.first[k + 1]):
            c = packed.coordinate[e]
            size, motion_slope[e] = function_at(packed.motion_functions, e, values[c] if c >= 0 else 0.0)
            for a in range(3):
                world_axes[e, a] = _row(now, a, packed.axes[e])
                world_points[e, a] = start[a]
            if packed.turns[e]:
                turn_about(packed.axes[e], size, turn)
                _product(now, turn, product)
                now[:] = product
            else:
                for a in range(3):
                    start[a] += size * world_axes[e, a]
        for a in range(3):
            origin[k, a] = start[a] + _row(now, a, packed.after_translation[k])
        _product(now, packed.after_rotation[k], rotation[k])


@kernel(inline="always")
def _row(matrix, a, vector):
    return matrix[a, 0] * vector[0] + matrix[a, 1] * vector[1] + matrix[a, 2] * vector[2]


@kernel(inline="always")
def _product(left, right, out):
    for a in range(3):
        for b in range(3):
            out[a, b] = left[a, 0] * right[0, b] + left[a, 1] * right[1, b] + left[a, 2] * right[2, b]


def marker_bodies(body: JointedBody, labels: tuple[str, ...]) -> tuple[Integers, Floats]:
    """Return the bodies (M,), -1 for the ground, and positions (M, 3) [m] of some of a body's markers."""
    known = {m.label: m for m in body.markers}
    chosen = [known[label] for label in labels]
    index = [-1 if m.body is None else body.body_names.index(m.body) for m in chosen]
    return np.array(index, np.int64), np.array([m.place for m in chosen], float).reshape(-1, 3)
