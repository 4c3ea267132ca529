"""Atomic writing of files: a file is complete and on the disk, or absent."""

import errno
import os
import shutil
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path

from marey.errors import NotWritten

_USERS_ERRNO = frozenset(
    {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, errno.EPERM, errno.EIO, errno.ENAMETOOLONG}
)
"""Errors of the system while a file is written: full or damaged disks, quotas, missing rights."""
_THREADS = 32
"""Number of files that are flushed to the disk at once: 300 files of 100 kB took 0.10 s, instead of 2.2 s one by one,
on a virtual disk with ext4, where a single file takes 12 ms."""
_FULL_BYTES = 1 << 20
"""Free space below which a disk counts as full if a library has not written a file completely [bytes]. By hand."""
_SYNCED_LATER: set[Path] = set()
"""Folders in which `replacing` does not wait for the disk; see `synced_later`."""


@contextmanager
def replacing(path: Path | str) -> Iterator[Path]:
    """Provide a temporary path in the same folder, which is renamed to the wanted path if no error occurs.

    The content is flushed to the disk before the file is renamed, and the new name after it, so that a power cut leaves
    the old file or the new one. Files in a folder of `synced_later` are not flushed one by one.

    Args:
        path: The file to write; its folder is created if it does not exist.

    Yields:
        A temporary path in the same folder with the same suffix.

    Raises:
        NotWritten: The folder cannot be written to, or the disk is full.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            temporary.touch()
        except OSError as error:
            raise NotWritten(path, error.strerror or str(error)) from error
        with naming_unwritten(path):
            yield temporary
            at_once = _SYNCED_LATER.isdisjoint(path.parents)
            if at_once:
                sync_files([temporary])
            os.replace(temporary, path)
            if at_once:
                sync_folder(path.parent)
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def require_place(path: Path) -> None:
    """Check, before work whose only result is a file, that the file can be written.

    Args:
        path: The file; its folder need not exist.

    Raises:
        NotWritten: Its folder is a file, or cannot be written to.
    """
    folder = next(parent for parent in path.absolute().parents if parent.exists())
    if not folder.is_dir():
        raise NotWritten(path, os.strerror(errno.ENOTDIR))
    if path.is_dir():
        raise NotWritten(path, os.strerror(errno.EISDIR))
    if not os.access(folder, os.W_OK):
        raise NotWritten(path, os.strerror(errno.EACCES))


@contextmanager
def naming_unwritten(path: Path) -> Iterator[None]:
    """Report errors of the system while a file is written as an error that names the file.

    Args:
        path: The file.

    Yields:
        Nothing.

    Raises:
        NotWritten: An error occurred that the user can correct, such as a full disk.
    """
    try:
        yield
    except OSError as error:
        if error.errno not in _USERS_ERRNO:
            raise
        raise NotWritten(path, os.strerror(error.errno)) from error


@contextmanager
def synced_later(folder: Path) -> Iterator[None]:
    """Do not flush the files in a folder one by one: the caller flushes them, or can do without some of them.

    Args:
        folder: The folder; files in its sub-folders are included.

    Yields:
        Nothing.
    """
    new = folder not in _SYNCED_LATER
    _SYNCED_LATER.add(folder)
    try:
        yield
    finally:
        if new:
            _SYNCED_LATER.discard(folder)


def sync_files(paths: Iterable[Path]) -> None:
    """Flush the content of files to the disk.

    Args:
        paths: The files.

    Raises:
        OSError: The disk is full or damaged.
    """
    paths = list(paths)
    if len(paths) == 1:
        _sync(paths[0])
    elif paths:
        with ThreadPoolExecutor(_THREADS) as pool:
            for _ in pool.map(_sync, paths):
                pass


def sync_folder(folder: Path) -> None:
    """Flush the names in a folder to the disk, where the system can do that.

    Args:
        folder: The folder.
    """
    # Windows cannot open folders, and some file systems cannot flush them.
    with suppress(OSError):
        _sync(folder)


def _sync(path: Path) -> None:
    # Windows flushes only files that are open for writing.
    file = os.open(path, os.O_RDWR if os.name == "nt" else os.O_RDONLY)
    try:
        os.fsync(file)
    finally:
        os.close(file)


def reserve(path: Path, size: int) -> None:
    """Make sure that the disk has the space for a file, where the system can do that.

    Args:
        path: An existing file; it is extended.
        size: Its size [bytes].

    Raises:
        OSError: There is not enough space on the disk.
    """
    if size <= 0 or not hasattr(os, "posix_fallocate"):
        return
    with path.open("r+b") as file:
        try:
            os.posix_fallocate(file.fileno(), 0, size)
        except OSError as error:
            if error.errno not in (errno.EOPNOTSUPP, errno.EINVAL):
                raise


def require_complete(path: Path, complete: bool) -> None:
    """Check, inside of `replacing`, a file that was written by a library which hides the errors of the system.

    Args:
        path: The temporary file.
        complete: Whether the file is complete.

    Raises:
        OSError: It is not, because the disk is full or for an unknown reason.
    """
    if not complete:
        full = shutil.disk_usage(path.parent).free < _FULL_BYTES
        code = errno.ENOSPC if full else errno.EIO
        raise OSError(code, os.strerror(code), str(path))
