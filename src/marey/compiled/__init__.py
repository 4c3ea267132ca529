"""Compilation of functions by Numba: the decorator of kernels, and the cache of their machine code."""

TRANSLATION = "marey:translation"
"""Kind of Numba's event while a compiled kernel is translated to machine code; its compilation is "numba:compile"."""

WAIT = "marey:wait"
"""Kind of Numba's event while a process waits for another one that compiles the same kernel."""
