"""Settings of the whole process that suit the program: cores, threads, Python's lock, and the memory allocator."""

import ctypes
import gc
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from functools import cache
from math import ceil
from pathlib import Path

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
_CONTROL_GROUPS = Path("/sys/fs/cgroup")
"""Where Linux states the limits of groups of processes, such as those of a container or a batch job."""
_OWN_GROUP = Path("/proc/self/cgroup")
"""Where Linux states the group of this process."""

_set_limit: list[int] = []
"""The limits that were set by `limited_cores`, the innermost last."""


@contextmanager
def tuned_process(*, parallel_cameras: bool = True, workers: int | None = None) -> Iterator[None]:
    """Set the process for the fastest run, as the program `marey` does; restore it at the end.

    The matrices of marey are small, and its pipelines for videos work on all cameras in parallel. Further threads
    inside the linear algebra and of OpenCV only wait for each other, so each is limited to one thread. The other
    functions of `marey` never change these settings.

    Args:
        parallel_cameras: Set OpenCV, Python's lock and the allocator for work on several videos, too; False limits the
            threads of the linear algebra only.
        workers: Largest number of worker threads of the pipelines; by default one per core that the process may use.
            The results do not depend on it.

    Yields:
        Nothing.

    Example:
        >>> import marey
        >>> with marey.tuned_process():
        ...     trial = marey.open_trial(marey.example_folder())
    """
    import scipy.linalg  # noqa: F401  (its library must be loaded before its threads can be limited)
    from threadpoolctl import threadpool_limits

    videos = _set_for_videos() if parallel_cameras else nullcontext()
    with limited_cores(workers), threadpool_limits(1), videos:
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


@contextmanager
def limited_cores(count: int | None) -> Iterator[None]:
    """Use at most a number of cores; the result of `usable_cores` is at most this number.

    Args:
        count: The largest number of cores; None for no further limit.

    Yields:
        Nothing.

    Raises:
        ValueError: The number is below 1.
    """
    if count is not None and count < 1:
        raise ValueError(f"the number of cores is {count}; it should be at least 1")
    _set_limit.append(usable_cores() if count is None else count)
    try:
        yield
    finally:
        _set_limit.pop()


def usable_cores() -> int:
    """Return how many cores the process may use, at least 1.

    This is the number that was set by `limited_cores`. Otherwise it is the number of cores on which the system runs
    the process, or the processor time that its control group allows if that is less.
    """
    return _set_limit[-1] if _set_limit else _allowed_cores()


@cache
def _allowed_cores() -> int:
    try:
        scheduled = len(os.sched_getaffinity(0))
    except AttributeError:  # only Linux knows it
        scheduled = os.cpu_count() or 1
    quota = group_quota(_CONTROL_GROUPS, _OWN_GROUP)
    return scheduled if quota is None else max(1, min(scheduled, ceil(quota)))


def group_quota(groups: Path, own: Path) -> float | None:
    """Return the processor time that the control group of the process allows, in cores.

    Args:
        groups: Folder of the control groups.
        own: File with the group of the process.

    Returns:
        The smallest quota of the group and the groups that contain it, in version 1 or 2 of the file system of control
        groups; None if there is none, or it cannot be read.
    """
    paths = {line.rsplit(":", 1)[-1].strip("/") for line in _text(own).splitlines()} | {""}
    every = {Path(*Path(path).parts[:k]) for path in paths for k in range(len(Path(path).parts) + 1)}
    quotas = []
    for path in every:
        quotas.append(_ratio(*(_text(groups / path / "cpu.max").split() + ["", ""])[:2]))
        old = groups / "cpu" / path
        quotas.append(_ratio(_text(old / "cpu.cfs_quota_us"), _text(old / "cpu.cfs_period_us")))
    return min((quota for quota in quotas if quota is not None), default=None)


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError):
        return ""


def _ratio(quota: str, period: str) -> float | None:
    """Return a quota in cores; "max", "-1" and an absent file are no limit."""
    if not (quota.isdecimal() and period.isdecimal() and int(quota) > 0 and int(period) > 0):
        return None
    return int(quota) / int(period)
