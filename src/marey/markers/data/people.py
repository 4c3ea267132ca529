"""Whose markers are in a trial: people and their labels, by the names before the labels."""

from collections.abc import Mapping, Sequence

from marey.markers.data.marker_sets import recognise_marker_sets

UNNAMED = "unnamed"
"""Name by which the person is chosen whose labels have no name before them; the markers of others do."""
_SEPARATOR = ":"
"""Character between the name of a person and a label, as Vicon's programs write it."""
_UNLABELLED = "*"
"""First character of the names of trajectories without a label."""
_JOINT = "_"
"""Character between them in other programs, where it is also a part of labels."""


def people_of(labels: Sequence[str], subjects: Mapping[str, str] | None = None) -> dict[str, dict[str, str]]:
    """Return the people of a trial, each with the labels without the name.

    A name is before a colon (`Ann:LASI`), or is a prefix that the file states, or is before an underscore (`Ann_LASI`)
    if the rest of the labels are those of a known marker set. Things may have names as well. Labels without a name
    belong to a person if they are those of a known set, and to nobody otherwise, as trajectories without a label do
    (`*110`).

    Args:
        labels: Labels of the trial.
        subjects: Maps prefixes that the file states (`A_`) to names of people.

    Returns:
        For each person, in the order of the first labels, the labels without the name, and the label of each in the
        trial. Nobody if no label has a name.
    """
    groups: dict[str, dict[str, str]] = {}
    for label in labels:
        name, short = _split(label, subjects or {})
        groups.setdefault(name, {}).setdefault(short, label)
    unnamed = groups.pop("", {})
    for name, own in _joined(list(unnamed)).items():
        groups.setdefault(name, {}).update(own)
    named = {label for own in groups.values() for label in own.values()}
    rest = [label for label in unnamed if label not in named and not label.startswith(_UNLABELLED)]
    if groups and recognise_marker_sets(rest):
        groups.setdefault(UNNAMED, {}).update({label: label for label in rest})
    return groups


def wearers(people: Mapping[str, Mapping[str, str]]) -> tuple[str, ...]:
    """Return the people who wear a known marker set.

    Args:
        people: The people and their labels, from `people_of`.
    """
    return tuple(name for name, own in people.items() if recognise_marker_sets(list(own)))


def _split(label: str, subjects: Mapping[str, str]) -> tuple[str, str]:
    """Return the name before a label, and the rest of it."""
    for prefix in sorted(subjects, key=len, reverse=True):
        if label.startswith(prefix) and len(label) > len(prefix):
            return subjects[prefix], label.removeprefix(prefix)
    name, _, own = label.rpartition(_SEPARATOR)
    return (name.strip(), own.strip()) if own.strip() else ("", label)


def _joined(labels: Sequence[str]) -> dict[str, dict[str, str]]:
    """Return the people whose names are joined to the labels of a known marker set by an underscore."""
    if recognise_marker_sets(labels):
        return {}
    groups: dict[str, dict[str, str]] = {}
    for label in labels:
        for at in (n for n, letter in enumerate(label) if letter == _JOINT and 0 < n < len(label) - 1):
            groups.setdefault(label[:at], {}).setdefault(label[at + 1 :], label)
    return {name: own for name, own in groups.items() if recognise_marker_sets(list(own))}
