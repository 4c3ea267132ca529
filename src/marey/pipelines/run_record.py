"""The record of a run (run.json), the checkpoints of an interrupted one, and results that appear all at once."""

import hashlib
import json
import os
import platform
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

import marey
from marey.errors import MareyError, NotWritten
from marey.io.atomic import naming_unwritten, sync_files, sync_folder, synced_later
from marey.io.run_files import RECORD, read_record, records_in, require_own_folder
from marey.io.stages import Arrays, FrameLog, file_fingerprint, saved_arrays
from marey.io.work_folder import WorkFolder
from marey.pipelines.progress import Progress
from marey.pipelines.verdict import Verdict


def fingerprint(*parts: object) -> str:
    """Return 32 hexadecimal digits that change with any of the parts: numbers, texts, arrays, records, collections."""
    digest = hashlib.blake2b(digest_size=16)
    for part in parts:
        _add(digest, part)
    return digest.hexdigest()


def _add(digest: "hashlib.blake2b", part: object) -> None:
    digest.update(type(part).__name__.encode() + b"\0")
    if isinstance(part, np.ndarray):
        digest.update(f"{part.dtype}{part.shape}".encode())
        digest.update(np.ascontiguousarray(part).tobytes())
    elif is_dataclass(part) and not isinstance(part, type):
        for field in fields(part):
            _add(digest, (field.name, getattr(part, field.name)))
    elif isinstance(part, Mapping):
        for key in part:
            _add(digest, (str(key), part[key]))
    elif isinstance(part, list | tuple):
        for item in part:
            _add(digest, item)
    elif part is None or isinstance(part, str | bytes | int | float | Path | np.generic):
        digest.update(repr(part).encode() + b"\0")
    else:
        raise TypeError(f"no fingerprint of a {type(part).__name__}")


class StageCache:
    """Checkpoints: the results of the stages of a run, stored in the folder of its results while the run lasts.

    The result of a stage is used again only for the same version, inputs and settings. As a context manager, it deletes
    everything when the run has ended, or has failed by an error that the user must correct. After an interruption, an
    error of the program, or an error that `resumes`, such as a full disk, the checkpoints stay for the next run. No
    other run can use the folder of the results at the same time.

    Args:
        out: Folder for the results of the run.
        inputs: Fingerprints of the input files, and everything else that all stages depend on.
        files: The input files and folders; results must not mix with them.
        results: Names of files that the run will write in any case, so that a file of the user that has one of them is
            reported before the work.

    Raises:
        FileProblem: The folder cannot be used: it holds inputs, another run uses it, or it cannot be written to.
        NotWritten: A result has the name of a file that marey did not write.
    """

    def __init__(self, out: Path, inputs: object, *, files: Iterable[Path] = (), results: Iterable[str] = ()):
        named = list(files)
        require_own_folder(out, named)
        self._work = WorkFolder(out, named)
        try:
            _require_replaceable([Path(name) for name in (*results, RECORD)], self._work)
        except NotWritten:
            self._work.close()
            raise
        self.folder = self._work.path
        self._key = (marey.__version__, fingerprint(inputs))

    def arrays(self, name: str, compute: Callable[[], Mapping[str, np.ndarray]], *, depends: object = None) -> Arrays:
        """Return the stored result of a stage, or compute and store it.

        Args:
            name: Name of the stage, which becomes part of a file name.
            compute: Returns the result: arrays by name, none of them of Python objects.
            depends: Settings on which this stage depends.

        Returns:
            Arrays by name.
        """
        return saved_arrays(self._path(name, depends, ".npz"), compute)

    def frames(self, name: str, *, depends: object = None) -> FrameLog:
        """Open the log of a stage that works frame by frame; its length is the number of finished frames."""
        return FrameLog(self._path(name, depends, ".log"))

    def clear(self) -> None:
        """Delete all checkpoints."""
        self._work.clear()

    def close(self) -> None:
        """End the use of the folder; it is removed if it is empty."""
        self._work.close()

    def __enter__(self) -> "StageCache":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None or (issubclass(kind, MareyError) and not kind.resumes):
            self.clear()
        self.close()

    def _path(self, name: str, depends: object, ending: str) -> Path:
        path = self.folder / f"{name}-{fingerprint(self._key, name, depends)}{ending}"
        for other in self.folder.glob("*" + ending):
            # A checkpoint of another version or of other settings is never used again.
            if other.stem[:-33] == name and other != path:
                other.unlink()
        return path


@contextmanager
def finished_together(out: Path, *, inputs: Iterable[Path] = ()) -> Iterator[Path]:
    """Make the results of a run appear all at once at its end, or not at all.

    Args:
        out: Folder for the results.
        inputs: The input files of the run, if it has no `StageCache`.

    Yields:
        A folder in which to write them. If the block succeeds, they are moved to `out`, and further files of the last
        run of the same command are deleted there; if it fails, `out` is not changed.

    Raises:
        FileProblem: The folder cannot be used.
        NotWritten: A result has the name of an input, or of a file that marey did not write.
    """
    named = list(inputs)
    require_own_folder(out, named)
    work = WorkFolder(out, named)
    staging = work.path / "results"
    try:
        shutil.rmtree(staging, ignore_errors=True)
        with naming_unwritten(staging):
            staging.mkdir()
        with synced_later(staging):
            yield staging
        _move_in(staging, work)
    finally:
        shutil.rmtree(staging, ignore_errors=True)
        work.close()


def _move_in(staging: Path, work: WorkFolder) -> None:
    out = work.out
    files = sorted(path.relative_to(staging) for path in staging.rglob("*") if path.is_file())
    # The record goes last: a folder whose run.json names this run holds all of its results.
    files.sort(key=lambda name: str(name) == RECORD)
    _require_replaceable(files, work)
    old = _carry_over(staging, out) | _left_over(staging, work)
    with naming_unwritten(out):
        sync_files(staging / name for name in files)
        work.note_moves([name.as_posix() for name in {*files, *old}])
        folders = {(out / name).parent for name in files}
        for folder in sorted(folders):
            folder.mkdir(parents=True, exist_ok=True)
        for name in files:
            if str(name) == RECORD:
                _sync_folders(folders)
            os.replace(staging / name, out / name)
        for name in old - set(files):
            (out / name).unlink(missing_ok=True)
        sync_folder(out)
    work.moves_done()


def _left_over(staging: Path, work: WorkFolder) -> set[Path]:
    """Return the files that a killed run has moved to the folder of the results, and that no record names."""
    recorded = {str(name) for folder in (work.out, staging) for run in records_in(folder) for name in run["files"]}
    return {Path(name) for name in work.noted_moves() if name not in recorded}


def _sync_folders(folders: Iterable[Path]) -> None:
    for folder in folders:
        sync_folder(folder)


def _require_replaceable(files: Sequence[Path], work: WorkFolder) -> None:
    """Check that results replace no inputs, and nothing that marey did not write."""
    own = work.own_files()
    for name in files:
        path = work.out / name
        if path.resolve() in work.inputs:
            raise NotWritten(path, "it is an input of this run", "Move the input to another folder.")
        if path.is_dir() or (os.path.lexists(path) and name.as_posix() not in own):
            raise NotWritten(path, "marey did not write what has this name", "Rename it, or move it elsewhere.")
        for folder in name.parents[:-1]:
            if os.path.lexists(work.out / folder) and not (work.out / folder).is_dir():
                raise NotWritten(work.out / folder, "there is a file of this name", "Rename it.")


def _carry_over(staging: Path, out: Path) -> set[Path]:
    """Copy the records of other commands to the new record; return files of the last run of the same command."""
    now, before = read_record(staging), read_record(out)
    earlier = before.pop("earlier", {})
    earlier = earlier if isinstance(earlier, dict) else {}
    earlier[before.get("command")] = before
    last = earlier.pop(now.get("command"), {})
    earlier = {command: record for command, record in earlier.items() if command}
    if earlier:
        _write_json(staging / RECORD, now | {"earlier": earlier})
    # A file that two commands write belongs to the later one; other files of the earlier one stay.
    kept = {name for record in earlier.values() for name in record.get("files", [])}
    names = {Path(name) for name in last.get("files", []) if name not in kept}
    return {name for name in names if not name.is_absolute() and ".." not in name.parts}


def record_of(folder: Path, file: str) -> dict[str, Any]:
    """Return the record of the run that wrote a file of a folder, as `run.json` holds it.

    Args:
        folder: A folder with results of one or several commands.
        file: Name of the file.

    Returns:
        The record without those of other commands; empty if no run lists the file.
    """
    return next((record for record in records_in(folder) if file in record["files"]), {})


def _write_json(path: Path, record: Mapping[str, object]) -> None:
    # Names of files that are not valid Unicode are written with JSON's own escapes.
    text = json.dumps(record, indent=2, ensure_ascii=False, default=str) + "\n"
    with naming_unwritten(path):
        path.write_text(text, encoding="utf-8", errors="backslashreplace")


def write_record(
    folder: Path,
    *,
    command: str,
    settings: Mapping[str, object],
    inputs: Sequence[Path],
    root: Path,
    progress: Progress,
    verdict: Verdict | None = None,
    more: Mapping[str, object] | None = None,
) -> None:
    """Write run.json: version, settings, inputs with their fingerprints, timings, and the results beside it.

    Args:
        folder: The folder that holds all other results of the run.
        command: Name of the command, for example `capture`.
        settings: Settings by name; values that JSON does not have are written as text.
        inputs: The files that were read.
        root: The folder to which the names of the inputs are relative.
        progress: Progress reporter, with timings and warnings.
        verdict: The verdict on the results; None for a command that measures nothing.
        more: Further figures of the run by name, which JSON has.
    """
    record = {
        "program": "marey",
        "version": marey.__version__,
        "command": command,
        "finished": datetime.now(UTC).isoformat(timespec="seconds"),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "system": f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
        "settings": dict(settings),
        "inputs": {_name(path, root): file_fingerprint(path) for path in inputs},
        "timings_s": _rounded(progress.timings),
        **({"steps_s": {name: _rounded(each) for name, each in progress.steps.items()}} if progress.steps else {}),
        **(more or {}),
        **({} if verdict is None else {"verdict": verdict.as_record()}),
        "warnings": list(progress.warnings),
        "files": [*sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()), RECORD],
    }
    _write_json(folder / RECORD, record)


def _rounded(seconds: Mapping[str, float]) -> dict[str, float]:
    return {name: round(each, 3) for name, each in seconds.items()}


def _name(path: Path, root: Path) -> str:
    return path.relative_to(root).as_posix() if path.is_relative_to(root) else str(path)
