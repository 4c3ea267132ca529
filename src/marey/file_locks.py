"""Locks between processes: single bytes of a file, which the operating system gives free when a process ends."""

import os
import sys


def lock_byte(file: int, place: int) -> bool:
    """Lock a byte of an open file for this process, without waiting.

    Args:
        file: Descriptor of the file, open for writing. On POSIX, closing any descriptor of the file in this process
            gives all locks of the process in it free.
        place: Number of the byte, below 2³¹; it may be beyond the end of the file.

    Returns:
        Whether the lock is held: False if another process holds it.

    Raises:
        OSError: The file system has no locks.
    """
    return _take(file, place)


def unlock_byte(file: int, place: int) -> None:
    """Give a locked byte free.

    Args:
        file: Descriptor of the file.
        place: Number of the byte.
    """
    _give(file, place)


if sys.platform == "win32":
    import msvcrt

    def _take(file: int, place: int) -> bool:
        os.lseek(file, place, os.SEEK_SET)
        try:
            msvcrt.locking(file, msvcrt.LK_NBLCK, 1)
        except PermissionError:  # Another process holds it.
            return False
        return True

    def _give(file: int, place: int) -> None:
        os.lseek(file, place, os.SEEK_SET)
        msvcrt.locking(file, msvcrt.LK_UNLCK, 1)

else:
    import fcntl

    def _take(file: int, place: int) -> bool:
        try:
            fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, place)
        except (BlockingIOError, PermissionError):  # Another process holds it.
            return False
        return True

    def _give(file: int, place: int) -> None:
        fcntl.lockf(file, fcntl.LOCK_UN, 1, place)
