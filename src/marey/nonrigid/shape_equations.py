"""Equations of the mean shape and all displacements together: points before the camera, neighbours at a distance."""

import numpy as np

from marey.arrays import Floats, Integers

ROUNDS = 80
STILL = 1e-5


def solve_shape_equations(
    basis: Floats,
    row: Floats,
    square: Floats,
    by_shape: Floats,
    wanted: Floats,
    moved: Floats,
    pairs: Integers,
    direction: Floats,
    distance: Floats,
) -> Floats:
    """Solve by conjugate gradients for the basis shapes, given the frames.

    Args:
        basis: (K, 3, P) to start from; displacements are believed to be of size 1 beforehand.
        row: (F, K) weights.
        square: (F, K, K) expected products of the weights.
        by_shape: (F, 2, 3, P) derivative of the image by a shape's point, over the noise.
        wanted: (F, 2, P) what these derivatives times the shape should be.
        moved: (F, K, 3, P) expected product of what is not known of a weight with how what is not known of the motion
            carries a point, in the object's frame; 0 of the mean shape.
        pairs: (E, 2) neighbours.
        direction: (F, 3, E) from the second to the first, over the distance's standard deviation.
        distance: (E,) over the same.

    Returns:
        (K, 3, P).
    """
    count, _, points = basis.shape
    seen_of = np.einsum("fkip,fkjp->pfij", by_shape, by_shape)
    diagonal = _blocks(square, seen_of)
    right = np.einsum("fa,fip->pai", row, np.einsum("fkip,fkp->fip", by_shape, wanted))
    right -= np.einsum("pfij,fajp->pai", seen_of, moved, optimize=True)
    right = right.reshape(points, 3 * count)
    across = _blocks(square, np.einsum("fie,fje->efij", direction, direction))
    pull = np.einsum("fa,fie->eai", row, direction * distance).reshape(len(pairs), 3 * count)
    for sign, ends in ((1, pairs[:, 0]), (-1, pairs[:, 1])):
        np.add.at(diagonal, ends, across)
        np.add.at(right, ends, sign * pull)
    # Each coordinate's own share: a mode of large weights would hold all others else.
    diagonal[:, range(3 * count), range(3 * count)] *= 1 + 1e-9
    diagonal[:, range(3, 3 * count), range(3, 3 * count)] += 1
    start = basis.transpose(2, 0, 1).reshape(points, 3 * count)
    solved = _conjugate_gradients(diagonal, across, pairs, right, start)
    return np.asarray(solved.reshape(points, count, 3).transpose(1, 2, 0))


def _blocks(square: Floats, seen_of: Floats) -> Floats:
    """Sum over frames the products of square (F, K, K) and seen_of (N, F, 3, 3): (N, 3K, 3K)."""
    number, frames = seen_of.shape[:2]
    count = square.shape[1]
    sums = np.swapaxes(seen_of.reshape(number, frames, 9), 1, 2) @ square.reshape(frames, -1)
    return np.ascontiguousarray(
        sums.reshape(number, 3, 3, count, count).transpose(0, 3, 1, 4, 2).reshape(number, 3 * count, 3 * count)
    )


def _conjugate_gradients(diagonal: Floats, across: Floats, pairs: Integers, right: Floats, start: Floats) -> Floats:
    """Solve with the points' own blocks as preconditioner."""
    first, second = pairs.T
    inverse = np.linalg.inv(diagonal)

    def times(blocks: Floats, values: Floats) -> Floats:
        return np.asarray((blocks @ values[..., None])[..., 0])

    def system(values: Floats) -> Floats:
        out = times(diagonal, values)
        if len(pairs):
            np.subtract.at(out, first, times(across, values[second]))
            np.subtract.at(out, second, times(across, values[first]))
        return out

    found = start.copy()
    left = right - system(found)
    turned = times(inverse, left)
    direction, size = turned, float((left * turned).sum())
    enough = STILL**2 * float((right * times(inverse, right)).sum())
    for _ in range(ROUNDS):
        if size <= enough:
            break
        ahead = system(direction)
        length = size / float((direction * ahead).sum())
        found = found + length * direction
        left = left - length * ahead
        turned = times(inverse, left)
        now = float((left * turned).sum())
        direction, size = turned + now / size * direction, now
    return found
