"""The rows of a study's table, and their means over subjects and differences between conditions."""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from marey.arrays import Floats
from marey.io.study.records import StepRecord
from marey.io.study.tables import NO_INTERVAL, OUTLIER, MeanRow, StudyRow, SubjectRow
from marey.io.study.trials import StudyTrial
from marey.motion.groups.outliers import find_outliers
from marey.motion.groups.weighted_means import GroupMean, difference_of_means, group_mean
from marey.pipelines.study.quantities import NORMAL_95

MEAN, PAIRED, UNPAIRED = "mean", "paired difference", "unpaired difference"
"""Kinds of rows of `means.csv`."""
_FEWEST_PAIRS = 2
"""Number of subjects with both conditions from which on their own differences are averaged."""
Quantity = tuple[str, str, str, str]
"""Step, quantity, side and unit."""


def study_rows(
    trials: Sequence[StudyTrial], records: Mapping[tuple[str, str], StepRecord]
) -> tuple[StudyRow, ...]:
    """Return all rows of the table, with their flags.

    Args:
        trials: The trials.
        records: The records of the steps that are done, by trial and step.

    Returns:
        One row per trial, step, quantity and side.
    """
    by_name = {trial.name: trial for trial in trials}
    rows = [
        StudyRow(
            trial=name, subject=by_name[name].subject, condition=by_name[name].condition, step=step,
            quantity=value.quantity, side=value.side, unit=value.unit, value=value.value, low95=value.low,
            high95=value.high, cycles=value.count, flags=_flags(record, value.low, value.high),
        )
        for (name, step), record in records.items() for value in record.values
    ]  # fmt: skip
    far = set()
    for same in _groups(rows).values():
        for group in _by(same, "condition").values():
            marked = find_outliers(_values(group), _sds(group))
            far |= {id(row) for row, is_far in zip(group, marked, strict=True) if is_far}
    return tuple(replace(row, flags=_joined(OUTLIER, row.flags)) if id(row) in far else row for row in rows)


def _flags(record: StepRecord, low: float, high: float) -> str:
    found = [record.verdict] if record.verdict not in ("", "good") else []
    return _joined(*found, *([] if np.isfinite([low, high]).all() else [NO_INTERVAL]))


def _joined(*flags: str) -> str:
    return "; ".join(flag for flag in flags if flag)


def mean_rows(rows: Sequence[StudyRow], *, reference: str | None = None) -> tuple[MeanRow, ...]:
    """Average each quantity over the subjects of each condition, and compare the conditions.

    The trials of a subject are averaged first, then the subjects, both with weights by the intervals and the variance
    between them. Results that are not usable are left out.

    Args:
        rows: The table.
        reference: The condition that is subtracted from the others; by default, the first of two conditions. Three or
            more conditions without a reference are not compared.

    Returns:
        The means, and behind those of each quantity the differences.
    """
    found: list[MeanRow] = []
    for quantity, group in _groups(_usable(rows)).items():
        conditions = {name: subject_means(each) for name, each in sorted(_by(group, "condition").items())}
        counts = {name: len(each) for name, each in _by(group, "condition").items()}
        means = {name: _over_subjects(each) for name, each in conditions.items()}
        found += [_row(quantity, name, "", MEAN, mean, counts[name]) for name, mean in means.items()]
        base = reference if reference is not None else min(conditions) if len(conditions) == 2 else None
        for name in conditions if base in conditions else ():
            if base is not None and name != base:
                kind, mean = _compared(conditions[name], conditions[base])
                found.append(_row(quantity, name, base, kind, mean, counts[name] + counts[base]))
    return tuple(found)


def subject_rows(rows: Sequence[StudyRow]) -> tuple[SubjectRow, ...]:
    """Average each quantity over the trials of each subject and condition; results that are not usable are left out.

    Args:
        rows: The table.
    """
    return tuple(
        SubjectRow(
            step=quantity[0], quantity=quantity[1], side=quantity[2], unit=quantity[3], condition=condition,
            subject=subject, trials=mean.count, mean=mean.value, standard_error=mean.standard_error, low95=mean.low,
            high95=mean.high,
        )
        for quantity, group in _groups(_usable(rows)).items()
        for condition, own in sorted(_by(group, "condition").items())
        for subject, mean in subject_means(own).items()
    )  # fmt: skip


def _usable(rows: Iterable[StudyRow]) -> Iterator[StudyRow]:
    return (row for row in rows if "not usable" not in row.flags)


def subject_means(rows: Iterable[StudyRow]) -> dict[str, GroupMean]:
    """Average the trials of each subject.

    Args:
        rows: Rows of one quantity, side and condition.

    Returns:
        The means by subject.
    """
    return {subject: group_mean(_values(own), _sds(own)) for subject, own in sorted(_by(rows, "subject").items())}


def _compared(first: Mapping[str, GroupMean], second: Mapping[str, GroupMean]) -> tuple[str, GroupMean]:
    """Return the kind of the difference of two conditions, and the difference."""
    both = [subject for subject in first if subject in second]
    if len(both) >= _FEWEST_PAIRS:
        values = np.array([first[name].value - second[name].value for name in both])
        errors = [np.hypot(first[name].standard_error, second[name].standard_error) for name in both]
        return PAIRED, group_mean(values, np.array(errors))
    return UNPAIRED, difference_of_means(_over_subjects(first), _over_subjects(second))


def _over_subjects(means: Mapping[str, GroupMean]) -> GroupMean:
    each = list(means.values())
    return group_mean(np.array([mean.value for mean in each]), np.array([mean.standard_error for mean in each]))


def _row(quantity: Quantity, condition: str, minus: str, kind: str, mean: GroupMean, trials: int) -> MeanRow:
    return MeanRow(
        step=quantity[0], quantity=quantity[1], side=quantity[2], unit=quantity[3], condition=condition, minus=minus,
        kind=kind, subjects=mean.count, trials=trials, mean=mean.value, low95=mean.low, high95=mean.high,
        between_subjects_sd=mean.between_sd, weighted=mean.weighted,
    )  # fmt: skip


def _groups(rows: Iterable[StudyRow]) -> dict[Quantity, list[StudyRow]]:
    """Return the rows of each quantity and side of a step, in the order in which they first appear."""
    found: dict[Quantity, list[StudyRow]] = defaultdict(list)
    for row in rows:
        found[row.step, row.quantity, row.side, row.unit].append(row)
    return found


def _by(rows: Iterable[StudyRow], name: str) -> dict[str, list[StudyRow]]:
    found: dict[str, list[StudyRow]] = defaultdict(list)
    for row in rows:
        found[getattr(row, name)].append(row)
    return found


def _values(rows: Iterable[StudyRow]) -> Floats:
    return np.array([row.value for row in rows], float)


def _sds(rows: Iterable[StudyRow]) -> Floats:
    return np.array([(row.high95 - row.low95) / (2 * NORMAL_95) for row in rows], float)
