"""A cache of machine code on disk whose entries are found by a kernel's content.

It replaces the cache of a Numba dispatcher. Numba's own finds an entry by the kernel's file, and so drops it where a
comment of that file changes, and keeps it where a kernel in another file, which it contains, changes. Here an entry is
found by the digest of `kernel_digest`. Several versions of a package share one folder, and processes that write to it
at the same time do not disturb each other: each entry is a file of its own, put in place by one rename. One of them
compiles a kernel and the others wait for it (see `kernel_lock`).
"""

import contextlib
import functools
import hashlib
import os
import pickle
import stat
import sys
import tempfile
import time
import uuid
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import llvmlite
import numba
import numpy as np
from numba.core import config, event
from numba.core.caching import CompileResultCacheImpl, FunctionCache, _CacheLocator
from numba.core.errors import NumbaWarning
from numba.core.serialize import dumps

from marey.compiled import WAIT
from marey.compiled.kernel_digest import UnknownContentError, class_content, kernel_digest
from marey.compiled.kernel_library import has_entry_point, is_machine_code
from marey.compiled.kernel_lock import EntryLock
from marey.compiled.kernel_writes import WRITTEN

KEPT_UNUSED_DAYS = 90.0
"""Days after which an entry that was not used is deleted. Chosen by hand."""

_DAY_S = 86400.0
"""Seconds of a day; the time of an entry's last use is noted once a day at most."""

_FORMAT = 5
"""Number of the content of entries; it changes where this module or one beside it writes another content."""

_SUFFIX = ".nbc"
"""File name suffix of an entry, as Numba's."""

_CODE_SETTINGS = ("OPT", "BOUNDSCHECK", "DEBUGINFO_DEFAULT", "LOOP_VECTORIZE", "SLP_VECTORIZE", "USING_SVML")
"""Numba's process-wide settings (NUMBA_OPT and so on) that change the machine code of every kernel."""


class KernelCache(FunctionCache):
    """The cache of one kernel. It computes the digest at the first call of the kernel, not when it is defined.

    Args:
        dispatcher: Numba's dispatcher of the kernel.

    Attributes:
        saves_linked_code: Whether code without machine code is saved too; see `marey.compiled.kernel_library`.
    """

    def __init__(self, dispatcher: Any):
        self._py_func = dispatcher.py_func
        self._name = repr(self._py_func)
        self._options = dict(dispatcher.targetoptions)
        self._is_prepared = False
        self._locks: dict[Any, EntryLock] = {}
        self.saves_linked_code = True
        self.enable()

    def _prepare(self) -> None:
        """Set what the base class sets when it is created."""
        if self._is_prepared:
            return
        self._is_prepared = True
        folder = kernel_folder()
        self._cache_path = str(folder)
        try:
            digest = kernel_digest(self._py_func, self._options)
        except UnknownContentError as problem:
            warnings.warn(NumbaWarning(f"Cannot cache a kernel: {problem}"), stacklevel=2)
            self.disable()
            digest = ""
        self._impl = _KernelCacheImpl(self._py_func, _KernelLocator(self._py_func, folder, digest))
        self._cache_file = _Entries(folder, self._impl.filename_base, digest)

    @property
    def cache_path(self) -> str:
        """Folder of the entries."""
        self._prepare()
        return self._cache_path

    def flush(self) -> None:
        """Delete the kernel's entries."""
        self._prepare()
        super().flush()

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Load the machine code for a signature, or wait for another process that compiles it.

        Args:
            sig: Types of the arguments.
            target_context: Numba's context of the processor.

        Returns:
            Numba's `CompileResult`; None if the caller has to compile the kernel and then to call `release`.
        """
        self._prepare()
        found = super().load_overload(sig, target_context)
        if found is not None or not self._enabled:
            return found
        key = self._index_key(sig, target_context.codegen())
        if not _is_lasting(key):
            return None
        lock = self._locks[sig] = self._lock_of(key)
        if not lock.acquire(wait_s=0.0):
            with event.trigger_event(WAIT, data={"kernel": self._name, "args": sig}):
                lock.acquire()
        return super().load_overload(sig, target_context)

    def is_kept(self, sig: Any, target_context: Any) -> bool:
        """Return whether there is machine code for a signature that Python can call.

        Args:
            sig: Types of the arguments.
            target_context: Numba's context of the processor.
        """
        self._prepare()
        payload = self._cache_file.load(self._index_key(sig, target_context.codegen())) if self._enabled else None
        return payload is not None and self._impl.has_machine_code(payload)

    def is_free(self, sig: Any, target_context: Any) -> bool:
        """Return whether a signature can be kept, and no other process compiles it now.

        Args:
            sig: Types of the arguments.
            target_context: Numba's context of the processor.
        """
        self._prepare()
        key = self._index_key(sig, target_context.codegen())
        if not self._enabled or not _is_lasting(key):
            return False
        lock = self._lock_of(key)
        held = lock.acquire(wait_s=0.0)
        lock.release()
        return held

    def _lock_of(self, key: tuple[Any, ...]) -> EntryLock:
        return EntryLock(self._cache_file.folder, self._cache_file.number(key))

    def release(self, sig: Any) -> None:
        """Let other processes go on that wait for the machine code for a signature; without effect if it was loaded."""
        if sig in self._locks:
            self._locks.pop(sig).release()

    def save_overload(self, sig: Any, data: Any) -> None:
        """Save the machine code for a signature; a folder that cannot be written to is a warning."""
        self._prepare()
        if not self.saves_linked_code and not has_entry_point(data):
            return
        try:
            super().save_overload(sig, data)
        except OSError as problem:
            warnings.warn(NumbaWarning(f"A compiled kernel could not be saved: {problem}"), stacklevel=2)

    def _index_key(self, sig: Any, codegen: Any) -> tuple[Any, ...]:
        """Describe a signature, the processor, and the fields of the named tuples and enumerations among the types."""
        return (sig, codegen.magic_tuple(), [class_content(kind) for kind in _classes(sig)])


class _KernelLocator(_CacheLocator):
    """Where the entries of one kernel lie, and the digest of its content."""

    def __init__(self, py_func: Any, folder: Path, digest: str):
        self._py_file = py_func.__code__.co_filename
        self._folder = folder
        self._digest = digest

    def ensure_cache_path(self) -> None:
        self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)

    def get_cache_path(self) -> str:
        return str(self._folder)

    def get_source_stamp(self) -> str:
        return self._digest

    def get_disambiguator(self) -> str:
        return self._digest[:20]


class _KernelCacheImpl(CompileResultCacheImpl):
    """Numba's way to write and read machine code, with the name of the module instead of the file's.

    The arguments that the kernel may write to are kept beside the machine code. The listing of the kernel's types,
    which Numba's `inspect_types` prints, is left out.
    """

    def __init__(self, py_func: Any, locator: _KernelLocator):
        self._lineno = py_func.__code__.co_firstlineno
        self._locator = locator
        name = f"{py_func.__module__}.{py_func.__qualname__}"
        self._filename_base = self.get_filename_base(name[-100:], getattr(sys, "abiflags", ""))

    def reduce(self, cres: Any) -> Any:
        return cres.metadata[WRITTEN], cres.environment.consts, super().reduce(cres._replace(type_annotation=""))

    def rebuild(self, target_context: Any, payload: Any) -> Any:
        written, constants, reduced = payload
        rebuilt = super().rebuild(target_context, reduced)
        # A kernel that contains this one may have brought the constants of its code, without those of its entry point.
        known = rebuilt.environment.consts
        known.extend(constants[len(known) :])
        return rebuilt._replace(metadata={WRITTEN: written})

    def has_machine_code(self, payload: Any) -> bool:
        """Return whether what was written is more than code for other kernels."""
        _, _, reduced = payload
        return is_machine_code(reduced[0])


class _Entries:
    """The entries of one kernel: one file for each signature and processor.

    A file holds the digest and the signature beside the machine code; the names of files contain parts of both.
    """

    def __init__(self, folder: Path, base: str, digest: str):
        self.folder = folder
        self._base = base
        self._stamp = (digest, _environment())

    def load(self, key: tuple[Any, ...]) -> Any:
        path = self._path(key)
        try:
            content = path.read_bytes()
            _note_use(path)
        except OSError:
            return None
        try:
            stamp, signature, data = pickle.loads(content)
        except Exception:  # A damaged entry, or one of classes that are defined no more: it is compiled again.
            return None
        return data if stamp == self._stamp and signature == key[0] else None

    def save(self, key: tuple[Any, ...], data: Any) -> None:
        if not _is_lasting(key):
            return
        _prune(self.folder)
        path = self._path(key)
        part = path.with_name(f"{path.name}.{uuid.uuid4().hex[:12]}.tmp")
        try:
            part.write_bytes(dumps((self._stamp, key[0], data)))
            os.replace(part, path)
        finally:
            part.unlink(missing_ok=True)

    def flush(self) -> None:
        for path in self.folder.glob(f"{self._base}-*{_SUFFIX}"):
            path.unlink(missing_ok=True)

    def number(self, key: tuple[Any, ...]) -> int:
        """Number an entry: 28 bits of the digest in its file's name."""
        return int(self._digits(key)[:7], 16)

    def _path(self, key: tuple[Any, ...]) -> Path:
        return self.folder / f"{self._base}-{self._digits(key)[:16]}{_SUFFIX}"

    def _digits(self, key: tuple[Any, ...]) -> str:
        return hashlib.sha256(repr((self._base, self._stamp, key)).encode()).hexdigest()


def _is_lasting(key: tuple[Any, ...]) -> bool:
    """Return whether a key has no type that is another one in every process, as that of a function."""
    return " at 0x" not in repr(key)


def _classes(kind: Any) -> Iterator[type]:
    """Find the named tuples and enumerations among the types of a signature."""
    if isinstance(kind, tuple | list):
        for part in kind:
            yield from _classes(part)
        return
    found = getattr(kind, "instance_class", None)
    if isinstance(found, type):
        yield found
    for name in ("args", "types", "dtype", "type"):
        part = getattr(kind, name, None)
        if part is not None and part is not kind:
            yield from _classes(part)


@functools.cache
def _environment() -> tuple[Any, ...]:
    """Name the versions and settings, beside the processor, on which machine code depends."""
    versions = (sys.implementation.cache_tag, numba.__version__, llvmlite.__version__, np.__version__)
    return (_FORMAT, *versions, *((name, getattr(config, name, None)) for name in _CODE_SETTINGS))


@functools.cache
def kernel_folder() -> Path:
    """Find the folder of compiled kernels.

    It is $NUMBA_CACHE_DIR/marey if that variable is set; else `kernels` in $MAREY_CACHE_DIR if that is set; else
    `kernels` in the user's cache folder of marey, readable and writable by the user alone, because its content is
    executed. Where none can be written to, as in some containers, it is a private folder among the temporary files.
    """
    for name, given in (("NUMBA_CACHE_DIR", "marey"), ("MAREY_CACHE_DIR", "kernels")):
        if os.environ.get(name):
            folder = Path(os.environ[name]).absolute() / given
            if _is_writable(folder):
                return folder
            warnings.warn(f"{name}: {folder} cannot be written to; compiled kernels are kept elsewhere.", stacklevel=2)
            break
    owner = os.getuid() if hasattr(os, "getuid") else "user"
    temporary = Path(tempfile.gettempdir()) / f"marey-kernels-{owner}"
    for folder in (*_user_folders(), temporary):
        if _is_writable(folder) and _is_private(folder):
            return folder
    return Path(tempfile.mkdtemp(prefix="marey-kernels-"))


def _user_folders() -> list[Path]:
    """Give the user's folder by the conventions of the platform; none where the user has no home."""
    try:
        home = Path.home()
    except RuntimeError:
        return []
    if sys.platform == "win32":
        return [Path(os.environ.get("LOCALAPPDATA") or home / "AppData" / "Local") / "marey" / "Cache" / "kernels"]
    if sys.platform == "darwin":
        return [home / "Library" / "Caches" / "marey" / "kernels"]
    return [Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache") / "marey" / "kernels"]


def _is_writable(folder: Path) -> bool:
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return False
    return True


def _is_private(folder: Path) -> bool:
    """Return whether a folder is the user's own, and no other user can write to it."""
    if not hasattr(os, "getuid"):
        return True
    state = folder.lstat()
    others = stat.S_IWGRP | stat.S_IWOTH
    return stat.S_ISDIR(state.st_mode) and state.st_uid == os.getuid() and not state.st_mode & others


def _note_use(path: Path) -> None:
    if time.time() - path.stat().st_mtime > _DAY_S:
        os.utime(path)


@functools.cache
def _prune(folder: Path) -> None:
    """Delete what was not used for long, once in a process."""
    oldest = time.time() - KEPT_UNUSED_DAYS * _DAY_S
    for path in folder.iterdir():
        if path.suffix in (_SUFFIX, ".tmp"):
            with contextlib.suppress(FileNotFoundError):  # Another process may delete it at the same time.
                if path.stat().st_mtime < oldest:
                    path.unlink()
