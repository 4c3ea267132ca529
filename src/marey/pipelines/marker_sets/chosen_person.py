"""The markers of one person out of a file with the markers of several."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from marey.errors import FileProblem
from marey.io.markers.trial_file import MarkerFile, read_marker_file
from marey.markers.data.given_angles import GivenAngles
from marey.markers.data.people import UNNAMED, people_of, wearers
from marey.markers.data.person import PersonMeasurements
from marey.markers.data.trajectories import MarkerTrajectories
from marey.wording import listed


def read_file_of(path: Path, person: str | None, *, unit: str | None = None, required: bool = True) -> MarkerFile:
    """Read a file that belongs to a trial, and keep the markers of one person; see `file_of`.

    A file whose labels have no names is that of the person.

    Args:
        path: A C3D, TRC or CSV.
        person: Name of the person; None if nobody is chosen.
        unit: mm, cm or m, if the file states it wrongly or not at all.
        required: Whether one person must be chosen if there are several.

    Raises:
        FileProblem: The file cannot be read, the person is not there, or there are several and nobody is chosen.
    """
    file = read_marker_file(path, unit=unit)
    nameless = not file.trajectories.people and not people_of(file.trajectories.labels, file.subjects)
    return file_of(file, None if nameless else person, required=required)


def read_markers_of(path: Path, *, person: str | None, unit: str | None = None) -> MarkerTrajectories:
    """Read the markers of one person from a file; of several people all, if nobody is chosen.

    Args:
        path: A C3D, TRC or CSV.
        person: Name of the person; None if nobody is chosen.
        unit: mm, cm or m, if the file states it wrongly or not at all.

    Raises:
        FileProblem: The file cannot be read, or the person is not there.
    """
    return read_file_of(path, person, unit=unit, required=False).trajectories


def file_of(file: MarkerFile, person: str | None, *, required: bool = True) -> MarkerFile:
    """Keep the markers, events and angles of one person, under labels without the name.

    Without a choice it is the only person, or the only one who wears a known marker set.

    Args:
        file: The content of a file.
        person: Name of the person, in any case; None if nobody is chosen.
        required: Whether one person must be chosen if there are several; otherwise all labels keep their names.

    Returns:
        The file, unchanged if no label has a name.

    Raises:
        FileProblem: The person is not there, or there are several and nobody is chosen.
    """
    people = people_of(file.trajectories.labels, file.subjects)
    if person is not None:
        return _chosen(file, people, person)
    if not people or not required:
        return file
    candidates = tuple(people) if len(people) == 1 else wearers(people)
    if len(candidates) == 1:
        return _only(file, people, candidates[0])
    wrong = f"has the markers of several people ({listed(people)})"
    raise FileProblem(file.path, wrong, f"Choose one of them with person (--person {next(iter(people))}).")


def _chosen(file: MarkerFile, people: Mapping[str, Mapping[str, str]], person: str) -> MarkerFile:
    """Keep the markers of a person who was named.

    Raises:
        FileProblem: The person is not there.
    """
    found = next((name for name in people if name.casefold() == person.casefold()), None)
    if found is not None:
        return _only(file, people, found)
    removed = [name for own in file.trajectories.people for name in (own, file.subjects.get(f"{own}:", own))]
    if not people and person.casefold() in [name.casefold() for name in removed]:
        return file
    names = listed(people or removed, none="")
    wrong = f"has no markers of {person}"
    remedy = "Leave out person (--person): the labels have no names of people before them."
    raise FileProblem(file.path, wrong, f"Choose one of {names} with person (--person)." if names else remedy)


def _only(file: MarkerFile, people: Mapping[str, Mapping[str, str]], name: str) -> MarkerFile:
    """Keep the markers, events and angles of one of the people."""
    own = people[name]
    trial = file.trajectories.select(list(own.values()))
    note = _note(file.trajectories, people, name)
    trial = replace(trial, labels=tuple(own), notes=(*trial.notes, note))
    measurements, person_notes = file.person, file.person_notes
    if len(people) > 1 and measurements != PersonMeasurements():
        measurements = PersonMeasurements()
        person_notes = ("The measurements of a person in the file are ignored: it does not state whose they are.",)
    events = file.events_of.get(name, ()) if len(people) > 1 else file.events
    return replace(
        file, trajectories=trial, events=events, angles=_angles_of(file, people, name), person=measurements,
        person_notes=person_notes, renamed=dict(own), name=name,
    )  # fmt: skip


def _note(trial: MarkerTrajectories, people: Mapping[str, Mapping[str, str]], name: str) -> str:
    """State whose markers are used, and what is ignored."""
    others = [other for other in people if other != name]
    left = len(trial.labels) - len(people[name])
    if not left:
        return f"The markers are those of {name}."
    whose = f", among them those of {listed(others)}" if others else ""
    return f"The markers of {name} are used; {left} others are ignored{whose}."


def _angles_of(file: MarkerFile, people: Mapping[str, Mapping[str, str]], name: str) -> GivenAngles | None:
    """Keep the angles of one of the people that another program wrote into the file."""
    if file.angles is None:
        return None
    prefix = "" if name == UNNAMED else _prefix(people[name])
    others = [_prefix(own) for other, own in people.items() if other not in (name, UNNAMED)]
    kept = [
        a for a, label in enumerate(file.angles.labels) if label.startswith(prefix) and _of_nobody_else(label, others)
    ]
    if not kept:
        return None
    labels = tuple(file.angles.labels[a].removeprefix(prefix) for a in kept)
    return GivenAngles(labels=labels, values=np.asarray(file.angles.values[:, kept]))


def _prefix(own: Mapping[str, str]) -> str:
    """Return what is before the labels of a person in the file."""
    label, full = next(iter(own.items()))
    return full.removesuffix(label)


def _of_nobody_else(label: str, prefixes: Sequence[str]) -> bool:
    return not any(label.startswith(prefix) for prefix in prefixes)
