"""The record and the page of a run that ended without a usable answer."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from marey.io.trial.trial import Trial
from marey.pipelines.progress import Progress
from marey.pipelines.run_details import page_head
from marey.pipelines.run_record import finished_together, write_record
from marey.pipelines.verdict import Verdict
from marey.view.pages.html import PageHead, Still, rendered


@dataclass(frozen=True, eq=False, kw_only=True)
class UnusableContent:
    """Content of the page."""

    title: str
    head: PageHead
    stills: Sequence[Still] = ()
    timings: Mapping[str, float] = field(default_factory=dict)
    """Seconds by stage."""
    settings: Mapping[str, object] = field(default_factory=dict)
    files: Mapping[str, str] = field(default_factory=dict)
    notes: Sequence[str] = ()


def write_not_usable(out: Path, trial: Trial, verdict: Verdict, progress: Progress, command: str = "capture") -> Path:
    """Write run.json and report.html of a run that ended without a usable answer; earlier results are removed.

    Args:
        out: Folder for the results.
        trial: The trial.
        verdict: The verdict.
        progress: Progress reporter, with timings and warnings.
        command: The command.

    Returns:
        The page.
    """
    settings = trial.settings.model_dump(mode="json", exclude_none=True)
    content = UnusableContent(
        title=trial.folder.resolve().name, head=page_head(command, verdict, person=trial.settings.person),
        timings=progress.timings, settings=settings,
    )  # fmt: skip
    with finished_together(out, inputs=[trial.folder, *trial.input_files]) as folder:
        (folder / "report.html").write_text(rendered("unusable.html", content, data={}), encoding="utf-8")
        write_record(
            folder, command=command, settings=settings, inputs=trial.input_files, root=trial.folder,
            progress=progress, verdict=verdict,
        )  # fmt: skip
    return out / "report.html"
