"""Anatomical frames after the ISB from palpated landmarks, with the covariance due to the palpation error.

X points anterior, Y proximal and Z to the right, on both sides of the body ([Wu2002], [Wu2005]).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from marey.arrays import Floats, freeze_fields
from marey.geometry import rotations
from marey.markers.data.clusters import Cluster
from marey.markers.data.trajectories import MarkerTrajectories
from marey.markers.preprocessing.own_frames import BonesAndMarkers
from marey.motion.anatomical import SIDE_PREFIXES

_STEP_M = 1e-5
"""Step of a landmark's coordinate for central differences [m]; numerical, not tuned."""
_STATIC_MOTION_M = 0.01
"""RMS motion of a marker in a static trial above which it is reported [m]. Chosen by hand."""
_KINDS = {
    "pelvis": "pelvis", "thigh": "thigh", "femur": "thigh", "shank": "shank", "tibia": "shank", "foot": "foot",
    "thorax": "thorax", "trunk": "thorax", "upperarm": "upperarm", "humerus": "upperarm", "forearm": "forearm",
}  # fmt: skip
"""Maps the name of a segment, without its side, to the construction of its frame."""
LandmarkPositions = Mapping[str, Floats]
"""Maps the name of a landmark to its position (3,) [m]."""


@dataclass(frozen=True, eq=False, kw_only=True)
class AnatomicalFrame:
    """An anatomical frame of a bone in the laboratory."""

    segment: str
    rotation: Floats
    """(3, 3) laboratory from bone."""
    origin: Floats
    """(3,) [m]."""
    covariance: Floats
    """(6, 6) covariance of rotation about the bone's axes [rad] and origin [m], as `BoneMotion.covariance`."""

    def __post_init__(self) -> None:
        freeze_fields(self, "rotation", "origin", "covariance")


@dataclass(frozen=True, eq=False, kw_only=True)
class AnatomicalFrames:
    """The anatomical frames determined by landmarks, and notes on those that are not."""

    frames: tuple[AnatomicalFrame, ...]
    notes: tuple[str, ...]
    """One sentence for each segment without a frame, and for each departure from the ISB."""
    landmarks: LandmarkPositions = field(default_factory=dict)
    """Positions of the landmarks from which the frames were constructed [m]."""


def anatomical_frames(
    landmarks: LandmarkPositions, segments: Sequence[str], *, landmark_sd_m: float, side: str | None = None
) -> AnatomicalFrames:
    """Construct the anatomical frames of segments from their landmarks.

    Landmarks have the ISB's abbreviations. Those of a limb have the prefix `left_` or `right_` if their segment has it
    (`left_thigh`: `left_HJC`, `left_ME`, `left_LE`; `thigh`: `HJC`, `ME`, `LE`):

    - pelvis: RASIS, LASIS, RPSIS, LPSIS; origin midway between the ASISs;
    - thigh (or femur): HJC the hip's centre, ME and LE the epicondyles; origin the hip's centre;
    - shank (or tibia): MM, LM the malleoli, MC, LC the condyles of the tibia (or ME, LE of the femur); origin midway
      between the malleoli;
    - foot: CA the heel, M1 and M5 the heads of the first and fifth metatarsals; origin the heel. Without them, the
      shank's frame in this posture, which is the paper's own definition if the posture is the neutral one;
    - thorax: IJ, PX, C7, T8; origin IJ;
    - upperarm (or humerus): GH the shoulder's centre, EM, EL the epicondyles; origin GH;
    - forearm: US, RS the styloids, EM, EL; origin US.

    Unlike [Wu2002], the pelvis' origin lies midway between its anterior spines, so that it belongs to neither hip.

    Args:
        landmarks: Maps each landmark to its position (3,) in the laboratory in one posture [m].
        segments: Segments whose frames are wanted.
        landmark_sd_m: Standard deviation of a landmark's coordinate, mainly due to its palpation [m].
        side: `left` or `right`, for limbs whose names do not contain it.

    Returns:
        The frames that the landmarks determine, with notes.
    """
    frames, notes = [], []
    for segment in segments:
        prefix, kind = split_segment(segment)
        if kind is None:
            notes.append(f"{segment}: no anatomical frame is known for a segment of this name.")
            continue
        names, make = _construction(kind, prefix, landmarks)
        missing = [name for name in names if name not in landmarks]
        its_side = prefix.rstrip("_") or side
        if missing:
            notes.append(f"{segment}: no anatomical frame without the landmarks {', '.join(missing)}.")
        elif its_side is None and kind not in ("pelvis", "thorax"):
            notes.append(f"{segment}: no anatomical frame without knowing whether it is the left or the right one.")
        else:
            frames.append(
                _frame_with_covariance(segment, [landmarks[n] for n in names], make, its_side == "left", landmark_sd_m)
            )
            notes += _departures(segment, kind, names)
    return AnatomicalFrames(frames=tuple(frames), notes=tuple(notes), landmarks=dict(landmarks))


def static_bones(
    static: MarkerTrajectories,
    clusters: Sequence[Cluster],
    landmarks: Mapping[str, Sequence[str]],
    *,
    landmark_sd_m: float,
    side: str | None = None,
    further: LandmarkPositions | None = None,
) -> tuple[BonesAndMarkers, AnatomicalFrames]:
    """Determine the bones and their markers in a static trial, for the transfer into another trial.

    Pass the result to `marey.markers.preprocessing.own_frames.transfer_calibration`.

    Args:
        static: A trial in which the person stands still; the mean marker positions are used.
        clusters: Clusters of the other trial.
        landmarks: Maps an anatomical landmark to the marker on it, or to several whose midpoint it is
            (`MarkerSetup.landmarks`).
        landmark_sd_m: Standard deviation of a landmark's coordinate [m].
        side: `left` or `right`, for limbs whose names do not contain it.
        further: Landmarks with a position in the static trial from another source, such as a functional hip centre [m].

    Returns:
        The bones and markers, and the frames with their covariance and notes on what was skipped.

    Raises:
        MareyError: A landmark names a marker that the static trial does not have.
    """
    place, notes = _mean_places(static)
    index = {label: m for m, label in enumerate(static.labels)}
    palpated = {}
    for name, labels in landmarks.items():
        static.select(labels)  # raises an error that names a missing label
        palpated[name] = np.asarray(place[[index[label] for label in labels]].mean(0))
    unseen = [name for name, at in palpated.items() if not np.isfinite(at).all()]
    notes += [f"The landmark {name} is not visible in any frame of the static trial." for name in unseen]
    known = {name: at for name, at in palpated.items() if name not in unseen} | dict(further or {})
    segments = [cluster.segment for cluster in clusters]
    found = anatomical_frames(known, segments, landmark_sd_m=landmark_sd_m, side=side)
    bones = BonesAndMarkers(
        segments=tuple(frame.segment for frame in found.frames),
        rotation=np.array([frame.rotation for frame in found.frames]).reshape(-1, 3, 3),
        origin=np.array([frame.origin for frame in found.frames]).reshape(-1, 3),
        labels=static.labels, points=place,
    )  # fmt: skip
    return bones, AnatomicalFrames(frames=found.frames, notes=(*notes, *found.notes), landmarks=known)


def _mean_places(static: MarkerTrajectories) -> tuple[Floats, list[str]]:
    """Return the markers' mean positions (M, 3) [m], and a note if one did not stay still."""
    known = np.isfinite(static.points)
    count = np.maximum(known.sum(0), 1)
    mean = np.where(known.any(0), np.where(known, static.points, 0).sum(0) / count, np.nan)
    moved = np.sqrt(np.where(known, (static.points - mean) ** 2, 0).sum((0, 2)) / count[:, 0])
    worst = int(np.argmax(moved))
    if moved[worst] <= _STATIC_MOTION_M:
        return mean, []
    return mean, [f"In the static trial {static.labels[worst]} moves by {1e3 * moved[worst]:.0f} mm (RMS)."]


def split_segment(segment: str) -> tuple[str, str | None]:
    """Split a segment's name into its side prefix (`left_`) and the kind of its frame; None if unknown.

    Args:
        segment: Name of a segment, such as `left_femur`.
    """
    prefix = next((side for side in SIDE_PREFIXES if segment.startswith(side)), "")
    return prefix, _KINDS.get(segment.removeprefix(prefix))


FrameConstruction = Callable[[Floats, bool], tuple[Floats, Floats]]
"""Computes rotation and origin from landmarks (L, 3) and whether the side is the left one."""


def _construction(kind: str, prefix: str, landmarks: LandmarkPositions) -> tuple[list[str], FrameConstruction]:
    """Return the names of a segment's landmarks and the construction of its frame."""
    if kind == "foot" and f"{prefix}CA" not in landmarks:
        kind = "shank"
    names, make = _CONSTRUCTIONS[kind]
    if kind == "shank" and f"{prefix}MC" not in landmarks:
        names = ("MM", "LM", "ME", "LE")
    return [name if kind in ("pelvis", "thorax") else prefix + name for name in names], make


def _departures(segment: str, kind: str, names: Sequence[str]) -> list[str]:
    if kind == "foot" and len(names) == 4:
        return [f"{segment}: the shank's frame in the static posture is used, as if this were the neutral posture."]
    if kind == "shank" and names[2].endswith("ME"):
        return [f"{segment}: the knee's midpoint is that of the femur's epicondyles; the tibia's condyles are missing."]
    return []


def _frame_with_covariance(
    segment: str, places: Sequence[Floats], make: FrameConstruction, left: bool, sd_m: float
) -> AnatomicalFrame:
    """Construct a frame and propagate the landmarks' standard deviation by central differences."""
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
    """Z along the ASISs; X in their plane with the PSISs' midpoint ([Wu2002])."""
    right_asis, left_asis, right_psis, left_psis = at
    middle = (right_asis + left_asis) / 2
    return _axes(z=right_asis - left_asis, x_near=middle - (right_psis + left_psis) / 2), middle


def _thigh(at: Floats, left: bool) -> tuple[Floats, Floats]:
    """Y from the epicondyles' midpoint to the hip; Z in the plane of hip and epicondyles ([Wu2002])."""
    hip, medial, lateral = at
    return _axes(y=hip - (medial + lateral) / 2, z_near=_rightward(medial, lateral, left)), hip


def _shank(at: Floats, left: bool) -> tuple[Floats, Floats]:
    """Z along the malleoli; X perpendicular to the plane of malleoli and condyles' midpoint ([Wu2002])."""
    medial, lateral, medial_condyle, lateral_condyle = at
    middle = (medial + lateral) / 2
    up = (medial_condyle + lateral_condyle) / 2 - middle
    return _axes(z=_rightward(medial, lateral, left), y_near=up), middle


def _foot(at: Floats, left: bool) -> tuple[Floats, Floats]:
    """X from the heel to the metatarsal heads' midpoint; Z in the plane of the three."""
    heel, first, fifth = at
    x = (first + fifth) / 2 - heel
    y = np.cross(_rightward(first, fifth, left), x)
    return _axes(y=y, x_near=x), heel


def _thorax(at: Floats, left: bool) -> tuple[Floats, Floats]:
    """Y from the midpoint of PX and T8 to that of IJ and C7; Z perpendicular to their plane ([Wu2005])."""
    notch, process, c7, t8 = at
    low = (process + t8) / 2
    y = (notch + c7) / 2 - low
    return _axes(y=y, z_near=np.cross(notch - low, c7 - low)), notch


def _upperarm(at: Floats, left: bool) -> tuple[Floats, Floats]:
    """Y from the epicondyles' midpoint to GH; X perpendicular to the plane of the three ([Wu2005])."""
    shoulder, medial, lateral = at
    return _axes(y=shoulder - (medial + lateral) / 2, z_near=_rightward(medial, lateral, left)), shoulder


def _forearm(at: Floats, left: bool) -> tuple[Floats, Floats]:
    """Y from US to the epicondyles' midpoint; X perpendicular to the plane with RS ([Wu2005])."""
    ulnar, radial, medial, lateral = at
    return _axes(y=(medial + lateral) / 2 - ulnar, z_near=_rightward(ulnar, radial, left)), ulnar


_CONSTRUCTIONS: dict[str, tuple[tuple[str, ...], FrameConstruction]] = {
    "pelvis": (("RASIS", "LASIS", "RPSIS", "LPSIS"), _pelvis),
    "thigh": (("HJC", "ME", "LE"), _thigh),
    "shank": (("MM", "LM", "MC", "LC"), _shank),
    "foot": (("CA", "M1", "M5"), _foot),
    "thorax": (("IJ", "PX", "C7", "T8"), _thorax),
    "upperarm": (("GH", "EM", "EL"), _upperarm),
    "forearm": (("US", "RS", "EM", "EL"), _forearm),
}
"""Maps a kind of segment to its landmarks and the construction of its frame, after the ISB ([Wu2002], [Wu2005])."""


def _rightward(medial: Floats, lateral: Floats, left: bool) -> Floats:
    """Return the direction to the person's right from a medial and a lateral landmark."""
    return medial - lateral if left else lateral - medial


def _axes(
    *, y: Floats | None = None, z: Floats | None = None, x_near: Floats | None = None, y_near: Floats | None = None,
    z_near: Floats | None = None,
) -> Floats:  # fmt: skip
    """Construct axes (3, 3) from a fixed direction, Y or Z, and a direction that spans a plane with it."""
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
