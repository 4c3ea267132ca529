"""One step of one trial: what a worker does with the small record that it receives."""

import os
import socket
import sys
import time
import traceback
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import marey
from marey.errors import FileProblem, MareyError, NotWritten
from marey.fit.solver.threads import one_thread
from marey.io.run_files import files_of_runs
from marey.io.stages import file_fingerprint
from marey.io.study.inputs import recorded_inputs_are_unchanged, trial_fingerprint
from marey.io.study.records import StepRecord, read_step_record, write_step_record
from marey.io.work_folder import remove_lock_of_another_host
from marey.pipelines.progress import RecordingProgress
from marey.pipelines.run_record import fingerprint
from marey.pipelines.study.commands import REPORTS, run_command
from marey.pipelines.study.quantities import quantities_of
from marey.pipelines.verdict import NotUsable, Verdict
from marey.process import tuned_process

_MEGABYTE = 1e6
"""Bytes of a megabyte in records."""


@dataclass(frozen=True, kw_only=True)
class StepTask:
    """What a worker needs to know of a step: paths and settings, no data."""

    trial: str
    """Name of the trial."""
    step: str
    """Name of the step."""
    command: str
    """The command of the step."""
    path: str
    """The folder or file of the trial, absolute."""
    out: str
    """Folder for the results of the step, absolute; its record is beside it."""
    settings: Mapping[str, Any]
    """Settings as study.toml states them, with filled placeholders; the part of the key that is no file."""
    files: Mapping[str, Any]
    """The settings that are files: absolute paths, or tuples of them."""
    version: str
    """Version of the program that gives the task."""

    @property
    def record(self) -> Path:
        """The file with the record of the step."""
        folder = Path(self.out)
        return folder.with_name(f"{folder.name}.json")


@dataclass(frozen=True, kw_only=True)
class StepOutcome:
    """What a worker returns of a step; everything else is in the files."""

    trial: str
    """Name of the trial."""
    step: str
    """Name of the step."""
    state: str
    """`done`, `reused` (an earlier run has done it), or `failed`."""
    message: str = ""
    """Why it failed."""
    seconds: float = 0.0
    """Duration [s]."""
    interruptions: int = 0
    """Number of times that it was cut off and begun again."""


def run_step(task: StepTask) -> StepOutcome:
    """Do a step of a trial, unless its results exist for the same version, settings and inputs.

    Nothing is raised for errors of a trial: they are the outcome of the step.

    Args:
        task: The step.

    Returns:
        The outcome.
    """
    started = time.perf_counter()
    try:
        _require_same_version(task)
        before, files = read_step_record(task.record), _hashed_files(task)
        key = _key(task, files)
        if before is not None and before.key == key and _is_done(before, task, files):
            return StepOutcome(trial=task.trial, step=task.step, state="reused", interruptions=before.interruptions)
        record = _begun(task, before, key)
        write_step_record(task.record, record)
        record = _worked(task, record, started)
        write_step_record(task.record, record)
    except MareyError as error:
        return _failed(task, str(error), started)
    except OSError as error:
        return _failed(task, f"{error.filename or task.out}: {error.strerror or error}.", started)
    return StepOutcome(
        trial=task.trial, step=task.step, state=record.state, message=record.message, seconds=record.seconds,
        interruptions=record.interruptions,
    )  # fmt: skip


def _require_same_version(task: StepTask) -> None:
    if task.version != marey.__version__:
        wrong = f"the worker on {socket.gethostname()} has marey {marey.__version__}, and the study {task.version}"
        raise MareyError(f"{task.trial}: {wrong}. Install the same version on all workers.")


def _hashed_files(task: StepTask) -> dict[str, list[str | None]]:
    """Return the hashes of the files that settings name; None for those that do not exist."""
    each = {name: [value] if isinstance(value, str) else value for name, value in task.files.items()}
    return {
        name: [file_fingerprint(Path(path)) if Path(path).exists() else None for path in paths]
        for name, paths in each.items()
    }  # fmt: skip


def _key(task: StepTask, files: Mapping[str, list[str | None]]) -> str:
    """Return the hash of everything on which the results depend."""
    return fingerprint(task.version, task.command, dict(task.settings), files, trial_fingerprint(Path(task.path)))


def _is_done(record: StepRecord, task: StepTask, files: Mapping[str, list[str | None]]) -> bool:
    """Return whether the results exist, and the inputs that the run recorded have not changed since."""
    if record.state != "done":
        return False
    if record.message:  # a run without results, whose verdict is "not usable"
        return True
    folder, path = Path(task.out), Path(task.path)
    root = path if path.is_dir() else Path(task.files.get("file", path)).parent
    complete = all((folder / name).is_file() for name in files_of_runs(folder))
    known = frozenset(digest for each in files.values() for digest in each if digest is not None)
    return complete and recorded_inputs_are_unchanged(folder, root, known=known)


def _begun(task: StepTask, before: StepRecord | None, key: str) -> StepRecord:
    """Return the record of a step that begins, and give its folder free if a lost worker still holds it."""
    again = before is not None and before.state == "running"
    if again and before is not None:
        remove_lock_of_another_host(Path(task.out), before.host, before.process)
    return StepRecord(
        state="running", key=key, host=socket.gethostname(), process=os.getpid(),
        interruptions=(before.interruptions + 1 if again and before is not None else 0),
    )  # fmt: skip


def _worked(task: StepTask, record: StepRecord, started: float) -> StepRecord:
    """Run the command and return the record of its end."""
    out, progress = Path(task.out), RecordingProgress()
    report = Path()
    found: dict[str, Any] = {"state": "done"}
    try:
        with one_thread(), tuned_process():
            verdict = run_command(task.command, Path(task.path), _given(task), out, progress)
        found["values"] = quantities_of(out)
        found |= _judged(verdict)
    except NotUsable as answer:
        found |= {**_judged(answer.verdict), "message": str(answer).replace("\n", " ")}
        report = answer.report or Path()
    except NotWritten:
        raise
    except MareyError as error:
        found = {"state": "failed", "message": str(error)}
    except Exception as error:  # an error of the program costs the step of this trial only
        last = f"{type(error).__name__}: {error}".splitlines()[0]
        found = {"state": "failed", "message": f"error of the program ({last})", "traceback": traceback.format_exc()}
    pages = [report, *(out / name for name in REPORTS)]
    found["report"] = next((str(page.name) for page in pages if page.name and (out / page.name).is_file()), "")
    return replace(record, seconds=time.perf_counter() - started, memory_mb=_peak_memory(), **found)


def _given(task: StepTask) -> dict[str, Any]:
    """Return the arguments of the command."""
    return {**{key: value for key, value in task.settings.items() if key not in task.files}, **task.files}


def _judged(verdict: Verdict | None) -> dict[str, Any]:
    if verdict is None:
        return {}
    level, reasons = verdict.texts()
    return {"verdict": level, "reasons": tuple(reasons)}


def _peak_memory() -> float:
    """Return the largest memory of this process [MB]; 0 where the system does not state it."""
    try:
        import resource
    except ImportError:  # Windows
        return 0.0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak * (1.0 if sys.platform == "darwin" else 1024.0) / _MEGABYTE


def _failed(task: StepTask, message: str, started: float) -> StepOutcome:
    """Return the outcome of a step that failed outside of its command: an unreadable input, a full disk."""
    seconds = time.perf_counter() - started
    record = StepRecord(state="failed", key="", host=socket.gethostname(), process=os.getpid(), seconds=seconds)
    with suppress(FileProblem, OSError):  # on a full disk, the outcome alone names it
        write_step_record(task.record, replace(record, message=message))
    return StepOutcome(trial=task.trial, step=task.step, state="failed", message=message, seconds=seconds)
