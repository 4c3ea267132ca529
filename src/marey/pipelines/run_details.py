"""Details of the run that produced a result, for its record and its page, and checkpoints to resume it."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory

from marey.io.stages import file_fingerprint
from marey.pipelines.progress import Progress, RecordingProgress
from marey.pipelines.run_record import StageCache, record_of
from marey.pipelines.verdict import Level, Verdict
from marey.view.pages.html import PageHead
from marey.view.pages.problems import Severity


@dataclass(frozen=True, eq=False, kw_only=True)
class RunDetails:
    """The settings, inputs, warnings and times of a run."""

    command: str
    """The command that writes the same files, for example `markers`."""
    settings: Mapping[str, object]
    """Settings by name."""
    inputs: tuple[Path, ...] = ()
    """The files that were read."""
    root: Path = Path()
    """The folder to which the names of the inputs are relative in run.json."""
    warnings: tuple[str, ...] = ()
    """Warnings of the run, one sentence each."""
    timings: Mapping[str, float] = field(default_factory=dict)
    """Seconds by stage."""
    steps: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """Seconds by step, for the stages that name their steps."""
    verdict: Verdict | None = None
    """How far the result can be used; None for a command that measures nothing, and for results of earlier versions."""

    @staticmethod
    def of(
        command: str, settings: Mapping[str, object], inputs: Sequence[Path], root: Path, progress: Progress, *,
        verdict: Verdict | None = None,
    ) -> "RunDetails":  # fmt: skip
        """Collect the details at the end of a run.

        Args:
            command: The command that writes the same files.
            settings: Settings by name.
            inputs: The files that were read.
            root: The folder to which the names of the inputs are relative.
            progress: Progress reporter with the recorded warnings and times.
            verdict: The verdict on the result; None for a command that measures nothing.
        """
        return RunDetails(
            command=command, settings=dict(settings), inputs=tuple(inputs), root=root,
            warnings=tuple(progress.warnings), timings=dict(progress.timings),
            steps={name: dict(each) for name, each in progress.steps.items()}, verdict=verdict,
        )  # fmt: skip

    @staticmethod
    def read(folder: Path, command: str, *, file: str) -> "RunDetails":
        """Read the details of the run that wrote a file.

        Args:
            folder: A folder of results.
            command: The command that writes this file.
            file: Name of the file in the folder.

        Returns:
            Empty details if the folder has no record of such a run.
        """
        record = record_of(folder, file)
        return RunDetails(
            command=command, settings=record.get("settings", {}), root=folder,
            warnings=tuple(map(str, record.get("warnings", ()))), timings=record.get("timings_s", {}),
            steps=record.get("steps_s", {}), verdict=Verdict.from_record(record),
        )  # fmt: skip

    def resumed_progress(self) -> RecordingProgress:
        """Return a progress reporter that continues the record of the run."""
        progress = RecordingProgress()
        progress.warnings.extend(self.warnings)
        progress.timings.update(self.timings)
        progress.steps.update({name: dict(each) for name, each in self.steps.items()})
        return progress


_GRADES: Mapping[Level, Severity] = {"not usable": "problem", "usable with limits": "caution", "good": "note"}
"""How grave a reason is that allows a verdict of each level at best."""


def page_head(command: str, verdict: Verdict | None, *, person: object = None) -> PageHead:
    """Return what the head of a page states: the command, the date, the person, and the verdict.

    Args:
        command: Name of the command, as in run.json.
        verdict: The verdict, as in run.json; None for a command that measures nothing.
        person: The person that was chosen; None if there was no choice.
    """
    return PageHead(
        command=f"marey {command}", finished=datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        person="" if person is None else str(person), verdict=None if verdict is None else verdict.texts(),
        grades=() if verdict is None else [_GRADES[each.level] for each in verdict.reasons],
    )  # fmt: skip


@contextmanager
def checkpoints(out: Path | None, inputs: Sequence[Path], *, results: Sequence[str] = ()) -> Iterator[StageCache]:
    """Open the checkpoints of a run: in the folder of its results, or in a temporary folder if there is none.

    Args:
        out: Folder of the results; None if nothing is to be written.
        inputs: The files that are read; checkpoints of other files are not used.
        results: Names of files that are written in any case; those of the user are not replaced.

    Yields:
        The checkpoints.
    """
    if out is not None:
        with StageCache(out, [file_fingerprint(path) for path in inputs], files=inputs, results=results) as cache:
            yield cache
        return
    with TemporaryDirectory(prefix="marey-") as folder, StageCache(Path(folder) / "run", ()) as cache:
        yield cache


@contextmanager
def writable_folder(out: Path, inputs: Sequence[Path], *, results: Sequence[str] = ()) -> Iterator[None]:
    """Make sure, before the work begins, that results can be written to a folder.

    Args:
        out: The folder; it is created if it does not exist, and removed again if nothing was written to it.
        inputs: The input files; results must not mix with them.
        results: Names of files that are written in any case; those of the user are not replaced.

    Yields:
        Nothing.

    Raises:
        FileProblem: It cannot be written to, holds inputs, or another run uses it.
    """
    cache = StageCache(out, (), files=inputs, results=results)
    try:
        yield
    finally:
        cache.close()
