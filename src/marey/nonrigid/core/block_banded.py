"""Linear equations of a sequence in which each frame is coupled to its next two: solution and local covariances."""

import numpy as np

from marey.arrays import Floats
from marey.compiled.kernel_copies import copy_matrix, copy_row
from marey.compiled.kernels import kernel


@kernel
def solve_banded(  # pragma: no cover - compiled
    diagonal: Floats, first: Floats, second: Floats, right: Floats
) -> tuple[Floats, Floats, Floats, Floats, float]:
    """Solve a positive definite system of blocks, and invert it near its diagonal ([Takahashi1973]).

    Args:
        diagonal: (F, D, D) blocks at (f, f).
        first: (F, D, D) blocks at (f, f + 1); the last is ignored.
        second: (F, D, D) blocks at (f, f + 2); the last two are ignored.
        right: (F, D) right-hand side.

    Returns:
        Solution (F, D); the inverse's blocks at (f, f), (f, f + 1) and (f, f + 2), each (F, D, D); the logarithm of the
        system's determinant.
    """
    inverse, near, far, forward, determinant = _factored(diagonal, first, second, right)
    solution, here, next_, beyond = _substituted_back(inverse, near, far, forward)
    return solution, here, next_, beyond, determinant


@kernel
def _factored(diagonal, first, second, right):  # pragma: no cover - compiled
    """Cholesky factors: inverse blocks, couplings to the next frame and the one after, forward substitution."""
    frames, size = right.shape
    inverse = np.zeros((frames, size, size))
    near, far = np.zeros((frames, size, size)), np.zeros((frames, size, size))
    forward = np.zeros((frames, size))
    determinant = 0.0
    for f in range(frames):
        block, side = diagonal[f].copy(), right[f].copy()
        if f > 0:
            block -= near[f - 1].T @ near[f - 1]
            side -= near[f - 1].T @ forward[f - 1]
        if f > 1:
            block -= far[f - 2].T @ far[f - 2]
            side -= far[f - 2].T @ forward[f - 2]
        lower = np.linalg.cholesky(block)
        copy_matrix(inverse[f], np.linalg.inv(lower))
        copy_row(forward[f], inverse[f] @ side)
        for i in range(size):
            determinant += 2 * np.log(lower[i, i])
        if f + 1 < frames:
            beside = first[f].copy()
            if f > 0:
                beside -= near[f - 1].T @ far[f - 1]
            copy_matrix(near[f], inverse[f] @ beside)
        if f + 2 < frames:
            copy_matrix(far[f], inverse[f] @ second[f])
    return inverse, near, far, forward, determinant


@kernel
def _substituted_back(inverse, near, far, forward):  # pragma: no cover - compiled
    """Solution and blocks of the inverse, from the last frame to the first."""
    frames, size = forward.shape
    solution = np.zeros((frames, size))
    here, next_, beyond = (
        np.zeros((frames, size, size)), np.zeros((frames, size, size)), np.zeros((frames, size, size))
    )  # fmt: skip
    zero = np.zeros((size, size))
    for f in range(frames - 1, -1, -1):
        own = inverse[f].T.copy()
        one, two = own @ near[f], own @ far[f]
        value = own @ forward[f]
        after, later, between = zero, zero, zero
        if f + 1 < frames:
            value -= one @ solution[f + 1]
            after = here[f + 1]
        if f + 2 < frames:
            value -= two @ solution[f + 2]
            later, between = here[f + 2], next_[f + 1]
        copy_row(solution[f], value)
        copy_matrix(next_[f], -(one @ after + two @ between.T))
        copy_matrix(beyond[f], -(one @ between + two @ later))
        cross = one @ between @ two.T
        # A sum of squares, so that rounding cannot make a variance negative.
        whole = own @ own.T + one @ after @ one.T + two @ later @ two.T + cross + cross.T
        copy_matrix(here[f], 0.5 * (whole + whole.T))
    return solution, here, next_, beyond
