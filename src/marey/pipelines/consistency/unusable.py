"""The record and the page of a run that ended without a usable answer."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from marey.io.trial.trial import Trial
from marey.pipelines.progress import Progress
from marey.pipelines.run_details import page_head
from marey.pipelines.run_record import finished_together, write_record
from marey.pipelines.verdict import NotUsable, Verdict
from marey.view.pages.html import PageHead, Still, rendered

_CAPTURED = (
    "Nothing was captured: the verdict states why every result would be wrong. After the cause is removed, run the "
    "same command again."
)
"""What the page of a capture explains."""


@dataclass(frozen=True, eq=False, kw_only=True)
class UnusableContent:
    """Content of the page."""

    kind: str
    """What the page is, above its title."""
    title: str
    happened: str
    """What happened, as sentences."""
    head: PageHead
    stills: Sequence[Still] = ()
    timings: Mapping[str, float] = field(default_factory=dict)
    """Seconds by stage."""
    settings: Mapping[str, object] = field(default_factory=dict)
    files: Mapping[str, str] = field(default_factory=dict)
    notes: Sequence[str] = ()


@dataclass(frozen=True, eq=False, kw_only=True)
class UnusableRun:
    """A run that ended without a usable answer."""

    command: str
    """The command, as in run.json."""
    kind: str
    """What its page is, above the title."""
    title: str
    page: str
    """File name of the page."""
    happened: str
    """What happened, as sentences."""
    settings: Mapping[str, object]
    inputs: Sequence[Path]
    """The files that were read."""
    folders: Sequence[Path] = ()
    """Folders of inputs, with which results must not mix."""
    root: Path
    """The folder to which the names of the inputs are relative in run.json."""
    verdict: Verdict
    person: object = None
    """The person that was chosen; None if there was no choice."""


def write_not_usable(out: Path, trial: Trial, verdict: Verdict, progress: Progress, command: str = "capture") -> Path:
    """Write run.json and report.html of a capture that ended without a usable answer; earlier results are removed.

    Args:
        out: Folder for the results.
        trial: The trial.
        verdict: The verdict.
        progress: Progress reporter, with timings and warnings.
        command: The command.

    Returns:
        The page.
    """
    run = UnusableRun(
        command=command, kind="Motion capture report", title=trial.folder.resolve().name, page="report.html",
        happened=_CAPTURED, settings=trial.settings.model_dump(mode="json", exclude_none=True),
        inputs=trial.input_files, folders=[trial.folder], root=trial.folder, verdict=verdict,
        person=trial.settings.person,
    )  # fmt: skip
    return write_unusable_run(out, run, progress)


def write_unusable_run(out: Path, run: UnusableRun, progress: Progress) -> Path:
    """Write run.json and the page of a run that ended without a usable answer; earlier results are removed.

    Args:
        out: Folder for the results.
        run: The run.
        progress: Progress reporter, with timings and warnings.

    Returns:
        The page.
    """
    content = UnusableContent(
        kind=run.kind, title=run.title, happened=run.happened, settings=run.settings, timings=progress.timings,
        head=page_head(run.command, run.verdict, person=run.person),
    )  # fmt: skip
    with finished_together(out, inputs=[*run.folders, *run.inputs]) as folder:
        (folder / run.page).write_text(rendered("unusable.html", content, data={}), encoding="utf-8")
        write_record(
            folder, command=run.command, settings=run.settings, inputs=run.inputs, root=run.root, progress=progress,
            verdict=run.verdict,
        )  # fmt: skip
    return out / run.page


@contextmanager
def with_unusable_page(
    out: Path | None, described: Callable[[Verdict], UnusableRun], progress: Progress
) -> Iterator[None]:
    """Write the record and the page if the work ends without a usable answer.

    Args:
        out: Folder for the results; None writes nothing.
        described: Returns the description of the run with a verdict.
        progress: Progress reporter, with timings and warnings.

    Yields:
        Nothing.

    Raises:
        NotUsable: The work ended so; the error names the page if one was written.
    """
    try:
        yield
    except NotUsable as problem:
        if out is None:
            raise
        raise NotUsable(problem.verdict, write_unusable_run(out, described(problem.verdict), progress)) from problem
