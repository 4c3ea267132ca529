"""Work on several items in threads: the compiled kernels release the interpreter's lock."""

import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from typing import TypeVar

from marey.process import usable_cores

Item = TypeVar("Item")
"""Type of an item of work."""
Result = TypeVar("Result")
"""Type of the result for an item."""

_THREAD = threading.local()
"""State of the current thread: whether it is a worker."""


def mark_worker() -> None:
    """Mark the current thread as a worker, which processes all items one after the other."""
    _THREAD.is_worker = True


def _in_worker() -> bool:
    return getattr(_THREAD, "is_worker", False)


@contextmanager
def one_thread() -> Iterator[None]:
    """Process all items one after the other in the caller's thread, as for a process that shares its cores with others.

    Yields:
        Nothing.
    """
    before = _in_worker()
    _THREAD.is_worker = True
    try:
        yield
    finally:
        _THREAD.is_worker = before


def usable_threads() -> int:
    """Return the number of threads that the caller may start: one per usable core, or one in a worker thread."""
    return 1 if _in_worker() else usable_cores()


def map_in_threads(work: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    """Apply a function to items in several threads, and yield the results in the items' order.

    The items are generated in the caller's thread, a few ahead of the results, so that none pile up. Inside another
    `map_in_threads` every core is busy already, and the items are processed one after the other.

    Args:
        work: Function that is called in several threads at a time.
        items: Arguments of the calls.
    """
    threads = usable_threads()
    if threads == 1:
        yield from map(work, items)
        return
    waiting: deque[Future[Result]] = deque()
    with ThreadPoolExecutor(threads, initializer=mark_worker) as pool:
        try:
            for item in items:
                waiting.append(pool.submit(work, item))
                if len(waiting) > 2 * threads:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


def map_in_two_threads(work: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """Apply a short function, of a fraction of a millisecond, to a few items: half of them in a waiting second thread.

    Inside `map_in_threads` every core is busy already, and the items are processed one after the other.
    """
    todo = list(items)
    if usable_threads() == 1 or len(todo) < 2:
        return [work(item) for item in todo]
    half = (len(todo) + 1) // 2
    # One extra thread and one message each way: further ones would cost as much as they save.
    rest = _waiting_thread().submit(lambda: [work(item) for item in todo[half:]])
    return [work(item) for item in todo[:half]] + rest.result()


@cache
def _waiting_thread() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(1, initializer=mark_worker)
