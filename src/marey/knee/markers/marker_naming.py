"""Names of the scanner's markers in the laboratory, and the bones they are attached to."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Mask, freeze_fields
from marey.errors import MareyError
from marey.geometry.rigid import RigidTransform
from marey.knee.markers.marker_bones import bone_of_label, bone_of_segment, bones_by_place, in_order, may_be_on
from marey.knee.markers.marker_matching import (
    MARKER_MATCHING_DEFAULTS,
    BallMatching,
    GroupMatch,
    MarkerMatchingSettings,
    MarkerPositions,
    best_matching,
    match_group,
    spread_of,
)
from marey.knee.markers.reference_posture import BonePlaces, ReferencePosture
from marey.knee.space.structures import BONES
from marey.knee.space.surface import TriangleSurface

_FEWEST = 3
"""Fewest balls of a bone that are matched by their distances: fewer determine no rigid motion."""
_REMEDY = "Write marker_names into markers.json."
"""What a user can do when distances do not identify the markers."""


@dataclass(frozen=True, kw_only=True)
class MarkerNamingSettings:
    """Settings for finding the laboratory's marker of each ball.

    Values without a stated source were chosen by hand.
    """

    matching: MarkerMatchingSettings = MARKER_MATCHING_DEFAULTS
    """Settings for matching by distances."""
    near_deviations: float = 4.0
    """Number of standard deviations within which an unmatched ball belongs to the other bone's marker."""
    most_by_chance: float = 0.05
    """Largest expected number of chance matches."""


MARKER_NAMING_DEFAULTS = MarkerNamingSettings()
"""Default settings for finding the laboratory's marker of each ball."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ScannerMarkers:
    """The M markers found in an MR volume, with their given names and bones."""

    centres_mm: Floats
    """(M, 3) LPS."""
    sd_mm: Floats
    """(M, 3)."""
    names: tuple[str | None, ...] = ()
    """(M,) the laboratory's label of each, None where it is not given; empty if none is."""
    bones: tuple[str | None, ...] = ()
    """(M,) the bone of each, None where it is not given; empty if none is."""

    def __post_init__(self) -> None:
        freeze_fields(self, "centres_mm", "sd_mm")
        count = len(self.centres_mm)
        for name in ("names", "bones"):
            object.__setattr__(self, name, tuple(getattr(self, name)) or (None,) * count)
        fits = self.centres_mm.shape == (count, 3) == self.sd_mm.shape
        if not (fits and len(self.names) == len(self.bones) == count):
            raise MareyError(f"{count} markers with {len(self.names)} names and {len(self.bones)} bones do not fit.")
        given = [name for name in self.names if name is not None]
        twice = sorted({name for name in given if given.count(name) > 1})
        if twice:
            raise MareyError(f"Two markers in the scanner have the name {', '.join(twice)}.")
        strange = sorted({bone for bone in self.bones if bone is not None} - set(BONES))
        if strange:
            raise MareyError(f"A marker is on {', '.join(strange)}; the bones are {', '.join(BONES)}.")


@dataclass(frozen=True, eq=False, kw_only=True)
class NamedBalls:
    """The marker of the laboratory that corresponds to each of the M balls."""

    labels: tuple[str | None, ...]
    """(M,) label of each; None for a ball without a marker in the laboratory."""
    bones: tuple[str, ...]
    """(M,) the bone of each ball."""
    notes: tuple[str, ...]

    def of(self, bone: str) -> tuple[int, ...]:
        """Return the balls of a bone that have a marker in the laboratory."""
        return tuple(
            ball for ball, its in enumerate(self.bones) if its == bone and self.labels[ball] is not None
        )  # fmt: skip


def segment_of_bone(bone: str, segments: Iterable[str], *, left: bool | None = None) -> str | None:
    """Return the segment of the laboratory that corresponds to a bone of this knee.

    Raises:
        MareyError: Two segments may correspond to it.
    """
    found = [segment for segment in segments if bone_of_segment(segment, left=left) == bone]
    if len(found) > 1:
        raise MareyError(
            f"The activity has {' and '.join(found)}, and the side of the scanned knee is unknown: give side (--side)."
        )
    return found[0] if found else None


def named_balls(
    scanner: ScannerMarkers, posture: ReferencePosture, bones: Mapping[str, TriangleSurface], *,
    segment_of_label: Mapping[str, str], left: bool | None, settings: MarkerNamingSettings = MARKER_NAMING_DEFAULTS,
) -> NamedBalls:  # fmt: skip
    """Return the marker of the laboratory that corresponds to each ball, and its bone.

    Given names are used; the others are found by the distances between the balls of a bone. The bone is the given one,
    else that of the label's segment, else the nearer one.

    Args:
        scanner: The balls found in the volume.
        posture: Positions of the laboratory's markers on the bones.
        bones: Their surfaces in the scanner, by name.
        segment_of_label: Label of the activity to the segment that the marker is attached to.
        left: Whether it is a left knee; None where it is not known.
        settings: Tuned constants of the algorithm.

    Raises:
        MareyError: A name is not in the laboratory's reference; or the distances fit in several ways, or in none.
    """
    strange = [name for name in scanner.names if name is not None and name not in posture.labels]
    if strange:
        raise MareyError(
            f"markers.json names {', '.join(strange)}, missing from the reference, which has: "
            f"{', '.join(posture.labels)}."
        )
    bone_of_ball, notes = _bones(scanner, bones, segment_of_label, left)
    if all(name is not None for name in scanner.names):
        return NamedBalls(labels=scanner.names, bones=bone_of_ball, notes=tuple(notes))
    named = {bone: segment_of_bone(bone, posture.bones, left=left) for bone in in_order(dict.fromkeys(bone_of_ball))}
    open_ = {
        bone: _OpenBone(
            places=posture.bones[segment], labels=posture.labels,
            free=np.array([may_be_on(label, bone, segment_of_label, left=left) for label in posture.labels]),
        )
        for bone, segment in named.items()
        if segment is not None
    }  # fmt: skip
    found, more = _matched(scanner, bone_of_ball, open_, bones, settings)
    notes += more
    labels, bone_of_ball, more = _labelled(scanner, bone_of_ball, open_, found, settings)
    return NamedBalls(labels=labels, bones=bone_of_ball, notes=(*notes, *more))


@dataclass(frozen=True, eq=False, kw_only=True)
class _OpenBone:
    """A bone with the markers among which its balls are searched."""

    places: BonePlaces
    labels: tuple[str, ...]
    """N of the reference."""
    free: Mask
    """(N,) whether a label may be on this bone according to the activity."""

    def markers(self) -> MarkerPositions:
        """Return the markers with one standard deviation each."""
        sd = np.where(np.isfinite(self.places.sd_mm), self.places.sd_mm, 1.0)
        return _markers(self.places.places_mm, sd)

    def allowed(self, scanner: ScannerMarkers, group: Sequence[int]) -> Mask:
        """Return which label each ball of a group may have (M, N): its own name, or any free one that no ball has."""
        given = {name for name in scanner.names if name is not None}
        open_ = self.free & np.array([label not in given for label in self.labels])
        named = [np.array([label == scanner.names[ball] for label in self.labels]) for ball in group]
        return np.array([own if own.any() else open_ for own in named])

    def nearby(
        self, scanner: ScannerMarkers, ball: int, motion: RigidTransform, taken: Sequence[str | None], deviations: float
    ) -> str | None:
        """Return the free marker where a ball would lie, within some deviations, if it were on this bone."""
        off = np.linalg.norm(self.places.places_mm - motion.apply(scanner.centres_mm[ball]), axis=1)
        reach = deviations * np.sqrt((self.places.sd_mm**2).mean(1) + (scanner.sd_mm[ball] ** 2).mean())
        near = [m for m in np.flatnonzero((off < reach) & self.free) if self.labels[m] not in taken]
        return self.labels[near[0]] if len(near) == 1 else None


def _bones(
    scanner: ScannerMarkers,
    bones: Mapping[str, TriangleSurface],
    segment_of_label: Mapping[str, str],
    left: bool | None,
) -> tuple[tuple[str, ...], list[str]]:
    """Return the bone of each ball: given, by its label, or by its position."""
    assigned: list[str | None] = [
        given or (None if name is None else bone_of_label(name, segment_of_label, left=left))
        for given, name in zip(scanner.bones, scanner.names, strict=True)
    ]
    open_ = [ball for ball, bone in enumerate(assigned) if bone is None]
    if not open_:
        return tuple(bone for bone in assigned if bone is not None), []
    if not {"femur", "tibia"} & set(bones):
        raise MareyError("The bone of a marker is not given, and there is no femur or tibia to find it by.")
    near, uncertain = bones_by_place(scanner.centres_mm[open_], bones)
    for ball, bone in zip(open_, near, strict=True):
        assigned[ball] = bone
    notes = [f"The bone of {_numbers(open_)} is not given: the nearer of femur and tibia is used."]
    if uncertain:
        between = _numbers([open_[k] for k in uncertain])
        notes.append(f"About equally near to both bones: {between}. Write marker_segment into markers.json to be sure.")
    return tuple(bone for bone in assigned if bone is not None), notes


def _numbers(balls: Sequence[int]) -> str:
    """Name balls by their index in markers.json, counted from 0."""
    return ("marker " if len(balls) == 1 else "markers ") + ", ".join(str(ball) for ball in balls)


def _matched(
    scanner: ScannerMarkers,
    bone_of_ball: Sequence[str],
    open_: Mapping[str, _OpenBone],
    bones: Mapping[str, TriangleSurface],
    settings: MarkerNamingSettings,
) -> tuple[BallMatching, list[str]]:
    """Match the balls of every bone by their distances."""
    found: dict[str, list[GroupMatch]] = {}
    notes: list[str] = []
    spread = 0.0
    for bone, there in open_.items():
        group = _group(bone_of_ball, bone)
        if len(group) < _FEWEST:
            continue
        balls, markers = _markers(scanner.centres_mm[group], scanner.sd_mm[group]), there.markers()
        allowed = there.allowed(scanner, group)
        found[bone] = match_group(balls, markers, allowed, settings=settings.matching)
        spread = max(spread, spread_of(markers, allowed))
        if not found[bone]:
            notes.append(f"{bone}: no three of its markers have distances that agree with the reference.")
    frames = {bone: open_[bone].places.laboratory_from_bone for bone in found}
    middle = knee_middle(bones, scanner)
    matching = best_matching(found, middle, frames, spread_mm=spread, settings=settings.matching)
    if any(found.values()) and not matching.groups:
        raise MareyError(
            "The distances between the markers agree with markers of the reference, but femur and tibia would then "
            f"form no knee. Check that the reference shows the markers of the scanner. {_REMEDY}"
        )
    if matching.rivals:
        ambiguous = "; ".join(
            f"{_numbers([_group(bone_of_ball, bone)[k] for k in balls])} of the {bone}"
            for bone, balls in matching.rivals
        )
        raise MareyError(
            f"The distances between the markers fit the reference in more than one way ({ambiguous}): their "
            f"arrangement is too regular. {_REMEDY}"
        )
    if matching.by_chance > settings.most_by_chance:
        raise MareyError(
            "The distances between the markers fit the reference, but so few distances also fit by chance if the "
            f"reference has so many markers (expected number of chance fits: {matching.by_chance:.2g}). {_REMEDY}"
        )
    return matching, notes


def knee_middle(bones: Mapping[str, TriangleSurface], scanner: ScannerMarkers) -> Floats:
    """Return the middle between femur and tibia, or of the markers where a bone is missing."""
    if {"femur", "tibia"} <= set(bones):
        low = bones["femur"].vertices_mm
        return np.asarray((low[low[:, 2] < low[:, 2].min() + 20.0]).mean(0))
    return np.asarray(scanner.centres_mm.mean(0))


def _group(bone_of_ball: Sequence[str], bone: str) -> list[int]:
    return [ball for ball, its in enumerate(bone_of_ball) if its == bone]


def _markers(places_mm: Floats, sd_mm: Floats) -> MarkerPositions:
    return MarkerPositions(places_mm=places_mm, sd_mm=np.sqrt((sd_mm**2).mean(1)))


def _labelled(
    scanner: ScannerMarkers,
    bone_of_ball: Sequence[str],
    open_: Mapping[str, _OpenBone],
    found: BallMatching,
    settings: MarkerNamingSettings,
) -> tuple[tuple[str | None, ...], tuple[str, ...], list[str]]:
    """Return labels, bones and notes; an unmatched ball may belong to the other bone."""
    labels: list[str | None] = list(scanner.names)
    bone_of_ball = list(bone_of_ball)
    for bone, match in found.groups.items():
        for ball, marker in zip(_group(bone_of_ball, bone), match.markers.tolist(), strict=True):
            labels[ball] = open_[bone].labels[marker] if marker >= 0 else None
    notes = []
    for ball in [ball for ball, label in enumerate(labels) if label is None and scanner.bones[ball] is None]:
        for bone, match in found.groups.items():
            label = open_[bone].nearby(scanner, ball, match.to_from, labels, settings.near_deviations)
            if label is not None and labels[ball] is None and bone != bone_of_ball[ball]:
                notes.append(f"{_numbers([ball])} fits {label} if it is on the {bone}, and is assigned to this bone.")
                labels[ball], bone_of_ball[ball] = label, bone
    pairs = ", ".join(f"{ball} is {label}" for ball, label in enumerate(labels) if label != scanner.names[ball])
    if pairs:
        notes.append(f"Identified by the distances between the markers: marker {pairs}.")
    lost = {bone: [b for b in _group(bone_of_ball, bone) if labels[b] is None] for bone in dict.fromkeys(bone_of_ball)}
    notes += [
        f"{bone}: {_numbers(balls)} ignored, because the reference has no marker at this position."
        for bone, balls in lost.items()
        if balls
    ]
    return tuple(labels), tuple(bone_of_ball), notes
