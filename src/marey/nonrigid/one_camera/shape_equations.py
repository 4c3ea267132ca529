"""Normal equations of the mean shape and all modes, from images of points and distances between neighbours."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Integers
from marey.geometry.vectors import products

_ROUNDS = 80
"""Largest number of conjugate gradient steps; a limit on time."""
_TOLERANCE = 1e-5
"""Steps end when the preconditioned residual falls below this fraction of the right-hand side."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ShapeEquations:
    """Normal equations of P points' coordinates in K basis shapes, in the order (P, 3K)."""

    diagonal: Floats
    """(P, 3K, 3K) blocks of the points."""
    across: Floats
    """(E, 3K, 3K) couplings of the two points of each pair, to be subtracted."""
    pairs: Integers
    """(E, 2) neighbouring points."""
    right: Floats
    """(P, 3K) right-hand side."""

    def times(self, values: Floats) -> Floats:
        """Multiply the matrix with values (P, 3K)."""
        first, second = self.pairs.T
        out = products(self.diagonal, values)
        if len(self.pairs):
            np.subtract.at(out, first, products(self.across, values[second]))
            np.subtract.at(out, second, products(self.across, values[first]))
        return out


def in_rows(basis: Floats) -> Floats:
    """Rearrange basis shapes (K, 3, P) into the order of the equations, (P, 3K)."""
    return np.asarray(basis.transpose(2, 0, 1).reshape(basis.shape[2], -1))


def in_shapes(rows: Floats) -> Floats:
    """Rearrange rows (P, 3K) of the equations into basis shapes (K, 3, P)."""
    return np.asarray(rows.reshape(len(rows), -1, 3).transpose(1, 2, 0))


def shape_equations(
    row: Floats,
    square: Floats,
    by_shape: Floats,
    wanted: Floats,
    moved: Floats,
    pairs: Integers,
    direction: Floats,
    distance: Floats,
) -> ShapeEquations:
    """Compute the equations of the basis shapes, given the frames; the prior of a mode's coordinate has variance 1.

    Args:
        row: (F, K) weights.
        square: (F, K, K) expected products of the weights.
        by_shape: (F, 2, 3, P) derivatives of the image by the points of the shape, over the noise.
        wanted: (F, 2, P) target of these derivatives times the shape.
        moved: (F, K, 3, P) expected products of the error of a weight and the displacement of a point by the error of
            the motion, in the object's frame; 0 for the mean shape.
        pairs: (E, 2) neighbours.
        direction: (F, 3, E) from the second point to the first, over the distance's standard deviation.
        distance: (E,) mean distance over the same standard deviation.
    """
    count, points = row.shape[1], wanted.shape[2]
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
    # Relative to each coordinate: otherwise a mode of large weights would constrain all others.
    diagonal[:, range(3 * count), range(3 * count)] *= 1 + 1e-9
    diagonal[:, range(3, 3 * count), range(3, 3 * count)] += 1
    return ShapeEquations(diagonal=diagonal, across=across, pairs=pairs, right=right)


def solve_shape_equations(equations: ShapeEquations, basis: Floats) -> Floats:
    """Solve by conjugate gradients, preconditioned by the blocks of the points, starting from shapes (K, 3, P)."""
    inverse = np.linalg.inv(equations.diagonal)
    found = in_rows(basis)
    left = equations.right - equations.times(found)
    turned = products(inverse, left)
    direction, size = turned, float((left * turned).sum())
    enough = _TOLERANCE**2 * float((equations.right * products(inverse, equations.right)).sum())
    for _ in range(_ROUNDS):
        if size <= enough:
            break
        ahead = equations.times(direction)
        length = size / float((direction * ahead).sum())
        found = found + length * direction
        left = left - length * ahead
        turned = products(inverse, left)
        now = float((left * turned).sum())
        direction, size = turned + now / size * direction, now
    return in_shapes(found)


def _blocks(square: Floats, seen_of: Floats) -> Floats:
    """Sum over frames the products of square (F, K, K) and seen_of (N, F, 3, 3), giving (N, 3K, 3K)."""
    number, frames = seen_of.shape[:2]
    count = square.shape[1]
    sums = np.swapaxes(seen_of.reshape(number, frames, 9), 1, 2) @ square.reshape(frames, -1)
    return np.ascontiguousarray(
        sums.reshape(number, 3, 3, count, count).transpose(0, 3, 1, 4, 2).reshape(number, 3 * count, 3 * count)
    )
