"""Marker sets of gait laboratories, recognised from the labels of a trial."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from marey.errors import SettingProblem
from marey.markers.data.clusters import MINIMUM_MARKERS
from marey.markers.data.marker_set_tables import MARKER_SETS, SIDE_LETTERS, LabelChoices, MarkerSet, plain_label
from marey.wording import listed

_LEAST_SHARE = 0.8
"""Share of a set's markers that a trial must have for the set to be recognised; chosen by hand."""
_SACRUM = ("LPSI", "RPSI")
"""The two markers that a single one on the sacrum, `SACR`, can replace."""
_PELVIS, _FOOT = ("RASIS", "LASIS", "RPSIS", "LPSIS"), ("CA", "TOE", "M1", "M5")
"""Landmarks of the pelvis and of a foot, whose markers also follow these segments."""
_WORDS = {
    "pelvis": ("PELVIS", "PELV", "PEL", "PV", "SACRUM", "SAC"), "thigh": ("THIGH", "THI", "TH", "FEMUR", "FEM"),
    "shank": ("SHANK", "SHA", "SH", "SK", "TIBIA", "TIB", "LEG"), "foot": ("FOOT", "FT"),
}  # fmt: skip
"""Words for the segment in labels of numbered markers of clusters (`R_TH1`, `left_shank_02`); chosen by hand."""
_NUMBERED = re.compile(
    r"(?P<before>LEFT|RIGHT|L|R)?(?P<word>{words})(?P<after>LEFT|RIGHT|L|R)?(?P<number>\d+)".format(
        words="|".join(word for words in _WORDS.values() for word in words)
    )
)
"""A plain label of a marker of a cluster, with the side before or after the word."""
_FURTHER = {
    "LE": ("LK", "LKNEE", "KNEELAT", "LEP", "LFE", "LFC"), "ME": ("MK", "MKNEE", "KNEEMED", "MEP", "MFE", "MFC"),
    "LM": ("LA", "LANKLE", "ANKLELAT", "LMAL", "LM"), "MM": ("MA", "MANKLE", "ANKLEMED", "MMAL", "MM"),
    "CA": ("HEEL", "CAL"), "M1": ("MT1", "1MT"), "M5": ("MT5", "5MT"),
}  # fmt: skip
"""Labels of landmarks after the letter of the side, besides those of the marker sets; chosen by hand."""


@dataclass(frozen=True, kw_only=True)
class RecognisedSet:
    """A marker set that a trial has, completely or for the most part."""

    marker_set: MarkerSet
    person: str
    """The prefix of the labels (`Ann` in `Ann:LASI`); empty if there is none."""
    missing: tuple[str, ...]
    """Labels of the set that the trial lacks."""
    notes: tuple[str, ...] = ()
    """How the set was recognised, beyond its labels, one sentence each."""

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


def with_landmark_labels(known: MarkerSet, names: Sequence[str]) -> MarkerSet:
    """Return a set in which some landmarks are also points of their own names, which come first.

    Args:
        known: The set.
        names: Landmarks, such as `left_LE`.
    """
    own = {name: ((name,), *known.landmarks.get(name, ())) for name in names}
    return replace(known, landmarks={**known.landmarks, **own})


def cluster_marker_set(labels: Sequence[str], static_labels: Sequence[str]) -> RecognisedSet | None:
    """Return a set of numbered clusters on segments, with landmarks that markers of a static trial show.

    The clusters are the numbered labels with the word of a segment and a side, such as `R_TH1` to `R_TH4`, three or
    more on each; a cluster on the pelvis has no side. The landmarks have the labels of any known set, or similar ones,
    or their own names (`left_LE`). Pelvis and feet without a cluster are followed by the markers on their landmarks.

    Args:
        labels: Labels of the trial, without names of people.
        static_labels: Labels of the static trial.

    Returns:
        The set; None without a cluster on a thigh or shank, or if the static trial lacks the pelvis, or the knee and
        ankle of each leg with clusters.
    """
    clusters = _clusters(labels)
    shown = {plain_label(label) for label in static_labels}
    landmarks = {name: _shown_first(choices, shown) for name, choices in _all_landmarks().items()}
    known = {name for name, choices in landmarks.items() if _is_shown(choices[0], shown)}
    legs = [side for side, _ in SIDE_LETTERS if {f"{side}_thigh", f"{side}_shank"} & set(clusters)]
    legs = [side for side in legs if {f"{side}_LE", f"{side}_LM"} <= known]
    if not legs or not set(_PELVIS) <= known:
        return None
    segments = _marked_segments(landmarks, legs, labels)
    segments |= {name: own for name, own in clusters.items() if name == "pelvis" or name.startswith(tuple(legs))}
    made = MarkerSet(
        key="clusters", name="CAST, numbered clusters", landmarks=landmarks, segments=segments,
        labels=tuple(dict.fromkeys(label for own in segments.values() for label in own)),
        planes={joint: label for one in MARKER_SETS for joint, label in one.planes.items()},
    )  # fmt: skip
    marked = (f"{name} {' and '.join(landmarks[name][0])}" for name in landmarks if name in known)
    notes = (f"Labels of the landmarks: {listed(marked)}.",)
    return RecognisedSet(marker_set=made, person="", missing=(), notes=notes)


def _marked_segments(
    landmarks: Mapping[str, LabelChoices], legs: Sequence[str], labels: Sequence[str]
) -> dict[str, tuple[str, ...]]:
    """Return pelvis and feet with the labels of the markers on their landmarks that a trial has."""
    worn = {plain_label(label) for label in labels}
    parts = {"pelvis": _PELVIS, **{f"{side}_foot": tuple(f"{side}_{name}" for name in _FOOT) for side in legs}}
    return {
        segment: tuple(
            dict.fromkeys(label for name in names for label in landmarks[name][0] if plain_label(label) in worn)
        )
        for segment, names in parts.items()
    }


def _clusters(labels: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Return the segments with three or more numbered labels."""
    found: dict[str, list[str]] = {}
    for label in labels:
        match = _NUMBERED.fullmatch(plain_label(label))
        if match is None or (match["before"] and match["after"]):
            continue
        segment = next(name for name, words in _WORDS.items() if match["word"] in words)
        letter = (match["before"] or match["after"] or "")[:1]
        side = {own: name for name, own in SIDE_LETTERS}.get(letter, "")
        if bool(side) == (segment != "pelvis"):
            found.setdefault(f"{side}_{segment}".lstrip("_"), []).append(label)
    return {name: tuple(own) for name, own in found.items() if len(own) >= MINIMUM_MARKERS}


def _all_landmarks() -> dict[str, LabelChoices]:
    """Return the landmarks with their labels in all known sets, and further labels."""
    choices: dict[str, dict[tuple[str, ...], None]] = {}
    for known in MARKER_SETS:
        for name, own in known.landmarks.items():
            choices.setdefault(name, {}).update(dict.fromkeys(own))
    for side, letter in SIDE_LETTERS:
        for name, labels in _FURTHER.items():
            choices[f"{side}_{name}"].update(dict.fromkeys((f"{letter}{label}",) for label in labels))
    return {name: (*own, (name,)) for name, own in choices.items()}


def _shown_first(choices: LabelChoices, shown: set[str]) -> LabelChoices:
    """Put the first alternative whose markers are shown before the others."""
    return tuple(sorted(choices, key=lambda labels: not _is_shown(labels, shown)))


def _is_shown(labels: tuple[str, ...], shown: set[str]) -> bool:
    return all(plain_label(label) in shown for label in labels)
