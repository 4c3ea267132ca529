"""`marey gait`: walks side by side, and beside reference walks."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.errors import SettingProblem
from marey.io.results.gait import write_gait_comparison_csv, write_profile_csv
from marey.motion.events.profile import WHOLE_SCORE, reference_bands
from marey.motion.events.summaries import GaitSummary
from marey.pipelines.gait.measured_walk import MeasuredWalk, read_references, read_walk
from marey.pipelines.gait.profile import GaitProfile, profile_from
from marey.pipelines.labelled import Described, Summary
from marey.pipelines.progress import Progress, RecordingProgress
from marey.pipelines.run_details import page_head
from marey.pipelines.run_record import finished_together, write_record
from marey.pipelines.verdict import Verdict, VerdictReason
from marey.view.gait.walks_page import ShownReferences, ShownWalk, write_walks_page
from marey.wording import count_of, listed

GAIT_RESULTS = ("report.html", "gait_parameters.csv")
"""Files that every run writes, whose names are checked before the work."""
_PROFILE_FILE = "gait_profile.csv"
"""The file with the distances from the reference walks."""
_SHOWN_NAMES = 6
"""Number of walks that a sentence names at most. Chosen by hand."""


class GaitComparison(Described):
    """Walks side by side, and their distances from reference walks.

    Args:
        walks: The walks, at least one.
        references: The reference walks; none without any.
        given: The folder with the reference walks, as the user gave it; None without any.
        progress: Progress reporter of the run.

    Example:
        >>> import marey
        >>> gait = marey.compare_gait(["walk01"], references="references")
        >>> gait.profiles["walk01"].score("knee flexion", "left").side
        'left'
    """

    def __init__(
        self, walks: Sequence[MeasuredWalk], references: Sequence[MeasuredWalk], given: Path | None, progress: Progress
    ):
        self._walks = dict(zip(_labels(walks), walks, strict=True))
        self._references, self._given, self._progress = tuple(references), given, progress
        known = {each.folder: each.angles for each in references}
        self._profiles = {
            label: profile_from(walk.folder, walk.angles, known) for label, walk in self._walks.items() if known
        }  # fmt: skip

    @property
    def walks(self) -> Mapping[str, MeasuredWalk]:
        """The walks by name: curves over the cycle, and spatio-temporal parameters."""
        return self._walks

    @property
    def references(self) -> tuple[MeasuredWalk, ...]:
        """The reference walks."""
        return self._references

    @property
    def profiles(self) -> Mapping[str, GaitProfile]:
        """The gait profile of each walk by its name; none without references."""
        return self._profiles

    @property
    def bands(self) -> Mapping[str, Floats]:
        """Mean and standard deviation (101, 2) of the reference walks, by the name of the quantity without side."""
        return reference_bands(walk.curves for walk in self._references)

    @property
    def usual(self) -> Mapping[str, tuple[float, float]]:
        """Mean and standard deviation of each parameter of both sides over the reference walks."""
        found: dict[str, list[float]] = {}
        for walk in self._references:
            for entry in walk.parameters:
                if entry.side == "both":
                    found.setdefault(entry.quantity, []).append(entry.value)
        return {
            name: (float(np.mean(values)), float(np.std(values, ddof=1)))
            for name, values in found.items() if len(values) > 1
        }  # fmt: skip

    @property
    def verdict(self) -> Verdict:
        """How far the comparison can be used, and what limits it."""
        return Verdict.of([*_weak_walks(self._walks), *_weak_references(self._references), *self._unlike_measured()])

    def _unlike_measured(self) -> Iterator[VerdictReason]:
        """Name walks that were measured by different commands."""
        commands = {walk.command for walk in (*self._walks.values(), *self._references) if walk.command}
        if len(commands) > 1:
            what = (
                f"The walks were measured in different ways ({listed(sorted(f'marey {each}' for each in commands))}), "
                "whose angles have different definitions: constant differences between them are not of the gait."
            )
            yield VerdictReason.limit(what, "Compare walks that were measured in the same way.", cause="measured apart")

    def save(self, folder: Path | str) -> Path:
        """Write report.html, gait_parameters.csv, gait_profile.csv and run.json, as `marey gait --out folder` does.

        Args:
            folder: Folder for the files; it is created if it does not exist.

        Returns:
            The folder.

        Raises:
            FileProblem: The folder cannot be written to.
        """
        out, progress = Path(folder), self._progress
        settings = {"walks": [str(walk.folder) for walk in self._walks.values()], "references": self._given}
        inputs = [path for walk in (*self._walks.values(), *self._references) for path in walk.files]
        with finished_together(out, inputs=inputs) as staging:
            parameters = {label: walk.parameters for label, walk in self._walks.items()}
            write_gait_comparison_csv(staging / GAIT_RESULTS[1], parameters, self.usual)
            if self._profiles:
                write_profile_csv(
                    staging / _PROFILE_FILE, {label: each.scores for label, each in self._profiles.items()}
                )
            write_walks_page(
                staging / GAIT_RESULTS[0], self._shown(), self._shown_references(), notes=progress.warnings,
                settings=settings, timings=progress.timings, head=page_head("gait", self.verdict),
            )  # fmt: skip
            write_record(
                staging, command="gait", settings=settings, inputs=inputs, root=Path.cwd(), progress=progress,
                verdict=self.verdict,
            )  # fmt: skip
        return out

    def _shown(self) -> list[ShownWalk]:
        return [
            ShownWalk(
                label=label, curves=walk.curves, marks=walk.marks, parameters=walk.parameters,
                scores=self._profiles[label].scores if self._profiles else (),
            )
            for label, walk in self._walks.items()
        ]  # fmt: skip

    def _shown_references(self) -> ShownReferences | None:
        if not self._references:
            return None
        return ShownReferences(count=len(self._references), bands=self.bands, parameters=self.usual)

    def summary(self) -> Summary:
        """Return the readable description."""
        lines = {}
        for label, walk in self._walks.items():
            texts = [count_of(max(walk.curves.counts), "cycle")]
            if self._profiles:
                score = self._profiles[label].score()
                texts.append(
                    f"{WHOLE_SCORE} {score.score_deg:.1f} deg (references: median {score.reference_deg:.1f}, largest "
                    f"{score.reference_worst_deg:.1f})"
                )
            lines[label] = ", ".join([*texts, *_speed(walk.parameters)])
        title = f"Gait of {count_of(len(self._walks), 'walk')}"
        if self._references:
            title += f" beside {count_of(len(self._references), 'reference walk')}"
        return Summary(title, lines)


def compare_gait(
    walks: Path | str | Sequence[Path | str], references: Path | str | None = None, *, progress: Progress | None = None
) -> GaitComparison:
    """Compare the gait cycles of walks with each other and with reference walks, as the command `marey gait` does.

    Args:
        walks: One or several folders with the results of `marey capture` or `marey markers` of a walk, or trials with
            results in `marey/`.
        references: Folder with the results of reference walks in folders of their own, at any depth; walks that are
            compared are not references. Needed for a single walk.
        progress: Progress reporter; by default nothing is shown.

    Returns:
        The walks, with the gait profile of each if there are references ([Baker2009]).

    Raises:
        FileProblem: A folder has no results of a walk, or there are fewer than two references.
        SettingProblem: There is nothing to compare with, or a walk and the references have no angle in common.

    Example:
        >>> import marey
        >>> marey.compare_gait("walk01", references="references")
        Gait of 1 walk beside 3 reference walks
          walk01  1 cycle, gait profile score ...
    """
    reporter = RecordingProgress() if progress is None else progress
    given = [walks] if isinstance(walks, Path | str) else list(walks)
    if not given or (len(given) == 1 and references is None):
        raise SettingProblem(
            "There is nothing to compare with. Give two walks or more, or a folder of reference walks (--references)."
        )
    with reporter.stage("Reading"):
        own = [read_walk(path) for path in given]
        folders = [walk.folder for walk in own]
        if len({folder.resolve() for folder in folders}) < len(folders):
            raise SettingProblem("The same walk is given twice. Give each walk once.")
        known = () if references is None else read_references(references, without=folders)
    return GaitComparison(own, known, None if references is None else Path(references), reporter)


def _labels(walks: Sequence[MeasuredWalk]) -> list[str]:
    """Name the walks by their folders, and those of equal names by the paths of these."""
    names = [walk.label for walk in walks]
    return [
        name if names.count(name) == 1 else str(walk.folder) for name, walk in zip(names, walks, strict=True)
    ]  # fmt: skip


def _weak_walks(walks: Mapping[str, MeasuredWalk]) -> Iterator[VerdictReason]:
    """Carry on what limits the walks."""
    for label, walk in walks.items():
        if walk.verdict is not None and walk.verdict.reasons:
            worst = walk.verdict.reasons[0]
            make = VerdictReason.limit if walk.verdict.usable else VerdictReason.failure
            yield make(f"The verdict on {label} is: {walk.verdict.level}. {worst.what}", worst.remedy)


def _weak_references(references: Iterable[MeasuredWalk]) -> Iterator[VerdictReason]:
    """Name reference walks that are not usable."""
    weak = [walk.label for walk in references if walk.verdict is not None and not walk.verdict.usable]
    if weak:
        what = f"Of the reference walks, not usable by their own verdict: {listed(weak, most=_SHOWN_NAMES)}."
        yield VerdictReason.limit(what, "Measure them again, or move them to another folder.", cause="references")


def _speed(parameters: Iterable[GaitSummary]) -> list[str]:
    return [
        f"{entry.value:.2f} {entry.unit}" for entry in parameters if (entry.quantity, entry.side) == ("speed", "both")
    ]
