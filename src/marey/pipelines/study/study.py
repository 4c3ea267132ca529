"""`marey study`: every trial of a folder through the same steps, one table and one page."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import marey
from marey.extras import import_optional
from marey.io.study.records import StepRecord, read_step_record
from marey.io.study.settings import STUDY_FILE, StepTable, StudySettings, filled, read_study
from marey.io.study.tables import (
    MeanRow,
    StudyRow,
    SubjectRow,
    TrialRow,
    write_parquet,
    write_table,
)
from marey.io.study.trials import StudyTrial, find_trials
from marey.pipelines.progress import Progress, RecordingProgress
from marey.pipelines.run_details import page_head, writable_folder
from marey.pipelines.run_record import finished_together, write_record
from marey.pipelines.study.cluster import opened_client
from marey.pipelines.study.curves import study_curves
from marey.pipelines.study.schedule import NOT_BEGUN, TrialPlan, run_plans
from marey.pipelines.study.steps import StepOutcome, StepTask
from marey.pipelines.study.summary import mean_rows, study_rows, subject_rows
from marey.pipelines.values import PathLike, issue_warnings, optional_path
from marey.pipelines.verdict import LEVELS, MOST_WITHOUT_RESULT, Verdict, VerdictReason
from marey.view.study.study_report import StudyContent, StudyCurve, write_study_report
from marey.wording import count_of, listed

STUDY_RESULTS = (
    "study.csv", "study.parquet", "trials.csv", "subjects.csv", "means.csv", "study.html",
)  # fmt: skip
"""Files that every study writes."""
_RESULTS = "results"
"""Name of the folder for the results in the folder of the study."""
_SHOWN = 5
"""Number of trials that a reason of the verdict names; chosen by hand."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Study:
    """The results of a study.

    Example:
        >>> import marey
        >>> study = marey.run_study("gait_study", workers=4)  # doctest: +SKIP
        >>> [row for row in study.means if row.quantity == "speed"]  # doctest: +SKIP
    """

    folder: Path
    """Folder of the tables, of the page, and of the results of the trials."""
    trials: tuple[TrialRow, ...]
    """What became of each step of each trial, as in `trials.csv`."""
    rows: tuple[StudyRow, ...]
    """Every quantity of every trial, as in `study.csv` and `study.parquet`."""
    subjects: tuple[SubjectRow, ...]
    """Means over the trials of each subject, as in `subjects.csv`."""
    means: tuple[MeanRow, ...]
    """Means over subjects, and differences between conditions, as in `means.csv`."""
    verdict: Verdict
    """How far the study can be used."""

    @property
    def report(self) -> Path:
        """The page."""
        return self.folder / "study.html"


def run_study(
    folder: PathLike,
    *,
    out: PathLike | None = None,
    workers: int | None = None,
    memory_gb: float | None = None,
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> Study:
    """Run the steps of `study.toml` on every trial of a folder, and write one table and one page.

    What an earlier run has done with the same version, settings and inputs is not done again. A step that fails costs
    the rest of its trial only.

    Args:
        folder: The folder with `study.toml` and the trials.
        out: Folder for the results; by default `results` in the folder of the study.
        workers: Number of worker processes on this computer; by default one per core.
        memory_gb: Memory of each of these processes, above which it is ended [GB]; by default an equal share of all.
        scheduler: Address of an existing scheduler of `dask.distributed`, instead of processes on this computer. Its
            workers must see the same folders.
        progress: Progress reporter; by default nothing is shown, and the warnings of the run are issued as Python
            warnings of the category `marey.MareyWarning`.

    Returns:
        The table, the means, and what became of each trial.

    Raises:
        FileProblem: `study.toml` cannot be used, there are no trials, or two of one name.
        SettingProblem: No scheduler answers, or a value is impossible.
        SchedulerLost: An existing scheduler ended during the study; the same call resumes.
        MissingPackage: The packages of the extra `study` are not installed.

    Example:
        >>> import marey
        >>> study = marey.run_study("gait_study", workers=4)  # doctest: +SKIP
        >>> study.report  # doctest: +SKIP
    """
    reporter = RecordingProgress() if progress is None else progress
    root = Path(folder)
    settings = read_study(root)
    results = optional_path(out) or root / _RESULTS
    trials = find_trials(root, settings, results=results)
    plans = [_plan(root, results, trial, settings) for trial in trials]
    _require_packages()
    with writable_folder(results, [root / STUDY_FILE], results=STUDY_RESULTS):
        with opened_client(scheduler, workers=workers, memory_gb=memory_gb, progress=reporter) as client:
            outcomes = run_plans(client, plans, reporter, root=root)
        found = _collected(results, trials, plans, outcomes, settings)
        curves = study_curves(trials, _usable_folders(results, found))
        _save(found, curves, root, settings, reporter)
    if progress is None:
        issue_warnings(reporter)
    return found


def _require_packages() -> None:
    """Name a missing package before hours of work, not after them."""
    for module in ("dask", "distributed", "pyarrow"):
        import_optional(module, extra="study", purpose="Studies")


def _plan(root: Path, results: Path, trial: StudyTrial, settings: StudySettings) -> TrialPlan:
    steps = settings.steps_of(trial.name, trial.subject)
    return TrialPlan(trial=trial.name, tasks=tuple(_task(root, results, trial, step) for step in steps))


def _task(root: Path, results: Path, trial: StudyTrial, step: StepTable) -> StepTask:
    own = results.resolve() / trial.name
    around = trial.path if trial.path.is_dir() else trial.path.parent
    names = {
        "trial": trial.name, "subject": trial.subject, "condition": trial.condition,
        "folder": around.relative_to(root).as_posix(), "results": str(own),
    }  # fmt: skip
    given = step.given()
    # The key must not change when the study is moved: it contains the paths as study.toml states them.
    settings = dict(given)
    files: dict[str, Any] = {}
    for name in type(step).paths:
        value = given.get(name)
        if isinstance(value, str) and not _is_generic_body(name, value, root):
            files[name] = str(root.resolve() / filled(value, names))
        elif isinstance(value, tuple | list):
            files[name] = tuple(str(root.resolve() / filled(each, names)) for each in value)
    return StepTask(
        trial=trial.name, step=step.title, command=step.command, path=str(trial.path.resolve()),
        out=str(own / step.title), settings=settings, files=files, version=marey.__version__,
    )  # fmt: skip


def _is_generic_body(name: str, value: str, root: Path) -> bool:
    from marey.body.articulation.presets import GENERIC_BODIES

    return name == "body" and value in GENERIC_BODIES and not (root / value).exists()


def _collected(
    results: Path, trials: Sequence[StudyTrial], plans: Sequence[TrialPlan],
    outcomes: Mapping[tuple[str, str], StepOutcome], settings: StudySettings,
) -> Study:  # fmt: skip
    """Read the records of the steps, and make the tables of them."""
    tasks = {(task.trial, task.step): task for plan in plans for task in plan.tasks}
    records = {key: read_step_record(task.record) for key, task in tasks.items()}
    done = {
        key: record for key, record in records.items()
        if record is not None and record.state == "done" and outcomes[key].state in ("done", "reused")
    }  # fmt: skip
    by_name = {trial.name: trial for trial in trials}
    states = tuple(_trial_row(by_name[key[0]], outcomes[key], done.get(key)) for key in tasks)
    rows = study_rows(trials, done)
    return Study(
        folder=results, trials=states, rows=rows, subjects=subject_rows(rows),
        means=mean_rows(rows, reference=settings.reference), verdict=_verdict(states),
    )  # fmt: skip


def _trial_row(trial: StudyTrial, outcome: StepOutcome, record: StepRecord | None) -> TrialRow:
    common: dict[str, Any] = {
        "trial": trial.name, "subject": trial.subject, "condition": trial.condition, "step": outcome.step,
    }  # fmt: skip
    if record is None:
        state = outcome.state if outcome.state == NOT_BEGUN else "failed"
        return TrialRow(
            **common, state=state, verdict="", reason=outcome.message, report="", seconds=outcome.seconds,
            memory_mb=0.0, interruptions=outcome.interruptions,
        )  # fmt: skip
    report = f"{trial.name}/{outcome.step}/{record.report}" if record.report else ""
    reason = record.reasons[0] if record.reasons else record.message
    return TrialRow(
        **common, state="done", verdict=record.verdict, reason=reason, report=report, seconds=record.seconds,
        memory_mb=record.memory_mb, interruptions=record.interruptions,
    )  # fmt: skip


def _verdict(rows: Sequence[TrialRow]) -> Verdict:
    """Return the verdict on a study: which trials have no result, or one that is limited or not usable."""
    count = len({row.trial for row in rows})
    failed = _names(row for row in rows if row.state == "failed")
    unusable = [name for name in _names(row for row in rows if row.verdict == LEVELS[-1]) if name not in failed]
    limited = _names(row for row in rows if row.verdict == LEVELS[1])
    found = (
        (failed, "failed", "The page states why; the same command tries them again.", True),
        (unusable, "{have} results that are not usable", "Open their reports.", True),
        (limited, "{have} results that are usable with limits", "Open their reports.", False),
    )
    return Verdict.of(_reason(names, count, what, remedy, without) for names, what, remedy, without in found if names)


def _names(rows: Iterator[TrialRow]) -> list[str]:
    return list(dict.fromkeys(row.trial for row in rows))


def _reason(names: Sequence[str], count: int, what: str, remedy: str, without: bool) -> VerdictReason:
    grave = without and len(names) > MOST_WITHOUT_RESULT * count
    make = VerdictReason.failure if grave else VerdictReason.limit
    predicate = what.format(have="has" if len(names) == 1 else "have")
    return make(f"{len(names)} of {count_of(count, 'trial')} {predicate}: {listed(names, most=_SHOWN)}.", remedy)


def _usable_folders(results: Path, found: Study) -> dict[str, list[Path]]:
    folders: dict[str, list[Path]] = {}
    for row in found.trials:
        if row.state == "done" and row.verdict != LEVELS[-1]:
            folders.setdefault(row.trial, []).append(results / row.trial / row.step)
    return folders


def _save(
    found: Study, curves: Sequence[StudyCurve], root: Path, settings: StudySettings, progress: Progress
) -> None:
    """Write the tables, the page and the record, all together."""
    given = {"pattern": settings.pattern, "steps": [f"{step.title}: {step.given()}" for step in settings.steps]}
    with progress.stage("Results"), finished_together(found.folder, inputs=[root / STUDY_FILE]) as folder:
        write_table(folder / "study.csv", found.rows, StudyRow)
        write_parquet(folder / "study.parquet", found.rows)
        write_table(folder / "trials.csv", found.trials, TrialRow)
        write_table(folder / "subjects.csv", found.subjects, SubjectRow)
        write_table(folder / "means.csv", found.means, MeanRow)
        content = StudyContent(
            title=root.resolve().name, head=page_head("study", found.verdict), trials=found.trials, rows=found.rows,
            subjects=found.subjects, means=found.means, curves=curves, settings=given, timings=dict(progress.timings),
            reference=settings.reference,
        )  # fmt: skip
        write_study_report(folder / "study.html", content)
        write_record(
            folder, command="study", settings=given, inputs=[root / STUDY_FILE], root=root, progress=progress,
            verdict=found.verdict,
        )  # fmt: skip
