"""Clusters derived from marker labels: thigh_01, thigh_02 and thigh_03 belong to the thigh."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

from marey.errors import MareyError
from marey.markers.data.clusters import MINIMUM_MARKERS, Cluster
from marey.wording import listed

_NUMBERED = re.compile(r"(?P<name>[^*]*?[^*\d])[ ._-]*\d+")
"""A label that ends in a number; `name` is the label without separator and number. Unlabelled trajectories start with
an asterisk and do not match."""

MOST_LABELS = 12
"""Number of labels that a message lists; more would hide the rest of the message. Chosen by hand."""


@dataclass(frozen=True, eq=False, kw_only=True)
class FoundClusters:
    """The clusters of a trial, and the labels that belong to none."""

    clusters: tuple[Cluster, ...]
    """In the order of their first markers."""
    skipped: tuple[str, ...]
    """Labels that belong to no segment."""
    notes: tuple[str, ...]
    """What was skipped and why, one sentence each."""


def segment_from_label(label: str) -> str | None:
    """Return the segment that a label names: the label without its trailing number (`thigh_01`: `thigh`).

    No side is added. The result is None for a label without a number and for an unlabelled trajectory (`*110`).
    """
    found = _NUMBERED.fullmatch(label.strip())
    return found["name"] if found else None


def find_clusters(labels: Sequence[str]) -> FoundClusters:
    """Group markers into clusters by their labels.

    Args:
        labels: Labels of the trial. A name shared by fewer than three of them makes no cluster.
    """
    groups: dict[str, list[str]] = {}
    for label in labels:
        if (name := segment_from_label(label)) is not None:
            groups.setdefault(name, []).append(label)
    full = {name: group for name, group in groups.items() if len(group) >= MINIMUM_MARKERS}
    inside = {label for group in full.values() for label in group}
    few = [label for group in groups.values() if len(group) < MINIMUM_MARKERS for label in group]
    notes = []
    if few:
        which = listed(few, most=MOST_LABELS)
        rule = f"A segment needs at least {MINIMUM_MARKERS} markers"
        notes.append(f"{rule}; labels of smaller groups are ignored: {which}.")
    others = [label for label in labels if segment_from_label(label) is None]
    if others:
        notes.append(f"Labels that name no segment are ignored: {listed(others, most=MOST_LABELS)}.")
    return FoundClusters(
        clusters=tuple(Cluster(segment=name, labels=tuple(group)) for name, group in full.items()),
        skipped=tuple(label for label in labels if label not in inside),
        notes=tuple(notes),
    )


def clusters_from_names(segments: Mapping[str, Sequence[str]], labels: Sequence[str]) -> FoundClusters:
    """Group markers into the clusters that the user specifies.

    Args:
        segments: Maps each segment to labels. A label that is not the exact name of a marker may be a pattern with `*`
            and `?`.
        labels: Labels of the trial.

    Raises:
        MareyError: A segment has fewer than three markers in the trial, or a marker belongs to two segments.
    """
    owner: dict[str, str] = {}
    clusters, notes, faults = [], [], []
    for segment, wanted in segments.items():
        found = list(dict.fromkeys(label for pattern in wanted for label in _matching(pattern, labels)))
        missing = [pattern for pattern in wanted if not _matching(pattern, labels)]
        if len(found) < MINIMUM_MARKERS:
            lacking = f" (missing: {', '.join(missing)})" if missing else ""
            faults.append(
                f"The segment {segment} has {len(found)} markers in the trial{lacking}; it needs {MINIMUM_MARKERS}."
            )
        elif missing:
            notes.append(f"The segment {segment} is used without {', '.join(missing)}: missing from the trial.")
        faults += [f"The marker {x} belongs to both {owner[x]} and {segment}." for x in found if x in owner]
        owner |= dict.fromkeys(found, segment)
        clusters.append(Cluster(segment=segment, labels=tuple(found)))
    if faults:
        raise MareyError(" ".join(faults) + f" The trial has: {', '.join(labels)}.")
    others = tuple(label for label in labels if label not in owner)
    if others:
        notes.append(f"Labels assigned to no segment are ignored: {listed(others, most=MOST_LABELS)}.")
    return FoundClusters(clusters=tuple(clusters), skipped=others, notes=tuple(notes))


def _matching(pattern: str, labels: Sequence[str]) -> list[str]:
    if pattern in labels:
        return [pattern]
    return [label for label in labels if fnmatchcase(label, pattern)]
