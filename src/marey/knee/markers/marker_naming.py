"""Each of the scanner's markers by the laboratory's name, and the bone it rides on."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Mask, freeze_fields
from marey.errors import MareyError
from marey.geometry.rigid import RigidTransform
from marey.knee.markers.marker_bones import bone_of_label, bone_of_segment, bones_by_place, in_order, may_ride
from marey.knee.markers.marker_matching import GroupMatch, Markers, Matching, best_matching, match_group, spread_of
from marey.knee.markers.reference_posture import BonePlaces, ReferencePosture
from marey.knee.space.structures import BONES
from marey.knee.space.surface import Surface

_NEAR = 4.0  # standard deviations within which a lost ball belongs to the other bone's marker
_FEWEST = 3
_MOST_BY_CHANCE = 0.05
_REMEDY = "Write marker_names into markers.json."


@dataclass(frozen=True, eq=False, kw_only=True)
class ScannerMarkers:
    """The M markers that were found in an MR volume, and what is said of them."""

    centres_mm: Floats
    """(M, 3) LPS."""
    sd_mm: Floats
    """(M, 3)."""
    names: tuple[str | None, ...] = ()
    """(M,) the laboratory's label of each, None where it is not said; empty where none is."""
    bones: tuple[str | None, ...] = ()
    """(M,) the bone that each rides on, None where it is not said; empty where none is."""

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
            raise MareyError(f"A marker rides on {', '.join(strange)}; the bones are {', '.join(BONES)}.")


@dataclass(frozen=True, eq=False, kw_only=True)
class NamedBalls:
    """Which marker of the laboratory each of the M balls is."""

    labels: tuple[str | None, ...]
    """(M,) None for a ball without a marker there."""
    bones: tuple[str, ...]
    """(M,) the bone that each rides on."""
    notes: tuple[str, ...]

    def of(self, bone: str) -> tuple[int, ...]:
        """Return the balls of a bone that have a marker in the laboratory."""
        return tuple(
            ball for ball, its in enumerate(self.bones) if its == bone and self.labels[ball] is not None
        )  # fmt: skip


def segment_of_bone(bone: str, segments: Iterable[str], *, left: bool | None = None) -> str | None:
    """Return the one segment of the laboratory that is a bone of this knee.

    Raises:
        MareyError: Two of them could be.
    """
    found = [segment for segment in segments if bone_of_segment(segment, left=left) == bone]
    if len(found) > 1:
        raise MareyError(f"The activity has {' and '.join(found)}, and which knee was scanned is not known: --side.")
    return found[0] if found else None


def named_balls(
    scanner: ScannerMarkers, posture: ReferencePosture, bones: Mapping[str, Surface], *,
    segment_of_label: Mapping[str, str], left: bool | None,
) -> NamedBalls:  # fmt: skip
    """Return which marker of the laboratory each ball is, and which bone it rides on.

    Names that are given count; the others are told by the distances of the balls of a bone from each other. The bone
    is the one that is given, else that of the label's segment, else the nearer one.

    Raises:
        MareyError: A name is not in the laboratory's reference; or the distances fit several ways, or none.
    """
    strange = [name for name in scanner.names if name is not None and name not in posture.labels]
    if strange:
        raise MareyError(
            f"markers.json names {', '.join(strange)}, which the reference does not have. It has: "
            f"{', '.join(posture.labels)}."
        )
    riding, notes = _bones(scanner, bones, segment_of_label, left)
    if all(name is not None for name in scanner.names):
        return NamedBalls(labels=scanner.names, bones=riding, notes=tuple(notes))
    named = {bone: segment_of_bone(bone, posture.bones, left=left) for bone in in_order(dict.fromkeys(riding))}
    open_ = {
        bone: _OpenBone(
            places=posture.bones[segment], labels=posture.labels,
            free=np.array([may_ride(label, bone, segment_of_label, left=left) for label in posture.labels]),
        )
        for bone, segment in named.items()
        if segment is not None
    }  # fmt: skip
    found, said = _matched(scanner, riding, open_, bones)
    notes += said
    labels, riding, said = _told(scanner, riding, open_, found)
    return NamedBalls(labels=labels, bones=riding, notes=(*notes, *said))


@dataclass(frozen=True, eq=False, kw_only=True)
class _OpenBone:
    """A bone among whose markers balls are sought."""

    places: BonePlaces
    labels: tuple[str, ...]
    """N of the reference."""
    free: Mask
    """(N,) whether a label may be on this bone, as far as the activity tells."""

    def markers(self) -> Markers:
        """Return the markers with one deviation each."""
        sd = np.where(np.isfinite(self.places.sd_mm), self.places.sd_mm, 1.0)
        return _markers(self.places.places_mm, sd)

    def allowed(self, scanner: ScannerMarkers, group: Sequence[int]) -> Mask:
        """Return which label each ball of a group may have (M, N): its own name, or any free one that no ball has."""
        given = {name for name in scanner.names if name is not None}
        open_ = self.free & np.array([label not in given for label in self.labels])
        named = [np.array([label == scanner.names[ball] for label in self.labels]) for ball in group]
        return np.array([own if own.any() else open_ for own in named])

    def nearby(
        self, scanner: ScannerMarkers, ball: int, motion: RigidTransform, taken: Sequence[str | None]
    ) -> str | None:
        """Return the free marker where a ball would lie if it rode on this bone."""
        off = np.linalg.norm(self.places.places_mm - motion.apply(scanner.centres_mm[ball]), axis=1)
        reach = _NEAR * np.sqrt((self.places.sd_mm**2).mean(1) + (scanner.sd_mm[ball] ** 2).mean())
        near = [m for m in np.flatnonzero((off < reach) & self.free) if self.labels[m] not in taken]
        return self.labels[near[0]] if len(near) == 1 else None


def _bones(
    scanner: ScannerMarkers, bones: Mapping[str, Surface], segment_of_label: Mapping[str, str], left: bool | None
) -> tuple[tuple[str, ...], list[str]]:
    """Return the bone of each ball: said, by its label, or by its place."""
    said: list[str | None] = [
        given or (None if name is None else bone_of_label(name, segment_of_label, left=left))
        for given, name in zip(scanner.bones, scanner.names, strict=True)
    ]
    open_ = [ball for ball, bone in enumerate(said) if bone is None]
    if not open_:
        return tuple(bone for bone in said if bone is not None), []
    if not {"femur", "tibia"} & set(bones):
        raise MareyError("Which bone a marker rides on is not said, and there is no femur or tibia to tell it by.")
    near, doubtful = bones_by_place(scanner.centres_mm[open_], bones)
    for ball, bone in zip(open_, near, strict=True):
        said[ball] = bone
    notes = [f"By its place each of {_numbers(open_)} rides on the nearer of femur and tibia."]
    if doubtful:
        between = _numbers([open_[k] for k in doubtful])
        notes.append(f"About as near to both: {between}. Write marker_segment into markers.json to be sure.")
    return tuple(bone for bone in said if bone is not None), notes


def _numbers(balls: Sequence[int]) -> str:
    """Name balls by their place in markers.json, counted from 0."""
    return ("marker " if len(balls) == 1 else "markers ") + ", ".join(str(ball) for ball in balls)


def _matched(
    scanner: ScannerMarkers, riding: Sequence[str], open_: Mapping[str, _OpenBone], bones: Mapping[str, Surface]
) -> tuple[Matching, list[str]]:
    """Match the balls of every bone by their distances."""
    found: dict[str, list[GroupMatch]] = {}
    notes: list[str] = []
    spread = 0.0
    for bone, there in open_.items():
        group = _group(riding, bone)
        if len(group) < _FEWEST:
            continue
        balls, markers = _markers(scanner.centres_mm[group], scanner.sd_mm[group]), there.markers()
        allowed = there.allowed(scanner, group)
        found[bone] = match_group(balls, markers, allowed)
        spread = max(spread, spread_of(markers, allowed))
        if not found[bone]:
            notes.append(f"{bone}: no three of its markers lie as far from each other as any in the reference do.")
    frames = {bone: open_[bone].places.laboratory_from_bone for bone in found}
    matching = best_matching(found, _knee_middle(bones, scanner), frames, spread_mm=spread)
    if any(found.values()) and not matching.groups:
        raise MareyError(
            "The markers' distances fit some of the reference, but not so that femur and tibia make a knee. Are the "
            f"scanner's markers in it? {_REMEDY}"
        )
    if matching.rivals:
        doubt = "; ".join(
            f"{_numbers([_group(riding, bone)[k] for k in balls])} of the {bone}" for bone, balls in matching.rivals
        )
        raise MareyError(
            f"The markers' distances fit the reference in more than one way ({doubt}): they stand too regularly to be "
            f"told apart. {_REMEDY}"
        )
    if matching.by_chance > _MOST_BY_CHANCE:
        raise MareyError(
            "The markers' distances fit the reference, but among so many markers so few distances would by chance, too "
            f"(to be expected: {matching.by_chance:.2g} times). {_REMEDY}"
        )
    return matching, notes


def _knee_middle(bones: Mapping[str, Surface], scanner: ScannerMarkers) -> Floats:
    """Return the middle between femur and tibia, or of the markers where a bone lacks."""
    if {"femur", "tibia"} <= set(bones):
        low = bones["femur"].vertices_mm
        return np.asarray((low[low[:, 2] < low[:, 2].min() + 20.0]).mean(0))
    return np.asarray(scanner.centres_mm.mean(0))


def _group(riding: Sequence[str], bone: str) -> list[int]:
    return [ball for ball, its in enumerate(riding) if its == bone]


def _markers(places_mm: Floats, sd_mm: Floats) -> Markers:
    return Markers(places_mm=places_mm, sd_mm=np.sqrt((sd_mm**2).mean(1)))


def _told(
    scanner: ScannerMarkers, riding: Sequence[str], open_: Mapping[str, _OpenBone], found: Matching
) -> tuple[tuple[str | None, ...], tuple[str, ...], list[str]]:
    """Return the labels, and see whether a ball that was lost belongs to the other bone."""
    labels: list[str | None] = list(scanner.names)
    riding = list(riding)
    for bone, match in found.groups.items():
        for ball, marker in zip(_group(riding, bone), match.markers.tolist(), strict=True):
            labels[ball] = open_[bone].labels[marker] if marker >= 0 else None
    notes = []
    for ball in [ball for ball, label in enumerate(labels) if label is None and scanner.bones[ball] is None]:
        for bone, match in found.groups.items():
            label = open_[bone].nearby(scanner, ball, match.to_from, labels)
            if label is not None and labels[ball] is None and bone != riding[ball]:
                notes.append(f"{_numbers([ball])} is {label} if it rides on the {bone}, so it does.")
                labels[ball], riding[ball] = label, bone
    pairs = ", ".join(f"{ball} is {label}" for ball, label in enumerate(labels) if label != scanner.names[ball])
    if pairs:
        notes.append(f"By the distances between them: marker {pairs}.")
    lost = {bone: [b for b in _group(riding, bone) if labels[b] is None] for bone in dict.fromkeys(riding)}
    notes += [
        f"Of the {bone}, {_numbers(balls)}: no marker of the reference where it should be; passed over."
        for bone, balls in lost.items()
        if balls
    ]
    return tuple(labels), tuple(riding), notes
