"""The folder `.work` of a run in the folder of its results: marked as ours, and locked while the run lasts."""

import json
import os
import shutil
import socket
import sys
import threading
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

from marey.errors import FileProblem
from marey.file_locks import lock_byte
from marey.io.atomic import naming_unwritten, replacing
from marey.io.run_files import files_of_runs

WORK = ".work"
"""Name of the folder for checkpoints in the folder of the results."""
_MARK = "CACHEDIR.TAG"
"""File that marks the folder as ours; programs for backups leave out folders with such a file."""
_MARK_TEXT = "Signature: 8a477f597d28d172789f06886806bc55\n# Checkpoints of marey, deleted at the end of a run.\n"
"""Content of the mark: the signature of the Cache Directory Tagging Specification, and the program."""
_LOCK = "lock"
"""File that names the run which uses the folder."""
_LOCK_PLACE = 1 << 30
"""Number of the byte that is locked, far behind the text, which other processes read."""
_MOVES = "moves.json"
"""File with the names of results that are about to be moved to their places."""
_KEPT = (_MARK, _LOCK, _MOVES)
"""Files that are no checkpoints."""


@dataclass
class _Held:
    """The lock of a folder in this process."""

    file: int
    thread: int
    users: int = 0
    inputs: set[Path] = field(default_factory=set)


_HELD: dict[Path, _Held] = {}
"""The folders that this process has locked, by their resolved paths."""
_REGISTRY = threading.Lock()
"""Protects `_HELD` if several threads open folders."""


class WorkFolder:
    """The checkpoints of a run, in `.work` in the folder of its results, which no other run can use at the same time.

    The lock is given free by `close`, and by the operating system if the process is killed. Within one thread, the
    folder can be opened several times.

    Args:
        out: Folder for the results; it is created if it does not exist.
        inputs: Input files of the run, which results must not replace.

    Raises:
        FileProblem: The folder cannot be created, another run uses it, or it has a `.work` that is not ours.
    """

    def __init__(self, out: Path, inputs: Iterable[Path] = ()):
        self.out, self.path = out, out / WORK
        self._key = out.resolve()
        self._is_open = True
        _require_ours(self.path)
        with _REGISTRY:
            held = _HELD.get(self._key)
            if held is None:
                held = _HELD[self._key] = _Held(_locked(self.path), threading.get_ident())
                _mark(self.path)
            elif held.thread != threading.get_ident():
                raise _in_use(out, _description())
            held.users += 1
            held.inputs |= {path.resolve() for path in inputs}

    @property
    def inputs(self) -> frozenset[Path]:
        """The inputs of the run that uses the folder, resolved."""
        return frozenset(_HELD[self._key].inputs)

    def clear(self) -> None:
        """Delete all checkpoints, unless a run of which this one is a part still needs its own."""
        if _HELD[self._key].users > 1:
            return
        with suppress(OSError):
            for path in self.path.iterdir():
                if path.name not in _KEPT:
                    _remove(path)

    def close(self) -> None:
        """Give the folder free, and remove it, and the folder of the results, if they are empty."""
        if not self._is_open:
            return
        self._is_open = False
        with _REGISTRY:
            held = _HELD[self._key]
            held.users -= 1
            if held.users:
                return
            del _HELD[self._key]
            # While the lock is held, no other run can begin to use the folder.
            with suppress(OSError):
                if {path.name for path in self.path.iterdir()} == {_MARK, _LOCK}:
                    (self.path / _MARK).unlink()
            with suppress(OSError):  # Windows removes no open files.
                (self.path / _LOCK).unlink()
            os.close(held.file)
        if os.name == "nt":
            with suppress(OSError):
                (self.path / _LOCK).unlink()
        for folder in (self.path, self.out):
            with suppress(OSError):
                folder.rmdir()

    def note_moves(self, names: Sequence[str]) -> None:
        """Note results that are about to be moved to the folder of the results, so that they are known as ours.

        Args:
            names: Their names, relative to the folder of the results.
        """
        with replacing(self.path / _MOVES) as beside:
            beside.write_text(json.dumps([*names, *self.noted_moves()]), encoding="utf-8")

    def moves_done(self) -> None:
        """Remove the note, because `run.json` names the results."""
        (self.path / _MOVES).unlink(missing_ok=True)

    def own_files(self) -> frozenset[str]:
        """Return the names of the files in the folder of the results that marey wrote, also in an interrupted move."""
        return files_of_runs(self.out) | frozenset(self.noted_moves())

    def noted_moves(self) -> list[str]:
        """Return the names of `note_moves`, if the run was killed before the end of the move."""
        try:
            names = json.loads((self.path / _MOVES).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return []
        return [str(name) for name in names] if isinstance(names, list) else []


def remove_lock_of_another_host(out: Path, host: str, process: int) -> None:
    """Give a folder free that a process of another computer has locked which is known to have ended.

    Locks of this computer end with their process and are left to the system.

    Args:
        out: Folder for the results.
        host: Name of that computer.
        process: Number of the process that has ended.
    """
    path = out / WORK / _LOCK
    try:
        other = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return
    named = isinstance(other, dict) and (other.get("host"), other.get("process")) == (host, process)
    if named and host != socket.gethostname():
        with suppress(OSError):
            path.unlink()


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as problem:
        wrong = f"cannot be created ({problem.strerror})"
        raise FileProblem(folder, wrong, "Give another folder for the results (--out).") from problem


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def _require_ours(folder: Path) -> None:
    """Check that a folder for checkpoints is new, or marked as ours.

    Raises:
        FileProblem: It has content, but no mark.
    """
    _make_folder(folder)
    content = {path.name for path in folder.iterdir()}
    if content.difference(_KEPT) and not _is_marked(folder):
        remedy = "Rename or remove it, or give another folder for the results (--out)."
        raise FileProblem(folder, "holds files that are not checkpoints of this version of marey", remedy)


def _is_marked(folder: Path) -> bool:
    try:
        return (folder / _MARK).read_text(encoding="utf-8", errors="replace") == _MARK_TEXT
    except OSError:
        return False


def _mark(folder: Path) -> None:
    if not _is_marked(folder):
        with naming_unwritten(folder / _MARK):
            (folder / _MARK).write_text(_MARK_TEXT, encoding="utf-8")


def _locked(folder: Path) -> int:
    """Lock the folder for this process; return the descriptor of the file."""
    path = folder / _LOCK
    while True:
        _make_folder(folder)
        with naming_unwritten(path):
            try:
                file = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
            except FileNotFoundError:  # The other run has just ended, and removed the folder.
                continue
        try:
            _require_unused(folder, file)
            # The other run may have ended, and removed the file, after it was opened here.
            if path.exists() and os.path.samestat(os.fstat(file), path.stat()):
                os.lseek(file, 0, os.SEEK_SET)
                os.ftruncate(file, 0)
                with naming_unwritten(path):
                    os.write(file, json.dumps(_description()).encode())
                return file
        except BaseException:
            os.close(file)
            raise
        os.close(file)


def _require_unused(folder: Path, file: int) -> None:
    """Check that no other run uses the folder, and lock it."""
    other = _read(file)
    try:
        is_free = lock_byte(file, _LOCK_PLACE)
    except OSError:  # The file system has no locks.
        is_free = not _exists(other.get("process"))
    # The process of another computer cannot be seen, and locks are not always shared between computers.
    elsewhere = other.get("host", socket.gethostname()) != socket.gethostname()
    if elsewhere or not is_free:
        raise _in_use(folder.parent, other, folder / _LOCK if elsewhere else None)


def _read(file: int) -> dict[str, object]:
    """Read who uses the folder; empty if that is not known."""
    os.lseek(file, 0, os.SEEK_SET)
    try:
        found = json.loads(os.read(file, 1 << 16))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def _exists(process: object) -> bool:
    """Return whether a process of this computer exists."""
    if not isinstance(process, int) or process <= 0:
        return False
    if os.name == "nt":  # There, a signal would end the process; file systems of Windows have locks.
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True


def _description() -> dict[str, object]:
    """Describe this process for others."""
    now = datetime.now(UTC).isoformat(timespec="seconds")
    command = " ".join(sys.argv)[:1000]
    return {"process": os.getpid(), "host": socket.gethostname(), "started": now, "command": command}


def _in_use(out: Path, other: dict[str, object], file: Path | None = None) -> FileProblem:
    who = ", ".join(
        f"{name} {other[key]}"
        for key, name in (("process", "process"), ("host", "on"), ("started", "since"), ("command", "command"))
        if key in other
    )
    known = f" ({who})" if who else ""
    remedy = "Wait until it has ended, or give another folder for the results (--out)."
    if file is not None:
        remedy += f" If that computer was switched off, remove {file}."
    return FileProblem(out, f"is in use by another run of marey{known}", remedy)
