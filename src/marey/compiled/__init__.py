"""Compilation of functions by Numba: the decorator of kernels, and the cache of their machine code."""
