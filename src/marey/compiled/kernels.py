"""The decorator of compiled functions."""

from collections.abc import Callable
from typing import Any

import numba

try:
    from marey.compiled.kernel_dispatch import KernelDispatcher
except ImportError as _problem:
    if not (_problem.name or "").startswith("numba"):
        raise
    KernelDispatcher = None  # type: ignore[assignment,misc]


def kernel(function: Callable[..., Any] | None = None, /, **options: Any) -> Any:
    """Compile a function by Numba at its first call, and keep the machine code on disk for other processes.

    The compiled function releases the interpreter's lock. With `nogil=False` it keeps the lock: for a function that
    takes about as long as the wait for the lock afterwards. It has no entry point for C, so that it cannot be stored in
    a variable of Numba's type of functions, and one for Python only where Python calls it. An entry on disk is used as
    long as the function and all that it uses have the same content (see `kernel_digest`), in any folder the package is
    installed; see `kernel_cache.kernel_folder` for its place. The entry depends on constants of modules too: as always
    in Numba, they are read once, when the function is compiled or loaded.

    Cache and dispatcher build on classes that Numba does not document. If a future version of Numba lacks them,
    `kernel` uses Numba's own cache, which does not notice a change of a function in another file.

    Args:
        function: The function; absent where the decorator has options.
        **options: Options of `numba.njit`, except `cache`.

    Returns:
        Numba's dispatcher, or the decorator if there is no function.
    """
    options = {"nogil": True, "no_cfunc_wrapper": True, **options}
    if function is None:
        return lambda decorated: kernel(decorated, **options)
    if KernelDispatcher is None:
        return _cached_by_numba(function, options)
    compiled = numba.njit(**options)(function)
    if numba.config.DISABLE_JIT:
        return compiled
    return KernelDispatcher(function, targetoptions={**compiled.targetoptions, "no_cpython_wrapper": True})


def _cached_by_numba(function: Callable[..., Any], options: dict[str, Any]) -> Any:
    """Compile with Numba's own cache, or without one where Numba finds no folder to write to."""
    try:
        return numba.njit(cache=True, **options)(function)
    except RuntimeError:
        return numba.njit(**options)(function)
