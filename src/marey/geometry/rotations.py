"""Rotations: exponential, logarithm and their derivatives, accurate down to the smallest angle."""

import numpy as np

from marey.arrays import Floats
from marey.compiled.kernels import kernel

_SERIES_BELOW = 1e-2
"""Angle below which the series are more accurate than the closed forms [rad]."""


def _coefficients(angle: Floats) -> tuple[Floats, Floats, Floats]:
    """Return sin(t)/t, (1 - cos t)/t^2 and (t - sin t)/t^3, all finite at t = 0."""
    small = angle < _SERIES_BELOW
    t = np.where(small, 1.0, angle)
    s = np.where(small, angle, 0.0) ** 2
    first = np.where(small, 1 - s / 6 + s**2 / 120, np.sin(t) / t)
    second = np.where(small, 0.5 - s / 24 + s**2 / 720, (1 - np.cos(t)) / t**2)
    third = np.where(small, 1 / 6 - s / 120 + s**2 / 5040, (t - np.sin(t)) / t**3)
    return first, second, third


def hat(vector: Floats) -> Floats:
    """Return the skew matrix whose product with b is the cross product of the vector and b ([Rosenhahn2006] eq. (7)).

    Args:
        vector: (..., 3).

    Returns:
        (..., 3, 3).
    """
    vector = np.asarray(vector, float)
    skew = np.zeros((*vector.shape, 3))
    for (row, column), k in zip(((2, 1), (0, 2), (1, 0)), range(3), strict=True):
        skew[..., row, column] = vector[..., k]
        skew[..., column, row] = -vector[..., k]
    return skew


def exp(vector: Floats) -> Floats:
    """Convert rotation vectors to rotation matrices ([Rosenhahn2006] eq. (9)).

    Args:
        vector: (..., 3) axis times angle [rad].

    Returns:
        (..., 3, 3).
    """
    first, second, _ = _coefficients(np.linalg.norm(vector, axis=-1))
    omega = hat(vector)
    return np.eye(3) + first[..., None, None] * omega + second[..., None, None] * (omega @ omega)


def log(rotation: Floats) -> Floats:
    """Convert rotation matrices to rotation vectors of an angle of at most pi.

    Args:
        rotation: (..., 3, 3).

    Returns:
        (..., 3) [rad].
    """
    quaternion = to_quaternion(rotation)
    quaternion = np.where(quaternion[..., :1] < 0, -quaternion, quaternion)
    length = np.linalg.norm(quaternion[..., 1:], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(length, quaternion[..., :1])
    scale = np.where(length < 1e-9, 2.0, angle / np.where(length < 1e-9, 1.0, length))
    return scale * quaternion[..., 1:]


def left_jacobian(vector: Floats) -> Floats:
    """Return J with exp(v + d) = exp(J d) exp(v) to first order.

    Args:
        vector: (..., 3) [rad].

    Returns:
        (..., 3, 3).
    """
    _, second, third = _coefficients(np.linalg.norm(vector, axis=-1))
    omega = hat(vector)
    return np.eye(3) + second[..., None, None] * omega + third[..., None, None] * (omega @ omega)


def inverse_left_jacobian(vector: Floats) -> Floats:
    """Return the inverse of the left Jacobian in closed form; the angle must be below 2 pi.

    Args:
        vector: (..., 3) [rad].

    Returns:
        (..., 3, 3).
    """
    angle = np.linalg.norm(vector, axis=-1)
    small = angle < _SERIES_BELOW
    t = np.where(small, 1.0, angle)
    closed = 1 / t**2 - 1 / (2 * t * np.tan(t / 2))
    third = np.where(small, 1 / 12 + angle**2 / 720 + angle**4 / 30240, closed)
    omega = hat(vector)
    return np.eye(3) - 0.5 * omega + third[..., None, None] * (omega @ omega)


def about(axis: Floats, angle: Floats) -> Floats:
    """Return the rotation by an angle about a unit axis.

    Args:
        axis: (..., 3) unit vectors.
        angle: (...) [rad].

    Returns:
        (..., 3, 3).
    """
    return exp(np.asarray(axis, float) * np.asarray(angle, float)[..., None])


def shortest(start: Floats, end: Floats) -> Floats:
    """Return the rotation of least angle that maps directions to others.

    Its axis is perpendicular to both; for opposite directions it is any such axis.

    Args:
        start: (..., 3) of any length.
        end: (..., 3).

    Returns:
        (..., 3, 3).
    """
    start, end = np.broadcast_arrays(start, end)
    across = np.cross(start, end)
    length = np.linalg.norm(across, axis=-1)
    angle = np.arctan2(length, np.sum(start * end, axis=-1))
    aligned = length < 1e-12 * np.linalg.norm(start, axis=-1) * np.linalg.norm(end, axis=-1)
    aside = np.cross(start, np.eye(3)[np.argmin(np.abs(start), axis=-1)])
    across = np.where(aligned[..., None], aside, across)
    length = np.linalg.norm(across, axis=-1)
    return about(across / np.where(length > 0, length, 1.0)[..., None], angle)


def mean(rotations: Floats) -> Floats:
    """Return the chordal mean of rotations, which is the rotation nearest to the mean matrix.

    Args:
        rotations: (n, 3, 3).

    Returns:
        (3, 3).
    """
    return nearest(np.mean(rotations, axis=0))


def nearest(matrix: Floats) -> Floats:
    """Return the proper rotation nearest to a matrix in the Frobenius norm.

    Args:
        matrix: (..., 3, 3).

    Returns:
        (..., 3, 3).
    """
    u, _, vt = np.linalg.svd(matrix)
    sign = np.ones(u.shape[:-1])
    sign[..., 2] = np.sign(np.linalg.det(u @ vt))
    return np.asarray((u * sign[..., None, :]) @ vt)


def to_quaternion(rotation: Floats) -> Floats:
    """Convert rotation matrices to unit quaternions.

    Args:
        rotation: (..., 3, 3).

    Returns:
        (..., 4) as w, x, y, z.
    """
    r = np.asarray(rotation, float)
    trace = np.trace(r, axis1=-2, axis2=-1)
    # Of four equivalent expressions, the one with the largest component is the most accurate.
    squares = np.stack([1 + trace] + [1 + 2 * r[..., i, i] - trace for i in range(3)], -1)
    w = np.stack(
        [squares[..., 0], *(r[..., (i + 2) % 3, (i + 1) % 3] - r[..., (i + 1) % 3, (i + 2) % 3] for i in range(3))], -1
    )
    candidates = [w]
    for i in range(3):
        row = [r[..., (i + 2) % 3, (i + 1) % 3] - r[..., (i + 1) % 3, (i + 2) % 3]]
        row += [squares[..., i + 1] if k == i else r[..., i, k] + r[..., k, i] for k in range(3)]
        candidates.append(np.stack(row, -1))
    best = np.argmax(squares, -1)
    chosen = np.take_along_axis(np.stack(candidates, -2), best[..., None, None], -2)[..., 0, :]
    return np.asarray(chosen / np.linalg.norm(chosen, axis=-1, keepdims=True))


def continuous(quaternions: Floats) -> Floats:
    """Choose the signs of quaternions (F, 4) so that none is opposite to the one before."""
    sign = np.where((quaternions[1:] * quaternions[:-1]).sum(1) < 0, -1.0, 1.0)
    return np.asarray(quaternions * np.concatenate([[1.0], np.cumprod(sign)])[:, None])


def from_quaternion(quaternion: Floats) -> Floats:
    """Convert quaternions to rotation matrices.

    Args:
        quaternion: (..., 4) as w, x, y, z; its length does not matter.

    Returns:
        (..., 3, 3).
    """
    q = np.asarray(quaternion, float)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    w, v = q[..., :1, None], q[..., 1:]
    omega = hat(v)
    return np.asarray(np.eye(3) + 2 * w * omega + 2 * omega @ omega)


@kernel
def turn_about(axis, angle, out):  # pragma: no cover - compiled
    """Write the rotation by an angle about a unit axis to out (3, 3): `about` for kernels."""
    s = np.sin(angle)
    c = 1.0 - np.cos(angle)
    x, y, z = axis[0], axis[1], axis[2]
    out[0, 0] = 1.0 - c * (y * y + z * z)
    out[0, 1] = -s * z + c * x * y
    out[0, 2] = s * y + c * x * z
    out[1, 0] = s * z + c * x * y
    out[1, 1] = 1.0 - c * (x * x + z * z)
    out[1, 2] = -s * x + c * y * z
    out[2, 0] = -s * y + c * x * z
    out[2, 1] = s * x + c * y * z
    out[2, 2] = 1.0 - c * (x * x + y * y)


@kernel
def turn_between(first, second):  # pragma: no cover - compiled
    """Return the rotation vector (3,) from one rotation (3, 3) to another: log(second first') for kernels."""
    r = np.empty((3, 3))
    for a in range(3):
        for b in range(3):
            r[a, b] = second[a, 0] * first[b, 0] + second[a, 1] * first[b, 1] + second[a, 2] * first[b, 2]
    # The quaternion from its largest component, as `to_quaternion`.
    trace = r[0, 0] + r[1, 1] + r[2, 2]
    best, largest = 0, 1.0 + trace
    for i in range(3):
        if 1.0 + 2.0 * r[i, i] - trace > largest:
            best, largest = i + 1, 1.0 + 2.0 * r[i, i] - trace
    q = np.empty(4)
    q[best] = largest
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        if best == 0:
            q[i + 1] = r[k, j] - r[j, k]
        elif best == i + 1:
            q[0] = r[k, j] - r[j, k]
            q[j + 1], q[k + 1] = r[i, j] + r[j, i], r[i, k] + r[k, i]
    sine = np.sqrt(q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    if q[0] < 0.0:
        q *= -1.0
    scale = 2.0 / q[0] if sine < 1e-9 * q[0] else 2.0 * np.arctan2(sine, q[0]) / sine
    return scale * q[1:]


@kernel
def inverse_left_jacobian_of(vector):  # pragma: no cover - compiled
    """Return `inverse_left_jacobian` (3, 3) of one vector, for kernels."""
    x, y, z = vector[0], vector[1], vector[2]
    squared = x * x + y * y + z * z
    if squared < _SERIES_BELOW**2:
        third = 1.0 / 12.0 + squared / 720.0 + squared * squared / 30240.0
    else:
        angle = np.sqrt(squared)
        third = 1.0 / squared - 1.0 / (2.0 * angle * np.tan(0.5 * angle))
    omega = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    out = np.empty((3, 3))
    for a in range(3):
        for b in range(3):
            t = (1.0 if a == b else 0.0) - 0.5 * omega[a, b]
            for c in range(3):
                t += third * omega[a, c] * omega[c, b]
            out[a, b] = t
    return out
