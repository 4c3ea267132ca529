"""Landmarks and joint centres of a person whose markers are those of a known set, in one posture."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats
from marey.errors import MareyError
from marey.markers.data.clusters import MINIMUM_MARKERS, Cluster
from marey.markers.data.marker_set_tables import MarkerSet, plain_label
from marey.markers.data.person import AssumedMeasurement, PersonMeasurements, assumed_text
from marey.markers.data.rigid_fit import EQUAL_SD_M, fit_rigid
from marey.markers.data.trajectories import MarkerTrajectories
from marey.markers.preprocessing.joint_centres import chord_centre, harrington_hip_centre
from marey.wording import listed

_SIDES = ("left", "right")
"""Names of the body's sides."""
PELVIS_LANDMARKS = ("RASIS", "LASIS", "RPSIS", "LPSIS")
"""Landmarks of the pelvis, all of which are needed."""
_HALF_FOOT_M = 0.04
"""Distance of the two points beside the toe marker that stand for the heads of the first and fifth metatarsals [m].
Only their direction matters; chosen by hand."""
_WIDTHS = (("ME", "knee_width"), ("MM", "ankle_width"))
"""Medial landmarks, and the width that replaces each."""
_MM = 1e3
"""Millimetres in a metre."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SetLandmarks:
    """Landmarks and joint centres in one posture."""

    places: Mapping[str, Floats]
    """Maps landmarks (`left_LE`) and centres of joints (`left_HJC`, `left_KJC`, ...) to places (3,) [m]."""
    notes: tuple[str, ...]
    """How the joint centres were found, one sentence each."""
    assumed: tuple[AssumedMeasurement, ...] = ()
    """Measurements that the centres need and nothing states."""


def landmarks_of_set(
    known: MarkerSet, at: Mapping[str, Floats], person: PersonMeasurements, *, up: Floats, standing: bool,
    centres: Mapping[str, Floats] | None = None,
) -> SetLandmarks:  # fmt: skip
    """Find the landmarks and joint centres of a person with a known marker set.

    The hip is given, a marker of the set, or predicted from the pelvis ([Harrington2007]). Knee and ankle are midway
    between the lateral and the medial marker; without a medial marker they follow from the width of the joint by the
    chord function ([Davis1991]), and the medial landmark is the lateral one reflected at the centre. A width or a
    diameter of the markers that is needed and unknown is assumed (`PersonMeasurements.width`). A foot with one marker
    on the toes has its axis from heel to toe: horizontal, with Y up, in a person who stands; otherwise as it is, with Z
    along the ankle's axis.

    Args:
        known: The marker set.
        at: Maps the plain labels that are visible (`plain_label`) to places (3,) in the laboratory [m].
        person: Measurements of the person.
        up: (3,) upward direction.
        standing: Whether the person stands, with flat feet.
        centres: Maps centres of joints that are known otherwise (`left_HJC`) to places (3,) [m].

    Returns:
        The landmarks of the pelvis and of the legs that have all of theirs.

    Raises:
        MareyError: Markers of the pelvis or of both legs are missing, or of the plane in which a joint's centre lies.
    """
    places = _marked(known, at) | dict(centres or {})
    lacking = [name for name in PELVIS_LANDMARKS if name not in places]
    if lacking:
        raise MareyError(f"Markers of the pelvis are missing: {listed(_wanted(known, lacking))}.")
    notes: list[str] = []
    whole = []
    assumed = _assumed(known, places, person)
    if assumed:
        what = assumed_text(assumed)
        notes.append(f"Assumed, because nothing states it, and part of the standard deviations: {what}.")
    person = person.with_assumed(assumed)
    for side in _SIDES:
        missing = [f"{side}_{name}" for name in ("LE", "LM") if f"{side}_{name}" not in places]
        if missing:
            notes.append(f"The {side} leg is left out without {listed(_wanted(known, missing))}.")
            places = {name: place for name, place in places.items() if not name.startswith(side)}
            continue
        whole.append(side)
        notes += _add_leg(side, places, known, at, person)
        if f"{side}_CA" in places and f"{side}_TOE" in places and f"{side}_M1" not in places:
            _add_toes(side, places, up, standing=standing)
    if not whole:
        raise MareyError(" ".join(notes))
    return SetLandmarks(places=places, notes=tuple(notes), assumed=assumed)


def _assumed(
    known: MarkerSet, places: Mapping[str, Floats], person: PersonMeasurements
) -> tuple[AssumedMeasurement, ...]:
    """Return what the centres need and nothing states: widths without a medial marker, and the markers' diameter."""
    legs = [side for side in _SIDES if f"{side}_LE" in places and f"{side}_LM" in places]
    wanted = [(side, width) for side in legs for medial, width in _WIDTHS if f"{side}_{medial}" not in places]
    sizes = [person.width(side, width) for side, width in wanted]
    if wanted or any(f"{side}_HJC" not in places for side in legs):
        sizes.append(person.diameter())
    return tuple(size for size in sizes if isinstance(size, AssumedMeasurement))


def _marked(known: MarkerSet, at: Mapping[str, Floats]) -> dict[str, Floats]:
    """Return the landmarks that markers show: for each the first alternative all of whose labels are visible."""
    places = {}
    for name, choices in known.landmarks.items():
        for labels in choices:
            if all(plain_label(label) in at for label in labels):
                places[name] = np.mean([at[plain_label(label)] for label in labels], 0)
                break
    return places


def _wanted(known: MarkerSet, landmarks: list[str]) -> list[str]:
    """Return the first choice of labels for each landmark."""
    return list(dict.fromkeys(label for name in landmarks for label in known.landmarks[name][0]))


def _add_leg(
    side: str, places: dict[str, Floats], known: MarkerSet, at: Mapping[str, Floats], person: PersonMeasurements
) -> Iterator[str]:
    """Add the centres of hip, knee and ankle, and the medial landmarks; yield how they were found."""
    if f"{side}_HJC" not in places:
        places[f"{side}_HJC"], note = _hip(side, places, person)
        yield note
    yield from _add_centre(side, ("KJC", "LE", "ME", "knee_width"), "HJC", places, known, at, person)
    yield from _add_centre(side, ("AJC", "LM", "MM", "ankle_width"), "KJC", places, known, at, person)


def _hip(side: str, places: Mapping[str, Floats], person: PersonMeasurements) -> tuple[Floats, str]:
    """Predict the centre of a hip."""
    right, left, back = places["RASIS"], places["LASIS"], (places["RPSIS"] + places["LPSIS"]) / 2
    assert person.diameter_m is not None
    middle, diameter = (right + left) / 2, person.diameter_m
    z = (right - left) / np.linalg.norm(right - left)
    x = middle - back
    x = x - z * (x @ z)
    axes = np.stack([x / np.linalg.norm(x), np.cross(z, x / np.linalg.norm(x)), z], -1)
    depth, width = float(np.linalg.norm(middle - back)) - diameter, float(np.linalg.norm(right - left))
    given = person.length(side, "leg_length")
    chain = [places["LASIS" if side == "left" else "RASIS"], places[f"{side}_LE"], places[f"{side}_LM"]]
    length = float(np.linalg.norm(np.diff(chain, axis=0), axis=1).sum()) if given is None else given
    centre = harrington_hip_centre(depth, width, length, left=side == "left")
    source = "from the markers" if given is None else "as given"
    note = (
        f"The {side} hip centre is predicted from the pelvis: depth {_MM * depth:.0f} mm, width {_MM * width:.0f} mm, "
        f"leg length {_MM * length:.0f} mm {source}."
    )
    return middle + axes @ (centre - np.array([diameter / 2, 0.0, 0.0])), note


def _add_centre(
    side: str, names: tuple[str, str, str, str], proximal: str, places: dict[str, Floats], known: MarkerSet,
    at: Mapping[str, Floats], person: PersonMeasurements,
) -> Iterator[str]:  # fmt: skip
    """Add the centre of a knee or an ankle, and the medial landmark; yield how it was found."""
    centre, lateral, medial = (f"{side}_{name}" for name in names[:3])
    if medial in places:
        places[centre] = (places[lateral] + places[medial]) / 2
        return
    width, plane = person.length(side, names[3]), known.planes.get(centre, "")
    joint = f"{side} {names[3].removesuffix('_width')}"
    if plain_label(plane) not in at:
        wanted = [label for choice in known.landmarks.get(medial, ()) for label in choice]
        other = f" or {plane}" if plane else ""
        where = "in the posture of the landmarks, such as a static trial"
        raise MareyError(
            f"The centre of the {joint} needs a marker on its medial side ({listed(wanted)}){other} {where}."
        )
    assert width is not None
    assert person.diameter_m is not None
    distance = (width + person.diameter_m) / 2
    try:
        places[centre] = chord_centre(places[f"{side}_{proximal}"], places[lateral], at[plain_label(plane)], distance)
    except MareyError as problem:
        raise MareyError(f"The centre of the {joint} is unknown: {problem}") from None
    places[medial] = 2 * places[centre] - places[lateral]
    yield (
        f"The centre of the {joint} is {_MM * distance:.1f} mm from its lateral marker: half the width of "
        f"{_MM * width:.0f} mm and half a marker."
    )


def _add_toes(side: str, places: dict[str, Floats], up: Floats, *, standing: bool) -> None:
    """Add points beside the toe marker, so that the foot's frame has its X from heel to toe."""
    heel, toe = places[f"{side}_CA"], places[f"{side}_TOE"]
    if standing:
        heel = heel + up * ((toe - heel) @ up)
        outward = np.cross(toe - heel, up)
    else:
        axis, along = places[f"{side}_LM"] - places[f"{side}_MM"], toe - heel
        outward = (axis - along * (axis @ along) / (along @ along)) * (1.0 if side == "right" else -1.0)
    aside = _HALF_FOOT_M * outward / np.linalg.norm(outward)
    to_fifth = aside if side == "right" else -aside
    places |= {f"{side}_CA": heel, f"{side}_M1": toe - to_fifth, f"{side}_M5": toe + to_fifth}


@dataclass(frozen=True, eq=False, kw_only=True)
class CentredTrial:
    """A trial to which joint centres were added that follow the bones above them."""

    trajectories: MarkerTrajectories
    clusters: tuple[Cluster, ...]
    """Segments with at least three points; those with fewer markers have the centre of their proximal joint."""
    added: tuple[str, ...]
    """Labels of the joint centres in the trajectories, such as `left_HJC`."""


_CHAIN = (("pelvis", "thigh", "HJC"), ("thigh", "shank", "KJC"), ("shank", "foot", "AJC"))
"""Segment above, segment below, and the joint centre between them."""


def with_joint_centres(
    trial: MarkerTrajectories, segments: Mapping[str, tuple[str, ...]], standing: Mapping[str, Floats],
    places: Mapping[str, Floats],
) -> CentredTrial:  # fmt: skip
    """Let joint centres follow the bones above them, for segments that have fewer than three markers of their own.

    Args:
        trial: The trial.
        segments: Maps each segment to the labels of its markers in the trial.
        standing: Maps labels to places (3,) in the posture in which the centres are known [m].
        places: The joint centres in that posture.

    Returns:
        The trial with these centres, and its segments.
    """
    own = {name: tuple(x for x in labels if x in standing) for name, labels in segments.items()}
    paths: dict[str, Floats] = {}
    for side in _SIDES:
        for above, below, joint in _CHAIN:
            upper = above if above == "pelvis" else f"{side}_{above}"
            lower, centre = f"{side}_{below}", f"{side}_{joint}"
            few = 0 < len(own.get(lower, ())) < MINIMUM_MARKERS
            if few and centre in places and len(own.get(upper, ())) >= MINIMUM_MARKERS:
                shape = [places[x] if x in paths else standing[x] for x in own[upper]]
                points = [paths[x] if x in paths else trial.select([x]).points[:, 0] for x in own[upper]]
                fit = fit_rigid(np.stack(shape), np.stack(points, 1), EQUAL_SD_M)
                paths[centre] = fit.rotation @ places[centre] + fit.translation
                own[lower] = (*own[lower], centre)
    clusters = tuple(
        Cluster(segment=name, labels=x, computed=tuple(label for label in x if label in paths))
        for name, x in own.items()
        if len(x) >= MINIMUM_MARKERS
    )
    return CentredTrial(trajectories=trial.with_points(paths), clusters=clusters, added=tuple(paths))
