"""Anatomical frames after the ISB from palpated landmarks, with the covariance that the palpation leaves.

X points anterior, Y proximal and Z to the right, on both sides of the body ([Wu2002], [Wu2005]).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, freeze_fields
from marey.geometry import rotations
from marey.markers.data.clusters import Cluster
from marey.markers.data.trajectories import MarkerTrajectories
from marey.markers.preprocessing.own_frames import BonesAndMarkers

_STEP_M = 1e-5
_STILL_M = 0.01
_KINDS = {
    "pelvis": "pelvis", "thigh": "thigh", "femur": "thigh", "shank": "shank", "tibia": "shank", "foot": "foot",
    "thorax": "thorax", "trunk": "thorax", "upperarm": "upperarm", "humerus": "upperarm", "forearm": "forearm",
}  # fmt: skip
Places = Mapping[str, Floats]


@dataclass(frozen=True, eq=False, kw_only=True)
class AnatomicalFrame:
    """A bone's frame in the laboratory."""

    segment: str
    rotation: Floats
    """(3, 3) laboratory from bone."""
    origin: Floats
    """(3,) [m]."""
    covariance: Floats
    """(6, 6) of the turn about the bone's axes [rad] and of the origin [m], as `BoneMotion.covariance`."""

    def __post_init__(self) -> None:
        freeze_fields(self, "rotation", "origin", "covariance")


@dataclass(frozen=True, eq=False, kw_only=True)
class FoundFrames:
    """The anatomical frames that the landmarks give, and what they do not."""

    frames: tuple[AnatomicalFrame, ...]
    notes: tuple[str, ...]
    """A plain sentence for each segment without a frame, and for each departure from the ISB."""


def anatomical_frames(
    landmarks: Places, segments: Sequence[str], *, landmark_sd_m: float, side: str | None = None
) -> FoundFrames:
    """Make the frames of segments from their landmarks.

    Landmarks carry the ISB's abbreviations, those of a limb with `left_` or `right_` before them where their segment
    has it (`left_thigh`: `left_HJC`, `left_ME`, `left_LE`; `thigh`: `HJC`, `ME`, `LE`):

    - pelvis: RASIS, LASIS, RPSIS, LPSIS; origin midway between the ASISs;
    - thigh (or femur): HJC the hip's centre, ME and LE the epicondyles; origin the hip's centre;
    - shank (or tibia): MM, LM the malleoli, MC, LC the condyles of the tibia (or ME, LE of the femur); origin midway
      between the malleoli;
    - foot: CA the heel, M1 and M5 the heads of the first and fifth metatarsals; origin the heel. Without them, the
      shank's frame in this posture, which is the paper's own definition where the posture is the neutral one;
    - thorax: IJ, PX, C7, T8; origin IJ;
    - upperarm (or humerus): GH the shoulder's centre, EM, EL the epicondyles; origin GH;
    - forearm: US, RS the styloids, EM, EL; origin US.

    Unlike [Wu2002], the pelvis' origin lies midway between its anterior spines, so that it belongs to neither hip.

    Args:
        landmarks: Name to place (3,) in the laboratory in one posture [m].
        segments: Those that a frame is wanted for.
        landmark_sd_m: Standard deviation of a landmark's coordinate, mainly of its palpation [m].
        side: `left` or `right`, of limbs whose names do not tell.
    """
    frames, notes = [], []
    for segment in segments:
        prefix, kind = _kind(segment)
        if kind is None:
            notes.append(f"{segment}: no anatomical frame is known for a segment of this name.")
            continue
        names, make = _recipe(kind, prefix, landmarks)
        missing = [name for name in names if name not in landmarks]
        its_side = prefix.rstrip("_") or side
        if missing:
            notes.append(f"{segment}: no anatomical frame without the landmarks {', '.join(missing)}.")
        elif its_side is None and kind not in ("pelvis", "thorax"):
            notes.append(f"{segment}: no anatomical frame without knowing whether it is the left or the right one.")
        else:
            frames.append(_frame(segment, [landmarks[n] for n in names], make, its_side == "left", landmark_sd_m))
            notes += _departures(segment, kind, names)
    return FoundFrames(frames=tuple(frames), notes=tuple(notes))


def static_bones(
    static: MarkerTrajectories,
    clusters: Sequence[Cluster],
    landmarks: Mapping[str, Sequence[str]],
    *,
    landmark_sd_m: float,
    side: str | None = None,
    further: Places | None = None,
) -> tuple[BonesAndMarkers, FoundFrames]:
    """Find the bones in a static trial, with the markers that ride on them, to be carried into another trial.

    Give the result to `marey.markers.preprocessing.own_frames.carried_calibration`.

    Args:
        static: A trial in which the person stands still; the markers' mean places are taken.
        clusters: Of the other trial.
        landmarks: Anatomical landmark to the marker on it, or to several whose middle it is (`MarkerSetup.landmarks`).
        landmark_sd_m: Standard deviation of a landmark's coordinate [m].
        side: `left` or `right`, of limbs whose names do not tell.
        further: Landmarks whose place in the static trial is known otherwise, such as a functional hip centre [m].

    Returns:
        The bones and markers, and the frames with their covariance and what was passed over.

    Raises:
        MareyError: A landmark names a marker that the static trial does not have.
    """
    place, notes = _mean_places(static)
    index = {label: m for m, label in enumerate(static.labels)}
    palpated = {}
    for name, labels in landmarks.items():
        static.select(labels)  # says which label is missing
        palpated[name] = np.asarray(place[[index[label] for label in labels]].mean(0))
    unseen = [name for name, at in palpated.items() if not np.isfinite(at).all()]
    notes += [f"The landmark {name} is in no frame of the static trial." for name in unseen]
    known = {name: at for name, at in palpated.items() if name not in unseen} | dict(further or {})
    segments = [cluster.segment for cluster in clusters]
    found = anatomical_frames(known, segments, landmark_sd_m=landmark_sd_m, side=side)
    bones = BonesAndMarkers(
        segments=tuple(frame.segment for frame in found.frames),
        rotation=np.array([frame.rotation for frame in found.frames]).reshape(-1, 3, 3),
        origin=np.array([frame.origin for frame in found.frames]).reshape(-1, 3),
        labels=static.labels, points=place,
    )  # fmt: skip
    return bones, FoundFrames(frames=found.frames, notes=(*notes, *found.notes))


def _mean_places(static: MarkerTrajectories) -> tuple[Floats, list[str]]:
    """Give the markers' mean places (M, 3), and say so where they did not stand still."""
    known = np.isfinite(static.points)
    count = np.maximum(known.sum(0), 1)
    mean = np.where(known.any(0), np.where(known, static.points, 0).sum(0) / count, np.nan)
    moved = np.sqrt(np.where(known, (static.points - mean) ** 2, 0).sum((0, 2)) / count[:, 0])
    worst = int(np.argmax(moved))
    if moved[worst] <= _STILL_M:
        return mean, []
    return mean, [f"In the static trial {static.labels[worst]} moves by {1e3 * moved[worst]:.0f} mm (RMS)."]


def _kind(segment: str) -> tuple[str, str | None]:
    """Split a segment's name into its side, with the line after it, and its kind."""
    prefix = next((side for side in ("left_", "right_") if segment.startswith(side)), "")
    return prefix, _KINDS.get(segment.removeprefix(prefix))


Make = Callable[[Floats, bool], tuple[Floats, Floats]]
"""Landmarks (L, 3) and whether it is the left side to rotation and origin."""


def _recipe(kind: str, prefix: str, landmarks: Places) -> tuple[list[str], Make]:
    """Give the names of a segment's landmarks and how its frame is made of them."""
    if kind == "foot" and f"{prefix}CA" not in landmarks:
        kind = "shank"
    names, make = _RECIPES[kind]
    if kind == "shank" and f"{prefix}MC" not in landmarks:
        names = ("MM", "LM", "ME", "LE")
    return [name if kind in ("pelvis", "thorax") else prefix + name for name in names], make


def _departures(segment: str, kind: str, names: Sequence[str]) -> list[str]:
    if kind == "foot" and len(names) == 4:
        return [f"{segment}: takes the shank's frame of the static posture, as in the neutral one."]
    if kind == "shank" and names[2].endswith("ME"):
        return [f"{segment}: the knee's middle is that of the femur's epicondyles; the tibia's condyles are not given."]
    return []


def _frame(segment: str, places: Sequence[Floats], make: Make, left: bool, sd_m: float) -> AnatomicalFrame:
    """Make a frame and carry the landmarks' standard deviation to it by differences."""
    at = np.asarray(places, float)
    rotation, origin = make(at, left)
    jacobian = np.zeros((6, at.size))
    for n in range(at.size):
        step = np.zeros(at.size)
        step[n] = _STEP_M
        ahead, behind = make(at + step.reshape(at.shape), left), make(at - step.reshape(at.shape), left)
        jacobian[:3, n] = rotations.log(behind[0].T @ ahead[0]) / (2 * _STEP_M)
        jacobian[3:, n] = (ahead[1] - behind[1]) / (2 * _STEP_M)
    return AnatomicalFrame(
        segment=segment, rotation=rotation, origin=origin, covariance=sd_m**2 * jacobian @ jacobian.T
    )


def _pelvis(at: Floats, left: bool) -> tuple[Floats, Floats]:
    """Z along the ASISs; X in their plane with the PSISs' middle ([Wu2002])."""
    right_asis, left_asis, right_psis, left_psis = at
    middle = (right_asis + left_asis) / 2
    return _axes(z=right_asis - left_asis, x_near=middle - (right_psis + left_psis) / 2), middle


def _thigh(at: Floats, left: bool) -> tuple[Floats, Floats]:
    """Y from the epicondyles' middle to the hip; Z in the plane of hip and epicondyles ([Wu2002])."""
    hip, medial, lateral = at
    return _axes(y=hip - (medial + lateral) / 2, z_near=_rightward(medial, lateral, left)), hip


def _shank(at: Floats, left: bool) -> tuple[Floats, Floats]:
    """Z along the malleoli; X square to the plane of malleoli and condyles' middle ([Wu2002])."""
    medial, lateral, medial_condyle, lateral_condyle = at
    middle = (medial + lateral) / 2
    up = (medial_condyle + lateral_condyle) / 2 - middle
    return _axes(z=_rightward(medial, lateral, left), y_near=up), middle


def _foot(at: Floats, left: bool) -> tuple[Floats, Floats]:
    """X from the heel to the metatarsal heads' middle; Z in the plane of the three."""
    heel, first, fifth = at
    x = (first + fifth) / 2 - heel
    y = np.cross(_rightward(first, fifth, left), x)
    return _axes(y=y, x_near=x), heel


def _thorax(at: Floats, left: bool) -> tuple[Floats, Floats]:
    """Y from the middle of PX and T8 to that of IJ and C7; Z square to their plane ([Wu2005])."""
    notch, process, c7, t8 = at
    low = (process + t8) / 2
    y = (notch + c7) / 2 - low
    return _axes(y=y, z_near=np.cross(notch - low, c7 - low)), notch


def _upperarm(at: Floats, left: bool) -> tuple[Floats, Floats]:
    """Y from the epicondyles' middle to GH; X square to the plane of the three ([Wu2005])."""
    shoulder, medial, lateral = at
    return _axes(y=shoulder - (medial + lateral) / 2, z_near=_rightward(medial, lateral, left)), shoulder


def _forearm(at: Floats, left: bool) -> tuple[Floats, Floats]:
    """Y from US to the epicondyles' middle; X square to the plane with RS ([Wu2005])."""
    ulnar, radial, medial, lateral = at
    return _axes(y=(medial + lateral) / 2 - ulnar, z_near=_rightward(ulnar, radial, left)), ulnar


_RECIPES: dict[str, tuple[tuple[str, ...], Make]] = {
    "pelvis": (("RASIS", "LASIS", "RPSIS", "LPSIS"), _pelvis),
    "thigh": (("HJC", "ME", "LE"), _thigh),
    "shank": (("MM", "LM", "MC", "LC"), _shank),
    "foot": (("CA", "M1", "M5"), _foot),
    "thorax": (("IJ", "PX", "C7", "T8"), _thorax),
    "upperarm": (("GH", "EM", "EL"), _upperarm),
    "forearm": (("US", "RS", "EM", "EL"), _forearm),
}


def _rightward(medial: Floats, lateral: Floats, left: bool) -> Floats:
    """Give the direction to the person's right from a medial and a lateral landmark."""
    return medial - lateral if left else lateral - medial


def _axes(
    *, y: Floats | None = None, z: Floats | None = None, x_near: Floats | None = None, y_near: Floats | None = None,
    z_near: Floats | None = None,
) -> Floats:  # fmt: skip
    """Make axes (3, 3) from one direction, Y or Z, that is kept, and one in whose plane with it another lies."""
    if y is not None:
        y = y / np.linalg.norm(y)
        x = np.cross(y, z_near) if z_near is not None else x_near - y * (y @ x_near)  # type: ignore[operator]
        x = x / np.linalg.norm(x)
        return np.stack([x, y, np.cross(x, y)], -1)
    assert z is not None
    z = z / np.linalg.norm(z)
    x = np.cross(y_near, z) if y_near is not None else x_near - z * (z @ x_near)  # type: ignore[operator]
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], -1)
