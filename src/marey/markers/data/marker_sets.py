"""Marker sets of gait laboratories, recognised from the labels of a trial."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from marey.errors import SettingProblem
from marey.markers.data.marker_set_tables import MARKER_SETS, MarkerSet, plain_label
from marey.wording import listed

_LEAST_SHARE = 0.8
"""Share of a set's markers that a trial must have for the set to be recognised; chosen by hand."""
_SACRUM = ("LPSI", "RPSI")
"""The two markers that a single one on the sacrum, `SACR`, can replace."""


@dataclass(frozen=True, kw_only=True)
class RecognisedSet:
    """A marker set that a trial has, completely or for the most part."""

    marker_set: MarkerSet
    person: str
    """The prefix of the labels (`Ann` in `Ann:LASI`); empty if there is none."""
    missing: tuple[str, ...]
    """Labels of the set that the trial lacks."""

    @property
    def sentence(self) -> str:
        """Which set it is and what is missing, in one sentence."""
        whose = f" of {self.person}" if self.person else ""
        lacking = f"missing: {listed(self.missing)}" if self.missing else "none is missing"
        return f"The labels{whose} are those of the marker set {self.marker_set.name}; {lacking}."


def recognise_marker_sets(labels: Sequence[str]) -> tuple[RecognisedSet, ...]:
    """Recognise the marker set of each person in a trial.

    A set is recognised if most of its markers are there; of several, it is the one with the most markers in the trial.
    Upper and lower case, dots and underscores are not distinguished.

    Args:
        labels: Labels of the trial, with a prefix such as `Ann:` if there are several people.

    Returns:
        One entry for each person whose set is known, in the order of their first labels.
    """
    found = (_best_set(person, set(own)) for person, own in labels_by_person(labels).items())
    return tuple(one for one in found if one is not None)


def labels_by_person(labels: Sequence[str]) -> dict[str, dict[str, str]]:
    """Return for each prefix of the labels the plain names (`plain_label`), and the label of each.

    Args:
        labels: Labels of the trial; those without a prefix are under the empty text.
    """
    people: dict[str, dict[str, str]] = {}
    for label in labels:
        person, _, name = label.rpartition(":")
        people.setdefault(person, {}).setdefault(plain_label(name), label)
    return people


def choose_marker_set(key: str) -> MarkerSet:
    """Return the marker set of a short name.

    Args:
        key: One of the keys of `MARKER_SETS`, in any case.

    Raises:
        SettingProblem: There is no such set.
    """
    known = {one.key: one for one in MARKER_SETS}
    if key.lower() not in known:
        raise SettingProblem(f"marker_set (--marker-set) is '{key}'; it should be one of {', '.join(known)}.")
    return known[key.lower()]


def given_marker_set(known: MarkerSet, labels: Sequence[str]) -> RecognisedSet:
    """Return a set that the user names, for the person with the most of its markers.

    Args:
        known: The set.
        labels: Labels of the trial.
    """
    people = labels_by_person(labels) or {"": {}}
    fits = [RecognisedSet(marker_set=known, person=person, missing=missing_labels(known, own))
            for person, own in people.items()]  # fmt: skip
    return min(fits, key=lambda one: len(one.missing))


def missing_labels(known: MarkerSet, names: Mapping[str, str] | set[str]) -> tuple[str, ...]:
    """List the labels of a set that are not among some names.

    Args:
        known: The set.
        names: Plain names (`plain_label`).
    """
    there = {*names, *_SACRUM} if "SACR" in names else {*names}
    return tuple(label for label in known.labels if plain_label(label) not in there)


def _best_set(person: str, names: set[str]) -> RecognisedSet | None:
    """Return the recognised set with the most markers among the names."""
    candidates = []
    for known in MARKER_SETS:
        missing = missing_labels(known, names)
        if len(known.labels) - len(missing) >= _LEAST_SHARE * len(known.labels):
            candidates.append(RecognisedSet(marker_set=known, person=person, missing=missing))
    return max(candidates, key=lambda one: len(one.marker_set.labels) - len(one.missing), default=None)
