"""Settings of the whole process that suit the program: threads, Python's lock, and the memory allocator."""

import ctypes
import gc
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress

SWITCH_S = 3e-4
"""Time after which a thread releases Python's lock to a waiting thread [s].

Compiled kernels often finish in less than Python's usual 5 ms.
"""
KEPT_FREE_BYTES = 1 << 28
"""Freed memory that the process keeps for later use [bytes]."""
LARGE_BYTES = 1 << 25
"""Blocks of memory of at least this size are returned to the system when they are freed [bytes]."""
_TRIM_THRESHOLD = -1
"""Parameter of `mallopt` in glibc's malloc.h."""
_MMAP_THRESHOLD = -3
"""Parameter of `mallopt` in glibc's malloc.h."""


@contextmanager
def tuned_process(*, parallel_cameras: bool = True) -> Iterator[None]:
    """Set the process for the fastest run, as the program `marey` does; restore it at the end.

    The matrices of marey are small, and its pipelines for videos work on all cameras in parallel. Further threads
    inside the linear algebra and of OpenCV only wait for each other, so each is limited to one thread. The other
    functions of `marey` never change these settings.

    Args:
        parallel_cameras: Set OpenCV, Python's lock and the allocator for work on several videos, too; False limits the
            threads of the linear algebra only.

    Yields:
        Nothing.

    Example:
        >>> import marey
        >>> with marey.tuned_process():
        ...     trial = marey.open_trial(marey.example_folder())
    """
    import scipy.linalg  # noqa: F401  (its library must be loaded before its threads can be limited)
    from threadpoolctl import threadpool_limits

    with threadpool_limits(1), _set_for_videos() if parallel_cameras else nullcontext():
        yield


@contextmanager
def _set_for_videos() -> Iterator[None]:
    import cv2

    threads, interval = cv2.getNumThreads(), sys.getswitchinterval()
    cv2.setNumThreads(1)
    sys.setswitchinterval(SWITCH_S)
    _keep_freed_memory()
    try:
        yield
    finally:
        cv2.setNumThreads(threads)
        sys.setswitchinterval(interval)


def _keep_freed_memory() -> None:
    """Let glibc's allocator keep freed memory; another C library is left as it is.

    Every image needs some megabytes for a moment, and memory that is new to a process costs as much time as the work
    on it.
    """
    with suppress(OSError, AttributeError, TypeError):
        set_option = ctypes.CDLL(None).mallopt
        set_option(_MMAP_THRESHOLD, LARGE_BYTES)
        set_option(_TRIM_THRESHOLD, KEPT_FREE_BYTES)


@contextmanager
def without_collection_pauses() -> Iterator[None]:
    """Exclude the objects that exist already from garbage collection, which would search them for 0.1 s at a time.

    A page that follows the mouse shows such pauses.

    Yields:
        Nothing.
    """
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()
