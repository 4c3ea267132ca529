"""Best-fitting rotation between two sets of vectors, for kernels."""

import math

from marey.compiled.kernels import kernel

_SWEEPS = 12
"""Largest number of sweeps over the elements off the diagonal; four or five suffice for double precision."""
_SMALL = 1e-30
"""Sum of squares off the diagonal, relative to that of all elements, that ends the sweeps."""


@kernel
def fit_rotation(cross, work, out):
    """Write the rotation that maps one set of vectors to another with the least sum of squares.

    The quaternion is the eigenvector of the largest eigenvalue of a symmetric 4 x 4 matrix [Horn1987], found by
    Jacobi's rotations.

    Args:
        cross: (3, 3) sum of the products of each vector afterwards (row) and before (column), with their weights.
        work: (2, 4, 4) work array.
        out: (3, 3) for the rotation.
    """
    square, vectors = work[0], work[1]
    xx, xy, xz = cross[0, 0], cross[1, 0], cross[2, 0]
    yx, yy, yz = cross[0, 1], cross[1, 1], cross[2, 1]
    zx, zy, zz = cross[0, 2], cross[1, 2], cross[2, 2]
    square[0, 0], square[1, 1] = xx + yy + zz, xx - yy - zz
    square[2, 2], square[3, 3] = yy - xx - zz, zz - xx - yy
    square[0, 1], square[0, 2], square[0, 3] = yz - zy, zx - xz, xy - yx
    square[1, 2], square[1, 3], square[2, 3] = xy + yx, zx + xz, yz + zy
    _find_eigenvectors(square, vectors)
    best = 0
    for k in range(1, 4):
        if square[k, k] > square[best, best]:
            best = k
    w, x, y, z = vectors[0, best], vectors[1, best], vectors[2, best], vectors[3, best]
    out[0, 0], out[0, 1], out[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    out[1, 0], out[1, 1], out[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    out[2, 0], out[2, 1], out[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)


@kernel
def _find_eigenvectors(square, vectors):
    """Diagonalise a symmetric matrix, of which the upper half is given, and write its eigenvectors as columns."""
    count, total = square.shape[0], 0.0
    for i in range(count):
        for j in range(count):
            vectors[i, j] = 1.0 if i == j else 0.0
            if j >= i:
                total += square[i, j] ** 2
    for _ in range(_SWEEPS):
        off = 0.0
        for i in range(count - 1):
            for j in range(i + 1, count):
                off += square[i, j] ** 2
        if not off > _SMALL * total:
            return
        for i in range(count - 1):
            for j in range(i + 1, count):
                if square[i, j] != 0.0:
                    _eliminate(square, vectors, i, j)


@kernel
def _eliminate(square, vectors, i, j):
    """Make one element off the diagonal zero by a rotation in the plane of two axes."""
    ratio = 0.5 * (square[j, j] - square[i, i]) / square[i, j]
    tangent = 1.0 / (abs(ratio) + math.sqrt(1.0 + ratio * ratio))
    if ratio < 0:
        tangent = -tangent
    cosine = 1.0 / math.sqrt(1.0 + tangent * tangent)
    sine = tangent * cosine
    square[i, i] -= tangent * square[i, j]
    square[j, j] += tangent * square[i, j]
    square[i, j] = 0.0
    for k in range(square.shape[0]):
        if k not in (i, j):
            first_row, first_column = min(k, i), max(k, i)
            other_row, other_column = min(k, j), max(k, j)
            first, other = square[first_row, first_column], square[other_row, other_column]
            square[first_row, first_column] = cosine * first - sine * other
            square[other_row, other_column] = sine * first + cosine * other
        first, other = vectors[k, i], vectors[k, j]
        vectors[k, i], vectors[k, j] = cosine * first - sine * other, sine * first + cosine * other
