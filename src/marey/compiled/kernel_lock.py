"""Locks between processes, so that each kernel is compiled by one of them while the others wait for its result.

All locks are single bytes of one file. The operating system gives the bytes of a process free when it ends, however
it ends, so that no lock is left behind.
"""

import functools
import os
import time
from pathlib import Path

from marey.file_locks import lock_byte, unlock_byte

WAIT_S = 60.0
"""Longest time to wait for another process, in seconds; then the kernel is compiled here, too. Chosen by hand; the
slowest kernels take about 10 s to compile."""

_PAUSE_S = 0.02
"""Time between two attempts to take a lock, in seconds. Chosen by hand."""

_FILE = "locks"
"""Name of the file of locks, in the folder of the entries."""


class EntryLock:
    """A lock of one entry of the cache, held by one process at a time.

    A folder that cannot be written to, or a file system without locks, has no effect: every process then compiles.

    Args:
        folder: Folder of the entries.
        place: Number of the byte, below 2³¹; the same for the same entry in every process.
    """

    def __init__(self, folder: Path, place: int):
        self._folder = folder
        self._place = place
        self._is_held = False

    def acquire(self, wait_s: float = WAIT_S) -> bool:
        """Take the lock, waiting for another process that holds it.

        Args:
            wait_s: Longest time to wait, in seconds.

        Returns:
            Whether the lock is held.
        """
        end = time.monotonic() + wait_s
        try:
            file = _open(self._folder, os.getpid())
            while not lock_byte(file, self._place):
                if time.monotonic() > end:
                    return False
                time.sleep(_PAUSE_S)
        except OSError:
            return False
        self._is_held = True
        return True

    def release(self) -> None:
        """Give the lock free, if it is held."""
        if self._is_held:
            self._is_held = False
            unlock_byte(_open(self._folder, os.getpid()), self._place)


@functools.cache
def _open(folder: Path, process: int) -> int:
    """Open the file of locks once in a process: closing it would give all locks of the process free."""
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    return os.open(folder / _FILE, os.O_RDWR | os.O_CREAT, 0o600)
