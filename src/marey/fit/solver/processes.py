"""Work on several items in copies of the process, for work that holds Python's lock for most of its time.

A copy (a forked process) holds everything that the caller holds, so that nothing is sent to it but the index of an
item. This needs Linux: other systems have no fork, or their libraries do not support it; there, threads share the work.
"""

import ctypes
import gc
import multiprocessing
import pickle
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from itertools import islice
from multiprocessing.connection import Connection, wait
from typing import Any

from marey.errors import WorkerKilled
from marey.fit.solver.threads import Item, Result, map_in_threads, map_in_two_threads, mark_worker, usable_threads

_GIVEN = 2
"""Number of items that a process has at a time: one in work, and the next one, so that it never waits. Chosen by
hand."""
_AHEAD = 4
"""Number of items per process that may be finished or in work before the caller takes them. Chosen by hand."""
_END_WITH_PARENT = 1
"""Option of `prctl` in Linux's prctl.h: the signal that a process receives when its parent ends."""
_END_S = 5.0
"""Time for a process to end before it is killed [s]. Chosen by hand."""


def map_in_processes(work: Callable[[Item], Result], items: Sequence[Item]) -> Generator[Result, None, None]:
    """Apply a function to items in several processes, and yield the results in the items' order.

    The processes are copies of the caller's, made at the first result and ended after the last one. What the work
    changes besides its result is lost. An item whose work fails is repeated by the caller, whose error names the cause.
    In threads other than the main one, in daemonic processes, and on systems other than Linux, this is
    `map_in_threads`.

    Args:
        work: Function that is called in several processes at a time. Its results must support `pickle`.
        items: Arguments of the calls.

    Raises:
        WorkerKilled: A process was killed, for example for lack of memory.
    """
    count = min(usable_threads(), len(items))
    if count < 2 or not _can_copy():
        yield from map_in_threads(work, items)
        return
    with _copies([partial(_serve, work, items)] * count) as connections:
        team = _Team(connections, len(items))
        for index, item in enumerate(items):
            found = team.result(index)
            yield work(item) if found is None else found.unpacked()


def zip_in_processes(streams: Sequence[Callable[[], Iterator[Result]]]) -> Generator[tuple[Result, ...], None, None]:
    """Generate several streams at a time, each in a process of its own, and yield their next items together.

    The processes are those of `map_in_processes`, with the same limits; each of them is a few items ahead. A stream
    that fails is generated again by the caller, whose error names the cause.

    Args:
        streams: Functions that begin a stream; all streams have the same length. The items must support `pickle`.

    Raises:
        WorkerKilled: A process was killed, for example for lack of memory.
    """
    if min(usable_threads(), len(streams)) < 2 or not _can_copy():
        begun = [stream() for stream in streams]
        yield from _zipped(begun, lambda stream: next(stream, _END), map_in_two_threads)
        return
    with _copies([partial(_generate, stream) for stream in streams]) as connections:
        copies = [_Stream(stream, connection) for stream, connection in zip(streams, connections, strict=True)]
        yield from _zipped(copies, _Stream.next, map)


class _End:
    """Marks the end of a stream."""


_END = _End()
"""The end of a stream in this process."""


def _zipped(
    streams: Sequence[Item], advance: Callable[[Item], Any], each: Callable[..., Iterable[Any]]
) -> Iterator[tuple[Any, ...]]:  # fmt: skip
    """Advance all streams by one item at a time, with a function like `map`, until one of them ends."""
    while True:
        items = tuple(each(advance, streams))
        if any(isinstance(item, _End) for item in items):
            return
        yield items


class _Stream:
    """A stream that a copy generates, or the caller where the copy has failed.

    Args:
        begin: Begins the stream.
        connection: To the copy.
    """

    def __init__(self, begin: Callable[[], Iterator[Any]], connection: Connection):
        self._begin, self._connection = begin, connection
        self._count = 0
        """Number of items that the copy has generated."""
        self._own: Iterator[Any] | None = None

    def next(self) -> Any:
        """Return the next item, or `_END`."""
        if self._own is None:
            found = _received(self._connection)
            if isinstance(found, _Packed):
                self._count += 1
                return found.unpacked()
            if isinstance(found, _End):
                return found
            self._own = islice(self._begin(), self._count, None)
        return next(self._own, _END)


def _can_copy() -> bool:
    """Return whether the process may be copied: on Linux, by its main thread, and if it may start others."""
    main = threading.current_thread() is threading.main_thread()
    return sys.platform == "linux" and main and not multiprocessing.current_process().daemon


@dataclass(frozen=True, eq=False)
class _Packed:
    """A result in bytes. Its arrays are stored apart, so that those that were read-only remain so."""

    content: bytes
    arrays: tuple[bytes | bytearray, ...]

    @staticmethod
    def of(result: object) -> "_Packed":
        """Store a result."""
        buffers: list[pickle.PickleBuffer] = []
        content = pickle.dumps(result, protocol=5, buffer_callback=buffers.append)
        views = [buffer.raw() for buffer in buffers]
        return _Packed(content, tuple(bytes(v) if v.readonly else bytearray(v) for v in views))

    def unpacked(self) -> Any:
        """Return the result."""
        return pickle.loads(self.content, buffers=self.arrays)


class _Team:
    """Processes, and the items that they have.

    Args:
        connections: One to each process.
        total: Number of items.
    """

    def __init__(self, connections: Sequence[Connection], total: int):
        self._connections, self._total = connections, total
        self._idle = [connection for _ in range(_GIVEN) for connection in connections]
        """Processes that can be given an item, as often as they have room for one."""
        self._given = 0
        """Number of items that were given to a process."""
        self._found: dict[int, _Packed | None] = {}

    def result(self, index: int) -> _Packed | None:
        """Return the result of an item; None if its work has failed. Items are requested in their order."""
        self._give(index)
        while index not in self._found:
            for connection in wait(self._connections):
                assert isinstance(connection, Connection)
                done, packed = _received(connection)
                self._found[done] = packed
                self._idle.append(connection)
            self._give(index)
        return self._found.pop(index)

    def _give(self, wanted: int) -> None:
        """Give the next items to idle processes, but none far after the one that is waited for."""
        end = min(self._total, wanted + _AHEAD * len(self._connections))
        while self._idle and self._given < end:
            self._idle.pop(0).send(self._given)
            self._given += 1


def _received(connection: Connection) -> Any:
    """Receive the next message of a process."""
    try:
        return connection.recv()
    except (EOFError, ConnectionResetError) as error:
        raise WorkerKilled from error


@contextmanager
def _copies(tasks: Sequence[Callable[[Connection], None]]) -> Iterator[list[Connection]]:
    """Start a process for each task, and end all of them at last.

    Args:
        tasks: What each process does with its end of the connection.

    Yields:
        The other ends of the connections.
    """
    context, processes, own = multiprocessing.get_context("fork"), [], list[Connection]()
    try:
        with warnings.catch_warnings():
            # Python warns of a fork beside other threads. Those of marey wait for work, and copies do not use them.
            warnings.filterwarnings("ignore", ".*multi-threaded", DeprecationWarning)
            for task in tasks:
                here, there = context.Pipe()
                own.append(here)
                process = context.Process(target=_work_as_copy, args=(task, there, own), daemon=True)
                process.start()
                processes.append(process)
                there.close()
        yield own
    finally:
        for connection in own:
            connection.close()
        for process in processes:
            process.terminate()
        for process in processes:
            process.join(_END_S)
            if process.is_alive():
                process.kill()
                process.join()
            process.close()


def _work_as_copy(task: Callable[[Connection], None], there: Connection, of_caller: Sequence[Connection]) -> None:
    """Work on a task in a new copy of the process, until it is finished or the caller has ended."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the caller ends its copies
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    ctypes.CDLL(None).prctl(_END_WITH_PARENT, signal.SIGKILL)  # a killed caller leaves no copy that holds its locks
    for connection in of_caller:
        connection.close()  # otherwise no copy would notice the end of the caller
    gc.freeze()  # a collection would write to all memory that is shared with the caller
    mark_worker()
    with suppress(EOFError, OSError):  # the caller has closed the connection, or has ended
        task(there)


def _serve(work: Callable[[Item], Any], items: Sequence[Item], there: Connection) -> None:
    """Work on the items whose indices are received; send each index with the result, or with None if the work fails."""
    while True:
        index = there.recv()
        try:
            found = _Packed.of(work(items[index]))
        except Exception:
            found = None
        there.send((index, found))


def _generate(stream: Callable[[], Iterator[Any]], there: Connection) -> None:
    """Send the items of a stream, and at last that it has ended, or None if it fails."""
    items = stream()
    found: _Packed | _End | None = None
    while True:
        try:
            found = _Packed.of(next(items))
        except StopIteration:
            found = _END
        except Exception:
            found = None
        there.send(found)
        if not isinstance(found, _Packed):
            return
