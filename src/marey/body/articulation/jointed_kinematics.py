"""Forward kinematics of a jointed body, with the derivatives by every coordinate."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats
from marey.body.articulation.jointed_body import JointedBody
from marey.compiled.kernel_copies import copy_matrix, copy_row
from marey.compiled.kernels import kernel
from marey.geometry import rotations, twists
from marey.geometry.rotations import turn_about


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
def new_state(packed):
    """Allocate the arrays that `place_bodies` fills."""
    bodies, motions = packed.parents.shape[0], packed.turns.shape[0]
    return (
        np.empty((bodies, 3, 3)), np.empty((bodies, 3)), np.empty((motions, 3)), np.empty((motions, 3)),
        np.empty(motions),
    )  # fmt: skip


@kernel
def place_bodies(packed, values, rotation, origin, world_axes, world_points, motion_slope):
    """Place the bodies: rotation (B, 3, 3), origin (B, 3); axes and points (E, 3) in the ground, slopes (E,)."""
    turn, product = np.empty((3, 3)), np.empty((3, 3))
    now, start = np.empty((3, 3)), np.empty(3)
    for k in range(packed.parents.shape[0]):
        parent = packed.parents[k]
        if parent < 0:
            copy_matrix(now, packed.before_rotation[k])
            copy_row(start, packed.before_translation[k])
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
                copy_matrix(now, product)
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


@kernel(inline="always")
def point_on_body(rotation, origin, body, place):
    """Return the position in the ground of a point on a body; body -1 is the ground itself."""
    if body < 0:
        return place[0], place[1], place[2]
    r, o = rotation[body], origin[body]
    return (
        o[0] + r[0, 0] * place[0] + r[0, 1] * place[1] + r[0, 2] * place[2],
        o[1] + r[1, 0] * place[0] + r[1, 1] * place[1] + r[1, 2] * place[2],
        o[2] + r[2, 0] * place[0] + r[2, 1] * place[1] + r[2, 2] * place[2],
    )


@kernel
def point_rows(packed, body, p, axes, points, motion_slope, variable, slope, rows, used):
    """Write a point's derivatives by the coordinates into rows (N, 3), list them in used, and return their number."""
    number = 0
    k = body
    while k >= 0:
        for e in range(packed.first[k], packed.first[k + 1]):
            c = packed.coordinate[e]
            if c < 0:
                continue
            a = variable[c]
            s = motion_slope[e] * slope[c]
            known = False
            for i in range(number):
                known = known or used[i] == a
            if not known:
                used[number] = a
                number += 1
                rows[a, 0] = rows[a, 1] = rows[a, 2] = 0.0
            u, q = axes[e], points[e]
            if packed.turns[e]:
                d0, d1, d2 = p[0] - q[0], p[1] - q[1], p[2] - q[2]
                rows[a, 0] += s * (u[1] * d2 - u[2] * d1)
                rows[a, 1] += s * (u[2] * d0 - u[0] * d2)
                rows[a, 2] += s * (u[0] * d1 - u[1] * d0)
            else:
                rows[a, 0] += s * u[0]
                rows[a, 1] += s * u[1]
                rows[a, 2] += s * u[2]
        k = packed.parents[k]
    return number


@kernel
def linearised(packed, body, place, values):
    """Linearise the markers, bodies and coupled coordinates of a posture.

    Args:
        packed: The body.
        body: (M,) index of each marker's body, -1 for the ground.
        place: (M, 3) position of each marker on its body [m].
        values: (N,) the posture; coupled coordinates are overwritten.

    Returns:
        Points (M, 3) and jacobian (M, 3, N) of the markers; rotation (B, 3, 3) and origin (B, 3) of the bodies and
        their derivatives (B, 6, N): the rotation about the body's own axes, then the origin in the ground; derivatives
        (N, N) of the coordinates by those that are not coupled to another one.
    """
    count = values.shape[0]
    state = new_state(packed)
    rotation, origin, axes, points, motion_slope = state
    variable, slope = np.empty(count, np.int64), np.empty(count)
    follow(packed, values, variable, slope)
    place_bodies(packed, values, rotation, origin, axes, points, motion_slope)
    rows, used = np.empty((count, 3)), np.empty(count, np.int64)
    posed = np.empty((body.shape[0], 3))
    jacobian = np.zeros((body.shape[0], 3, count))
    for m in range(body.shape[0]):
        p = point_on_body(rotation, origin, body[m], place[m])
        number = point_rows(packed, body[m], p, axes, points, motion_slope, variable, slope, rows, used)
        for a in range(3):
            posed[m, a] = p[a]
            for i in range(number):
                jacobian[m, a, used[i]] = rows[used[i], a]
    moved = np.zeros((rotation.shape[0], 6, count))
    for k in range(rotation.shape[0]):
        o = (origin[k, 0], origin[k, 1], origin[k, 2])
        number = point_rows(packed, k, o, axes, points, motion_slope, variable, slope, rows, used)
        for i in range(number):
            for a in range(3):
                moved[k, 3 + a, used[i]] = rows[used[i], a]
        j = k
        while j >= 0:
            for e in range(packed.first[j], packed.first[j + 1]):
                c = packed.coordinate[e]
                if c >= 0 and packed.turns[e]:
                    s = motion_slope[e] * slope[c]
                    for a in range(3):
                        turn = rotation[k, 0, a] * axes[e, 0] + rotation[k, 1, a] * axes[e, 1]
                        moved[k, a, variable[c]] += s * (turn + rotation[k, 2, a] * axes[e, 2])
            j = packed.parents[j]
    slopes = np.zeros((count, count))
    for c in range(count):
        slopes[c, variable[c]] = slope[c]
    return posed, jacobian, rotation, origin, moved, slopes
