"""Each of the scanner's markers by the laboratory's name, and the bone it rides on."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Mask, frozen
from marey.errors import MareyError
from marey.geometry.rigid import RigidTransform
from marey.knee.marker_bones import bone_of_label, bone_of_segment, bones_by_place, in_order
from marey.knee.marker_matching import GroupMatch, Markers, Matching, best_matching, match_group
from marey.knee.reference_posture import ReferencePosture
from marey.knee.structures import BONES
from marey.knee.surface import Surface

_NEAR = 4.0  # standard deviations within which a lost ball belongs to the other bone's marker
_FEWEST = 3


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
        object.__setattr__(self, "centres_mm", frozen(self.centres_mm))
        object.__setattr__(self, "sd_mm", frozen(self.sd_mm))
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
        """Give the balls of a bone that have a marker in the laboratory."""
        return tuple(
            ball for ball, its in enumerate(self.bones) if its == bone and self.labels[ball] is not None
        )  # fmt: skip


def segment_of_bone(bone: str, segments: Iterable[str], *, left: bool | None = None) -> str | None:
    """Give the one segment of the laboratory that is a bone of this knee.

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
    """Tell which marker of the laboratory each ball is, and which bone it rides on.

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
    segments = {bone: segment_of_bone(bone, posture.bones, left=left) for bone in set(riding)}
    found, said = _matched(scanner, posture, riding, {b: s for b, s in segments.items() if s is not None}, bones)
    notes += said
    labels, riding, said = _told(scanner, posture, riding, segments, found)
    notes += said
    riding, said = _by_labels(scanner, labels, riding, segment_of_label, left)
    return NamedBalls(labels=labels, bones=riding, notes=(*notes, *said))


def _by_labels(
    scanner: ScannerMarkers, labels: Sequence[str | None], riding: Sequence[str],
    segment_of_label: Mapping[str, str], left: bool | None,
) -> tuple[tuple[str, ...], list[str]]:  # fmt: skip
    """Give a ball whose bone was told by its place to the bone that its label tells, when it is found."""
    notes, final = [], list(riding)
    for ball, label in enumerate(labels):
        told = None if label is None else bone_of_label(label, segment_of_label, left=left)
        if scanner.bones[ball] is None and told not in (None, riding[ball]):
            assert told is not None
            notes.append(
                f"{_numbers([ball])} is {label} and so rides on the {told}, though the {riding[ball]} is nearer."
            )
            final[ball] = told
    return tuple(final), notes


def _bones(
    scanner: ScannerMarkers, bones: Mapping[str, Surface], segment_of_label: Mapping[str, str], left: bool | None
) -> tuple[tuple[str, ...], list[str]]:
    """Give the bone of each ball: said, by its label, or by its place."""
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
    scanner: ScannerMarkers, posture: ReferencePosture, riding: Sequence[str], segments: Mapping[str, str],
    bones: Mapping[str, Surface],
) -> tuple[Matching, list[str]]:  # fmt: skip
    """Match the balls of every bone by their distances."""
    found: dict[str, list[GroupMatch]] = {}
    notes: list[str] = []
    for bone in in_order(segments):
        group = _group(riding, bone)
        if len(group) < _FEWEST:
            continue
        found[bone] = match_group(
            _markers(scanner.centres_mm[group], scanner.sd_mm[group]), _of_bone(posture, segments[bone]),
            _allowed(scanner, posture, group),
        )  # fmt: skip
        if not found[bone]:
            notes.append(f"{bone}: no three of its markers lie as far from each other as any in the reference do.")
    frames = {bone: posture.bones[segments[bone]].laboratory_from_bone for bone in found}
    matching = best_matching(found, _knee_middle(bones, scanner), frames)
    if any(found.values()) and not matching.groups:
        raise MareyError(
            "The markers' distances fit, but not so that femur and tibia make a knee: write marker_names into "
            "markers.json."
        )
    if matching.rivals:
        doubt = "; ".join(
            f"{_numbers([_group(riding, b)[k] for k in balls])} of the {b}" for b, balls in matching.rivals
        )
        raise MareyError(
            f"The markers' distances fit the reference in more than one way ({doubt}): they stand too regularly to be "
            "told apart. Write marker_names into markers.json."
        )
    return matching, notes


def _knee_middle(bones: Mapping[str, Surface], scanner: ScannerMarkers) -> Floats:
    """Give the middle between femur and tibia, or of the markers where a bone lacks."""
    if {"femur", "tibia"} <= set(bones):
        low = bones["femur"].vertices_mm
        return np.asarray((low[low[:, 2] < low[:, 2].min() + 20.0]).mean(0))
    return np.asarray(scanner.centres_mm.mean(0))


def _group(riding: Sequence[str], bone: str) -> list[int]:
    return [ball for ball, its in enumerate(riding) if its == bone]


def _markers(places_mm: Floats, sd_mm: Floats) -> Markers:
    return Markers(places_mm=places_mm, sd_mm=np.sqrt((sd_mm**2).mean(1)))


def _of_bone(posture: ReferencePosture, segment: str) -> Markers:
    places = posture.bones[segment]
    return _markers(places.places_mm, np.where(np.isfinite(places.sd_mm), places.sd_mm, 1.0))


def _allowed(scanner: ScannerMarkers, posture: ReferencePosture, group: Sequence[int]) -> Mask:
    """Tell which label each ball of a group may have (M, N): its own name, or any that no ball has."""
    given = {name for name in scanner.names if name is not None}
    free = np.array([label not in given for label in posture.labels])
    named = [np.array([label == scanner.names[ball] for label in posture.labels]) for ball in group]
    return np.array([own if own.any() else free for own in named])


def _told(
    scanner: ScannerMarkers, posture: ReferencePosture, riding: Sequence[str], segments: Mapping[str, str | None],
    found: Matching,
) -> tuple[tuple[str | None, ...], tuple[str, ...], list[str]]:  # fmt: skip
    """Give the labels, and see whether a ball that was lost belongs to the other bone."""
    labels: list[str | None] = list(scanner.names)
    riding = list(riding)
    for bone, match in found.groups.items():
        for ball, marker in zip(_group(riding, bone), match.markers.tolist(), strict=True):
            labels[ball] = posture.labels[marker] if marker >= 0 else None
    notes = []
    for ball in [ball for ball, label in enumerate(labels) if label is None]:
        for bone, match in found.groups.items():
            segment = segments[bone]
            label = None if bone == riding[ball] or scanner.bones[ball] is not None or segment is None else _nearby(
                scanner, ball, posture, segment, match.to_from, labels)  # fmt: skip
            if label is not None:
                notes.append(f"{_numbers([ball])} is {label} if it rides on the {bone}, so it does.")
                labels[ball], riding[ball] = label, bone
    pairs = ", ".join(f"{ball} is {label}" for ball, label in enumerate(labels) if label != scanner.names[ball])
    if pairs:
        notes.append(f"By the distances between them: marker {pairs}.")
    notes += [
        f"{_numbers([ball])} of the {riding[ball]} has no marker of the reference where it should be; passed over."
        for ball, label in enumerate(labels)
        if label is None
    ]
    return tuple(labels), tuple(riding), notes


def _nearby(
    scanner: ScannerMarkers, ball: int, posture: ReferencePosture, segment: str, motion: RigidTransform,
    taken: Sequence[str | None],
) -> str | None:  # fmt: skip
    """Give the free marker where a ball would lie if it rode on a bone."""
    places = posture.bones[segment]
    off = np.linalg.norm(places.places_mm - motion.apply(scanner.centres_mm[ball]), axis=1)
    reach = _NEAR * np.sqrt((places.sd_mm**2).mean(1) + (scanner.sd_mm[ball] ** 2).mean())
    near = [m for m in np.flatnonzero(off < reach) if posture.labels[m] not in taken]
    return posture.labels[near[0]] if len(near) == 1 else None
