"""Marker sets of gait laboratories, recognised from the labels of a trial."""

from collections.abc import Sequence
from dataclasses import dataclass

from marey.wording import listed

_LEAST_SHARE = 0.8
"""Share of a set's markers that a trial must have for the set to be recognised; chosen by hand."""
_SACRUM = ("LPSI", "RPSI")
"""The two markers that a single one on the sacrum, `SACR`, can replace."""


@dataclass(frozen=True, kw_only=True)
class MarkerSet:
    """A set of markers with agreed labels."""

    name: str
    labels: tuple[str, ...]
    """Markers that the model of the set follows in motion; medial markers, which a static trial adds, are left out."""


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


def _both(*names: str) -> tuple[str, ...]:
    """Return labels with the letters of the two sides."""
    return tuple(f"{side}{name}" for side in "LR" for name in names)


_LOWER = _both("ASI", "PSI", "THI", "KNE", "TIB", "ANK", "HEE", "TOE")
"""Labels of pelvis and legs in Plug-in Gait."""
_UPPER = ("C7", "T10", "CLAV", "STRN", *_both("FHD", "BHD", "SHO", "ELB", "WRA", "WRB", "FIN"))
"""Labels of head, trunk and arms in Plug-in Gait."""
_ADDED = _both("THAP", "THAD", "TIAP", "TIAD")
"""Labels on thighs and shanks that CGM2.3 adds."""

MARKER_SETS = (
    MarkerSet(name="Plug-in Gait, lower body", labels=_LOWER),
    MarkerSet(name="Plug-in Gait, full body", labels=(*_LOWER, *_UPPER)),
    MarkerSet(name="CGM2.3, lower body", labels=(*_LOWER, *_ADDED)),
    MarkerSet(name="CGM2.3, full body", labels=(*_LOWER, *_ADDED, *_UPPER)),
)
"""The sets that are recognised. The labels are those in the settings of the program pyCGM2 for its models CGM1, which
reproduces Plug-in Gait, and CGM2.3. Markers of Plug-in Gait that CGM1 does not list (RBAK, LUPA, LFRM) are left out."""


def recognise_marker_sets(labels: Sequence[str]) -> tuple[RecognisedSet, ...]:
    """Recognise the marker set of each person in a trial.

    A set is recognised if most of its markers are there; of several, it is the one with the most markers in the trial.
    Upper and lower case are not distinguished.

    Args:
        labels: Labels of the trial, with a prefix such as `Ann:` if there are several people.

    Returns:
        One entry for each person whose set is known, in the order of their first labels.
    """
    people: dict[str, set[str]] = {}
    for label in labels:
        person, _, name = label.rpartition(":")
        people.setdefault(person, set()).add(name.strip().upper())
    found = (_best_set(person, names) for person, names in people.items())
    return tuple(one for one in found if one is not None)


def _best_set(person: str, names: set[str]) -> RecognisedSet | None:
    """Return the recognised set with the most markers among the names."""
    there = names | set(_SACRUM) if "SACR" in names else names
    candidates = [
        RecognisedSet(marker_set=known, person=person, missing=tuple(x for x in known.labels if x not in there))
        for known in MARKER_SETS
        if len(there.intersection(known.labels)) >= _LEAST_SHARE * len(known.labels)
    ]
    return max(candidates, key=lambda one: len(one.marker_set.labels) - len(one.missing), default=None)
