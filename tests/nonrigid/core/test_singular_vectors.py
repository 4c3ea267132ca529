"""Singular vectors agree with NumPy's, up to signs."""

import numpy as np

from marey.nonrigid.core.completion import singular_vectors


def test_singular_vectors_reconstruct_the_matrix(rng):
    for matrix in (rng.normal(size=(7, 4)), np.outer(np.arange(5.0), np.ones(9))):
        u, d, vt = singular_vectors(matrix)
        np.testing.assert_allclose((u * d) @ vt, matrix, atol=1e-12)
        np.testing.assert_allclose(d, np.linalg.svd(matrix, compute_uv=False), atol=1e-12)
        np.testing.assert_allclose(u.T @ u, np.eye(len(d)), atol=1e-12)
