"""Curves over the gait cycle of a study: means over subjects, with the spread between them."""

from collections import defaultdict
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.io.results.gait import read_cycle_csv
from marey.io.study.trials import StudyTrial
from marey.motion.events.curves import CYCLE_POINTS
from marey.view.study.study_report import StudyCurve

_FILE = "cycles.csv"
"""The table with the curves of a trial."""


def study_curves(trials: Iterable[StudyTrial], folders: Mapping[str, Iterable[Path]]) -> tuple[StudyCurve, ...]:
    """Average the curves over the cycle: first over the trials of a subject, then over the subjects of a condition.

    Args:
        trials: The trials.
        folders: The folders with usable results of each trial, by its name.

    Returns:
        One curve per quantity and condition.

    Raises:
        FileProblem: A table is damaged.
    """
    found: dict[tuple[str, str], dict[str, list[Floats]]] = defaultdict(lambda: defaultdict(list))
    for trial in trials:
        for folder in folders.get(trial.name, ()):
            if (folder / _FILE).is_file():
                for name, values in read_cycle_csv(folder / _FILE).items():
                    found[name, trial.condition][trial.subject].append(values)
    return tuple(_curve(*key, subjects) for key, subjects in sorted(found.items()))


def _curve(name: str, condition: str, subjects: Mapping[str, list[Floats]]) -> StudyCurve:
    means = np.array([np.mean(each, 0) for each in subjects.values()])
    complete = np.isfinite(means).all(1)
    means = means[complete] if complete.any() else np.full((1, CYCLE_POINTS), np.nan)
    spread = means.std(0, ddof=1) if len(means) > 1 else np.full(means.shape[1], np.nan)
    return StudyCurve(
        name=name, condition=condition, mean=means.mean(0), between_sd=spread, subjects=int(complete.sum())
    )
