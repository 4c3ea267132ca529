"""Work on several things at a time: the kernels let go of Python's lock, so threads are enough."""

import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

THREADS = min(4, os.cpu_count() or 1)

_THREAD = threading.local()


def _begin() -> None:
    _THREAD.is_worker = True


def side_by_side(work: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    """Give the results of a work on items, in their order.

    The items are made in the caller's thread, a few ahead of what is asked for, so that none piles up.

    Args:
        work: runs in several threads at a time.
        items: what it is done on.
    """
    waiting: deque[Future[Result]] = deque()
    with ThreadPoolExecutor(THREADS, initializer=_begin) as pool:
        try:
            for item in items:
                waiting.append(pool.submit(work, item))
                if len(waiting) > 2 * THREADS:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


def together(work: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """Do a short work, a fraction of a millisecond, on a few items: half of them here, half in a thread that waits.

    Inside of `side_by_side` every core has its work already, and the items follow each other.
    """
    todo = list(items)
    if THREADS == 1 or len(todo) < 2 or getattr(_THREAD, "is_worker", False):
        return [work(item) for item in todo]
    half = (len(todo) + 1) // 2
    # One thread more and one message each way: more of them cost what they bring.
    rest = _helper().submit(lambda: [work(item) for item in todo[half:]])
    return [work(item) for item in todo[:half]] + rest.result()


@cache
def _helper() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(1, initializer=_begin)
