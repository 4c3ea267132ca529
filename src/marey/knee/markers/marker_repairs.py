"""Repairs of markers that do not correspond between scanner and laboratory, each tried and compared."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, product

import numpy as np
from scipy.spatial import cKDTree

from marey.arrays import Floats
from marey.errors import MareyError
from marey.geometry.rigid import RigidTransform
from marey.knee.markers.bend_checks import forward_bend, markers_beyond
from marey.knee.markers.marker_fit import FEWEST, CommonMarkers, MarkerFit, fit_markers
from marey.knee.markers.marker_naming import NamedBalls, ScannerMarkers, knee_middle, named_balls, segment_of_bone
from marey.knee.markers.reference_posture import BonePlaces, ReferencePosture
from marey.knee.space.sides import mirrored
from marey.knee.space.surface import TriangleSurface
from marey.markers.preprocessing.posture_repairs import side_pairs

_UNITS = (0.001, 0.01, 0.1, 10.0, 100.0, 1000.0)
"""Ratios of two units of length that are mistaken for each other: metres, decimetres, centimetres, millimetres."""
_SAMPLED = 20
"""Every how many vertices of a bone the distance of balls is measured. Chosen for the time."""
_AXES = "xyz"
"""Names of the axes of the scanner."""


@dataclass(frozen=True, kw_only=True)
class MarkerRepairSettings:
    """Thresholds at which balls and markers do not correspond, and at which a repair is the cause.

    Chosen on `phantom_a` in two trials of `sta`, with errors of 0.5 to 6 mm in each coordinate, a ball that was put
    back 20 mm beside its place, and faults planted; `phantom_spl` in a third trial is held out. The figures of both are
    those of `bench knee/planted_marker_faults`. Values without a measurement were chosen by hand.
    """

    least_residual_mm: float = 4.0
    """Distance of balls and markers (RMS) above which repairs are tried [mm]."""
    largest_ratio: float = 0.5
    """With the repair, what does not fit is below this ratio of that without it."""
    largest_names_ratio: float = 0.25
    """The same ratio for two exchanged names, of which there are many pairs."""
    explained_mm: float = 8.0
    """Largest distance of balls and markers (RMS) with the repair [mm]. Sound ones with errors of 4 mm have 6.6 mm."""
    most_residual_mm: float = 15.0
    """Distance (RMS) above which balls and markers are not the same [mm]. With errors of 6 mm and a ball 20 mm beside
    its place it is 12 mm."""
    most_apart_mm: float = 25.0
    """Largest distance of the knee's middle, moved with the femur, from the same moved with the tibia [mm], as for
    balls without names. Sound knees have 20 mm with errors of 2 mm and a ball beside its place; mirror images 140."""
    most_turned: float = float(np.radians(75.0))
    """Largest rotation of the knee between scanner and reference [rad], as for balls without names."""
    most_forward: float = float(np.radians(25.0))
    """Largest bend of the knee to the front [rad]. Sound ones have up to 5 degrees; those with the signs of x and y
    changed have 30 degrees and more. Knees can be overstretched by 10 to 15 degrees. With errors of 6 mm and a ball
    beside its place a sound one had 34 degrees: the bend counts only below `least_residual_mm`."""
    most_reversed_mm: float = 20.0
    """Distance of the markers of both segments beyond the knee at which the bones point away from them [mm]."""
    usual_from_bones_mm: float = 40.0
    """Distance of the balls from the bones (median) above which other axes are tried [mm]; 16 mm in `phantom_a`."""
    most_from_bones_mm: float = 100.0
    """Distance of the balls from the bones (median) above which they are not around them [mm]."""
    alike_ratio: float = 1.1
    """Repairs whose distances are within this ratio of the least fit alike; the one with the better knee is named."""
    alike_mm: float = 0.1
    """And within this much more [mm]."""
    sizes_mm: tuple[float, float] = (15.0, 150.0)
    """Least and largest distance (RMS) of a bone's balls from their middle [mm]. It is 48 mm in `phantom_a`."""


MARKER_REPAIR_DEFAULTS = MarkerRepairSettings()
"""Default thresholds of the repairs of markers."""


@dataclass(frozen=True, kw_only=True)
class MarkerMisfit:
    """How badly the balls of the scanner correspond to the markers of the laboratory."""

    residual_mm: float
    """Distance of balls and markers (RMS), each bone aligned; without a ball that moved."""
    apart_mm: float
    """Distance of the knee's middle, moved with the femur, from the same moved with the tibia; NaN with one bone."""
    turned: float
    """Rotation of the knee between scanner and reference [rad]; NaN with one bone."""
    from_bones_mm: float
    """Distance of the balls from femur and tibia in the scanner (median)."""
    size_mm: float
    """Distance of a bone's balls from their middle (RMS)."""
    every_mm: float
    """As `residual_mm`, with the balls that moved."""
    forward: float = float("nan")
    """By how much the knee bends forwards in the activity [rad]; NaN if it is not known."""
    beyond_mm: float = float("nan")
    """Distance of the markers of the thigh above the knee, or of those of the shank below it; negative if both bones
    point away from them, NaN if it is not known."""

    def turned_round(self, settings: MarkerRepairSettings = MARKER_REPAIR_DEFAULTS) -> bool:
        """Return whether the knee bends forwards, or the bones point away from their markers.

        Balls that do not fit their markers do not determine by how much the knee is bent.
        """
        forwards = self.residual_mm < settings.least_residual_mm and self.forward > settings.most_forward
        return forwards or self.beyond_mm < -settings.most_reversed_mm

    def plausible(self, settings: MarkerRepairSettings = MARKER_REPAIR_DEFAULTS) -> bool:
        """Return whether balls and bones are arranged as those of a knee, whatever the residual is."""
        least, most = settings.sizes_mm
        return bool(
            not self.apart_mm > settings.most_apart_mm and not self.turned > settings.most_turned
            and not self.from_bones_mm > settings.most_from_bones_mm and least < self.size_mm < most
            and not self.turned_round(settings)
        )  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True)
class Correspondents:
    """What is made to correspond: the knee in the scanner and the reference posture of the laboratory."""

    scanner: ScannerMarkers
    posture: ReferencePosture
    bones: Mapping[str, TriangleSurface]
    """Surfaces in the scanner, by name."""
    segment_of_label: Mapping[str, str]
    """Label of the activity to the segment that the marker is attached to."""
    left: bool | None
    """Whether it is a left knee; None where it is not known."""
    bends: Floats = field(default_factory=lambda: np.zeros((0, 3, 3)))
    """(F, 3, 3) rotations of the tibia's segment in the femur's over the activity; none if they are not known."""


@dataclass(frozen=True, eq=False, kw_only=True)
class MarkerRepair:
    """A change with which balls and markers correspond."""

    kind: str
    """`unit`, `mirrored`, `axes` (other signs), `names` (of two balls exchanged) or `sides`."""
    of: str
    """What is changed: `balls`, `scan` (bones and balls) or `laboratory`."""
    repaired: Correspondents
    names: tuple[str, ...] = ()
    """The exchanged names, or the axes whose signs are changed."""
    factor: float = 1.0
    """The factor of a unit."""


def marker_misfit(
    given: Correspondents, settings: MarkerRepairSettings = MARKER_REPAIR_DEFAULTS
) -> MarkerMisfit | None:
    """Return how badly balls and markers correspond; None if no bone has three balls that can be compared.

    Args:
        given: Scanner and laboratory.
        settings: Thresholds.
    """
    if None in given.scanner.names and not _comparable(given, settings):
        return None
    fits: dict[str, tuple[MarkerFit, BonePlaces]] = {}
    sizes = []
    try:
        naming = named_balls(
            given.scanner, given.posture, given.bones, segment_of_label=given.segment_of_label, left=given.left
        )
        for bone in dict.fromkeys(naming.bones):
            found = _fitted(given, naming, bone)
            if found is not None:
                fits[bone] = found[:2]
                sizes.append(found[2])
    except MareyError:
        return None
    if not fits:
        return None
    every = np.concatenate([(fit.residuals_mm**2).sum(1) for fit, _ in fits.values()])
    used = np.concatenate([fit.used for fit, _ in fits.values()])
    apart, turned = _knee(given, fits)
    forward, beyond = _turned_round(given, fits)
    return MarkerMisfit(
        residual_mm=float(np.sqrt(every[used].mean())), apart_mm=apart, turned=turned, from_bones_mm=_from_bones(given),
        size_mm=float(np.sqrt(np.mean(np.square(sizes)))), every_mm=float(np.sqrt(every.mean())), forward=forward,
        beyond_mm=beyond,
    )  # fmt: skip


def _comparable(given: Correspondents, settings: MarkerRepairSettings) -> bool:
    """Return whether balls and markers are about as far apart; else their distances cannot identify them."""
    least, most = settings.sizes_mm
    across = np.linalg.norm(np.ptp(given.scanner.centres_mm, axis=0))
    there = [each.places_mm for each in given.posture.bones.values()]
    extent = max(float(np.linalg.norm(np.nanmax(each, axis=0) - np.nanmin(each, axis=0))) for each in there)
    return bool(least < across < 10 * most and least < extent < 100 * most)


def _fitted(given: Correspondents, naming: NamedBalls, bone: str) -> tuple[MarkerFit, BonePlaces, float] | None:
    """Fit the common markers of a bone; the last value is the size of its balls [mm]."""
    segment = segment_of_bone(bone, given.posture.bones, left=given.left)
    if segment is None:
        return None
    places = given.posture.bones[segment]
    pairs = [(ball, given.posture.labels.index(str(naming.labels[ball]))) for ball in naming.of(bone)]
    pairs = [(ball, m) for ball, m in pairs if np.isfinite(places.places_mm[m]).all()]
    if len(pairs) < FEWEST:
        return None
    balls, markers = (list(each) for each in zip(*pairs, strict=True))
    centres = given.scanner.centres_mm[balls]
    common = CommonMarkers(
        names=tuple(given.posture.labels[m] for m in markers), from_mm=centres, from_sd_mm=given.scanner.sd_mm[balls],
        to_mm=places.places_mm[markers], to_sd_mm=places.sd_mm[markers],
    )  # fmt: skip
    return fit_markers(common), places, float(np.sqrt(((centres - centres.mean(0)) ** 2).sum(1).mean()))


def _knee(given: Correspondents, fits: Mapping[str, tuple[MarkerFit, BonePlaces]]) -> tuple[float, float]:
    """Return how far the knee's middle moves apart [mm], and how far the knee turns [rad], in the reference."""
    if not {"femur", "tibia"} <= set(fits):
        return float("nan"), float("nan")
    middle = knee_middle(given.bones, given.scanner)
    femur, tibia = (
        places.laboratory_from_bone @ RigidTransform(fit.rotation, fit.translation_mm)
        for fit, places in (fits["femur"], fits["tibia"])
    )
    turned = np.linalg.norm((femur.inverse() @ tibia).rotation_vector)
    return float(np.linalg.norm(femur.apply(middle) - tibia.apply(middle))), float(turned)


def _turned_round(
    given: Correspondents, fits: Mapping[str, tuple[MarkerFit, BonePlaces]]
) -> tuple[float, float]:  # fmt: skip
    """Return by how much the knee bends forwards [rad], and how far the segments' markers lie beyond it [mm]."""
    if not {"femur", "tibia"} <= set(fits):
        return float("nan"), float("nan")
    segments = {
        bone: (RigidTransform(fit.rotation, fit.translation_mm), _places_of(given, places))
        for bone, (fit, places) in fits.items()
    }
    forward = forward_bend(given.bones, segments["femur"][0], segments["tibia"][0], given.bends)
    return forward, markers_beyond(given.bones, segments, knee_middle(given.bones, given.scanner))


def _places_of(given: Correspondents, places: BonePlaces) -> Floats:
    """Return the positions (M, 3) of the activity's markers on a segment, in the segment [mm]."""
    own = [k for k, label in enumerate(given.posture.labels) if given.segment_of_label.get(label) == places.segment]
    return places.places_mm[own]


def _from_bones(given: Correspondents) -> float:
    there = [bone.vertices_mm[::_SAMPLED] for name, bone in given.bones.items() if name in ("femur", "tibia")]
    if not there:
        return float("nan")
    return float(np.median(cKDTree(np.concatenate(there)).query(given.scanner.centres_mm)[0]))


def repairs(given: Correspondents) -> Iterator[MarkerRepair]:
    """Yield scanner and laboratory with each repair.

    Args:
        given: Scanner and laboratory.
    """
    scanner = given.scanner
    for factor in _UNITS:
        balls = _with_centres(given, scanner.centres_mm * factor)
        yield MarkerRepair(kind="unit", of="balls", factor=factor, repaired=balls)
        yield MarkerRepair(kind="unit", of="scan", factor=factor, repaired=replace(
            balls, bones={name: _scaled_bone(bone, factor) for name, bone in given.bones.items()}
        ))  # fmt: skip
        yield MarkerRepair(
            kind="unit", of="laboratory", factor=factor, repaired=replace(given, posture=scaled(given.posture, factor))
        )
    for signs in product((1.0, -1.0), repeat=3):
        if min(signs) < 0:
            axes = tuple(axis for axis, sign in zip(_AXES, signs, strict=True) if sign < 0)
            yield MarkerRepair(
                kind="mirrored" if len(axes) % 2 else "axes", of="balls", names=axes,
                repaired=_with_centres(given, scanner.centres_mm * np.array(signs)),
            )  # fmt: skip
    yield MarkerRepair(kind="mirrored", of="scan", repaired=mirrored_scan(given))
    named = [name for name in scanner.names if name is not None]
    sides = _other_sides(named, given.posture.labels)
    if sides:
        yield MarkerRepair(kind="sides", of="balls", repaired=_renamed(given, sides))
    for pair in combinations(named, 2):
        exchanged = _renamed(given, dict(zip(pair, reversed(pair), strict=True)))
        yield MarkerRepair(kind="names", of="balls", names=pair, repaired=exchanged)


def _scaled_bone(bone: TriangleSurface, factor: float) -> TriangleSurface:
    return TriangleSurface(vertices_mm=bone.vertices_mm * factor, faces=bone.faces)


def _with_centres(given: Correspondents, centres_mm: Floats) -> Correspondents:
    return replace(given, scanner=replace(given.scanner, centres_mm=centres_mm))


def scaled(posture: ReferencePosture, factor: float) -> ReferencePosture:
    """Return a posture with all coordinates multiplied by a factor.

    Args:
        posture: A posture.
        factor: The factor.
    """
    bones = {
        segment: replace(
            each, places_mm=each.places_mm * factor,
            laboratory_from_bone=RigidTransform(
                each.laboratory_from_bone.rotation, each.laboratory_from_bone.translation * factor
            ),
        )
        for segment, each in posture.bones.items()
    }  # fmt: skip
    return replace(posture, bones=bones)


def mirrored_scan(given: Correspondents) -> Correspondents:
    """Return bones and balls mirrored left to right.

    Args:
        given: Scanner and laboratory.
    """
    scanner = replace(given.scanner, centres_mm=given.scanner.centres_mm * np.array([-1.0, 1.0, 1.0]))
    return replace(given, scanner=scanner, bones={name: mirrored(bone) for name, bone in given.bones.items()})


def _other_sides(named: Sequence[str], labels: Sequence[str]) -> dict[str, str]:
    """Map the names of balls to those of the other side; empty if the laboratory does not have these."""
    pairs = side_pairs(tuple(dict.fromkeys([*named, *labels])))
    other = {name: pairs[name] for name in named if name in pairs}
    return other if set(other.values()) <= set(labels) else {}


def _renamed(given: Correspondents, names: Mapping[str, str]) -> Correspondents:
    renamed = tuple(None if name is None else names.get(name, name) for name in given.scanner.names)
    return replace(given, scanner=replace(given.scanner, names=renamed))


def best_repair(
    given: Correspondents, own: MarkerMisfit | None, settings: MarkerRepairSettings = MARKER_REPAIR_DEFAULTS
) -> tuple[MarkerRepair, MarkerMisfit] | None:
    """Find the repair with which balls and markers correspond.

    Args:
        given: Scanner and laboratory.
        own: Their misfit without a repair; None if they cannot be compared.
        settings: Thresholds.

    Returns:
        The repair and what it achieves; None if they correspond, or if nothing explains that they do not.
    """
    if own is not None and not _suspicious(own, settings):
        return None
    found = []
    for repair in repairs(given):
        after = marker_misfit(repair.repaired, settings)
        if after is not None and _explains(repair.kind, own, after, settings):
            found.append((repair, after))
    if not found:
        return None
    least = min(after.residual_mm for _, after in found)
    alike = [pair for pair in found if pair[1].residual_mm < settings.alike_ratio * least + settings.alike_mm]
    return min(alike, key=lambda pair: np.nan_to_num(pair[1].apart_mm) + np.nan_to_num(pair[1].from_bones_mm))


def _suspicious(own: MarkerMisfit, settings: MarkerRepairSettings) -> bool:
    return bool(
        own.every_mm > settings.least_residual_mm or own.from_bones_mm > settings.usual_from_bones_mm
        or not own.plausible(settings)
    )  # fmt: skip


def _explains(kind: str, own: MarkerMisfit | None, after: MarkerMisfit, settings: MarkerRepairSettings) -> bool:
    """Return whether a repair makes everything that does not fit much better, and nothing worse."""
    if not after.plausible(settings) or after.residual_mm > settings.explained_mm:
        return False
    if own is None:
        return True
    ratio = settings.largest_ratio
    if kind == "axes":
        nearer = own.from_bones_mm > settings.usual_from_bones_mm and after.from_bones_mm < ratio * own.from_bones_mm
        return nearer or (own.turned_round(settings) and after.from_bones_mm < settings.usual_from_bones_mm)
    if kind == "names":
        needed, limit = settings.largest_names_ratio, settings.least_residual_mm
        before, now = own.every_mm, after.every_mm
    else:
        needed, limit = ratio, own.residual_mm / ratio
        before, now = own.residual_mm, after.residual_mm
    fits = before > settings.least_residual_mm and now < needed * before
    together = (own.apart_mm > settings.most_apart_mm and after.apart_mm < ratio * own.apart_mm) or (
        own.turned > settings.most_turned and after.turned < ratio * own.turned
    )
    return fits or (together and now < limit)
