"""The banded solver agrees with a dense one."""

import numpy as np

from marey.nonrigid.core.block_banded import solve_banded


def test_solution_inverse_and_determinant_are_those_of_the_dense_system(rng):
    frames, size = 7, 3
    whole = np.zeros((frames * size, frames * size))
    for _ in range(60):
        start = int(rng.integers(frames - 2))
        row = np.zeros(frames * size)
        row[start * size : (start + 3) * size] = rng.normal(size=3 * size)
        whole += np.outer(row, row)
    whole += 0.1 * np.eye(len(whole))
    right = rng.normal(size=(frames, size))

    def block(of, row, column):
        if column >= frames:
            return np.zeros((size, size))
        return of[row * size : (row + 1) * size, column * size : (column + 1) * size]

    parts = [np.array([block(whole, f, f + k) for f in range(frames)]) for k in range(3)]
    solution, *covariance, determinant = solve_banded(*parts, right)
    inverse = np.linalg.inv(whole)
    np.testing.assert_allclose(solution.ravel(), inverse @ right.ravel(), atol=1e-10)
    for k, found in enumerate(covariance):
        np.testing.assert_allclose(found, [block(inverse, f, f + k) for f in range(frames)], atol=1e-10)
    np.testing.assert_allclose(determinant, np.linalg.slogdet(whole)[1])
