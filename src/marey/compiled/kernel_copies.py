"""Copies of numbers inside kernels.

`target[:] = source` makes Numba compile a comparison of both shapes and the text of an error message: 4 s in each
process that compiles such a kernel for the first time, and about half a second in each kernel. These kernels take a
few milliseconds to compile. As everywhere in compiled code, the shapes are not compared.
"""

from marey.arrays import Floats
from marey.compiled.kernels import kernel


@kernel
def copy_row(target: Floats, source: Floats) -> None:
    """Copy numbers (n,) into an array (n,) of the same or another layout."""
    for i in range(target.shape[0]):
        target[i] = source[i]


@kernel
def copy_matrix(target: Floats, source: Floats) -> None:
    """Copy numbers (m, n) into an array (m, n) of the same or another layout."""
    for i in range(target.shape[0]):
        for j in range(target.shape[1]):
            target[i, j] = source[i, j]
