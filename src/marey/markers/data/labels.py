"""Clusters found from the markers' labels: thigh_01, thigh_02 and thigh_03 ride on the thigh."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

from marey.errors import MareyError
from marey.markers.data.clusters import Cluster

NEEDED = 3
"""Markers that fix the pose of a segment."""
_NUMBERED = re.compile(r"(?P<name>[^*]*?[^*\d])[ ._-]*\d+")


@dataclass(frozen=True, eq=False, kw_only=True)
class FoundClusters:
    """The clusters of a trial, and what became of the other labels."""

    clusters: tuple[Cluster, ...]
    """In the order in which their first markers come."""
    passed_over: tuple[str, ...]
    """Labels that ride on no segment."""
    notes: tuple[str, ...]
    """What was passed over, a plain sentence each."""


def segment_of(label: str) -> str | None:
    """Give the segment that a label names: the label without the number at its end (`thigh_01`: `thigh`).

    No side is added. A label without a number, or an unlabelled trajectory (`*110`), names none.
    """
    found = _NUMBERED.fullmatch(label.strip())
    return found["name"] if found else None


def find_clusters(labels: Sequence[str]) -> FoundClusters:
    """Group markers into clusters by their labels.

    Args:
        labels: Of the trial. A name that fewer than three of them share makes no cluster.
    """
    groups: dict[str, list[str]] = {}
    for label in labels:
        if (name := segment_of(label)) is not None:
            groups.setdefault(name, []).append(label)
    full = {name: group for name, group in groups.items() if len(group) >= NEEDED}
    inside = {label for group in full.values() for label in group}
    notes = [
        f"{', '.join(group)} would be the segment {name}, but a segment needs {NEEDED} markers; passed over."
        for name, group in groups.items()
        if len(group) < NEEDED
    ]
    others = [label for label in labels if segment_of(label) is None]
    if others:
        notes.append(f"Labels that name no segment, passed over: {', '.join(others)}.")
    return FoundClusters(
        clusters=tuple(Cluster(segment=name, labels=tuple(group)) for name, group in full.items()),
        passed_over=tuple(label for label in labels if label not in inside),
        notes=tuple(notes),
    )


def clusters_named(segments: Mapping[str, Sequence[str]], labels: Sequence[str]) -> FoundClusters:
    """Group markers into the clusters that the user names.

    Args:
        segments: Segment to labels. A label may be a pattern with `*` and `?`, where no marker is called exactly so.
        labels: Of the trial.

    Raises:
        MareyError: A segment has fewer than three markers in the trial, or a marker rides on two segments.
    """
    owner: dict[str, str] = {}
    clusters, notes, faults = [], [], []
    for segment, wanted in segments.items():
        found = list(dict.fromkeys(label for pattern in wanted for label in _matching(pattern, labels)))
        missing = [pattern for pattern in wanted if not _matching(pattern, labels)]
        if len(found) < NEEDED:
            lacking = f" (missing: {', '.join(missing)})" if missing else ""
            faults.append(f"The segment {segment} has {len(found)} markers in the trial{lacking}; it needs {NEEDED}.")
        elif missing:
            notes.append(f"The segment {segment} goes without {', '.join(missing)}, which the trial does not have.")
        faults += [f"The marker {x} rides on both {owner[x]} and {segment}." for x in found if x in owner]
        owner |= dict.fromkeys(found, segment)
        clusters.append(Cluster(segment=segment, labels=tuple(found)))
    if faults:
        raise MareyError(" ".join(faults) + f" The trial has: {', '.join(labels)}.")
    others = tuple(label for label in labels if label not in owner)
    if others:
        notes.append(f"Labels that no segment names, passed over: {', '.join(others)}.")
    return FoundClusters(clusters=tuple(clusters), passed_over=others, notes=tuple(notes))


def _matching(pattern: str, labels: Sequence[str]) -> list[str]:
    if pattern in labels:
        return [pattern]
    return [label for label in labels if fnmatchcase(label, pattern)]
