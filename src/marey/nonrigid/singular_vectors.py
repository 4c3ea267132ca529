"""Singular vectors that are found for every finite matrix."""

import numpy as np
import scipy.linalg

from marey.arrays import Floats


def singular_vectors(matrix: Floats) -> tuple[Floats, Floats, Floats]:
    """Give U (n, k), the singular values (k,) and V' (k, m), k the lesser of n and m.

    NumPy's own way (divide and conquer) gives up on some harmless matrices of low rank; this one is slower and never.
    """
    u, d, vt = scipy.linalg.svd(matrix, full_matrices=False, lapack_driver="gesvd", check_finite=False)
    return np.asarray(u), np.asarray(d), np.asarray(vt)
