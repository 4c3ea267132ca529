"""A person for OpenSim: joint centres, motion of the segments about them, and masses, from results of a recording."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.body.articulation.model_scaling import JointPlaces
from marey.body.articulation.skeleton import JOINT_OF_SEGMENT
from marey.body.articulation.surface import Body
from marey.body.people.mass import estimated_mass
from marey.errors import FileProblem
from marey.io.axes import OPENSIM_FROM_WORLD
from marey.io.markers.bones import RUN_AGAIN
from marey.io.markers.c3d import open_c3d, y_points_up
from marey.io.markers.reading_results import read_static_landmarks
from marey.io.opensim.osim_model import read_osim
from marey.io.opensim.osim_scaling import body_masses
from marey.io.results.body import read_body
from marey.io.results.gait import read_event_csv
from marey.io.run_files import records_in
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.kinematics.model_placement import StandingPosture
from marey.markers.preprocessing.landmarks import anatomical_frames
from marey.motion.anatomical import anatomy_of
from marey.motion.events.cycles import GaitEvent
from marey.motion.motion import BodyMotion
from marey.pipelines.capture.motion import load_motion, motion_file
from marey.pipelines.markers.bones import Bones, load_bones

_BONES, _LANDMARKS = "bones.npz", "landmarks.csv"
"""Files of `marey markers`."""
_HIPS = ("left_hip", "right_hip")
"""Joint centres in whose middle the pelvis has its origin."""
_ESTIMATED = "body_with_estimated_mass"
"""Name of the model in `body.osim` whose mass was estimated."""
_SEGMENTS = {"femur": "thigh", "tibia": "shank", "humerus": "upperarm", "trunk": "thorax"}
"""Our name of a segment, without its side, by another that `marey markers` accepts."""
_CENTRES = {
    "hip": (("HJC",),), "knee": (("KJC",), ("LE", "ME")), "ankle": (("AJC",), ("LM", "MM")), "toe": (("M1", "M5"),),
    "shoulder": (("GH",),), "elbow": (("EJC",), ("EL", "EM")), "wrist": (("WJC",), ("US", "RS")),
}  # fmt: skip
"""Landmarks whose mean is a joint centre: the first choice that is known."""


@dataclass(frozen=True, kw_only=True)
class PersonMass:
    """The mass of a person."""

    mass_kg: float
    sd: float
    """Standard deviation [kg]; NaN if it was given."""
    source: str
    """Where it comes from, as a phrase."""


@dataclass(frozen=True, eq=False, kw_only=True)
class OpenSimPerson:
    """What OpenSim needs of a person and a recording."""

    reference: StandingPosture
    """The person, standing about straight, in OpenSim's ground (Y up)."""
    motion: BoneMotion
    """Segments over the F frames, in OpenSim's ground: rotation of the anatomical axes (X anterior, Y proximal, Z
    right), and as origin the centre about which the segment rotates; of the pelvis the middle of the hips."""
    time: Floats
    """(F,) [s]."""
    rate: float
    """Sampling rate [Hz]."""
    mass: PersonMass | None
    """None if it is unknown."""
    segment_masses: Mapping[str, float]
    """Masses of the segments [kg]; empty if unknown."""
    events: tuple[GaitEvent, ...]
    """Foot strikes and foot offs, if there are any."""

    @property
    def joints(self) -> JointPlaces:
        """Joint centres in the reference posture."""
        return self.reference.joints


def person_of(results: Path, *, mass_kg: float | None) -> OpenSimPerson:
    """Read a person from the results of `marey capture`, `marey shape` or `marey markers`.

    Args:
        results: The folder.
        mass_kg: Mass of the person [kg]; None for that of the results, if they have one.

    Raises:
        FileProblem: The results lack a file, or the joint centres are unknown.
    """
    given = None if mass_kg is None else PersonMass(mass_kg=mass_kg, sd=float("nan"), source="given")
    if (results / _BONES).is_file():
        return _from_bones(results, load_bones(results), given)
    return _from_body(motion_file(results), given)


def _from_body(file: Path, given: PersonMass | None) -> OpenSimPerson:
    """Read a captured person."""
    folder, captured = file.parent, load_motion(file)
    motion, (body, _) = captured.data, read_body(folder / "body.npz")
    mass, segments = _captured_mass(folder, body, given)
    table = folder / "events.csv"
    return OpenSimPerson(
        reference=_rest(body), motion=_in_ground(_anatomical_motion(body, motion), OPENSIM_FROM_WORLD),
        time=motion.time, rate=motion.rate, mass=mass, segment_masses=segments,
        events=read_event_csv(table) if table.is_file() else (),
    )  # fmt: skip


def _rest(body: Body) -> StandingPosture:
    """Return the body at rest."""
    names, turn = body.skeleton.segment_names, OPENSIM_FROM_WORLD
    joints = _in_ground_places(_joints_of_body(body), turn)
    origin = body.joint_centres @ turn.T
    if set(_HIPS) <= set(joints.names) and "pelvis" in names:
        origin[names.index("pelvis")] = np.mean([joints.places[joints.names.index(name)] for name in _HIPS], 0)
    return StandingPosture(
        joints=joints, segments=names, rotation=turn @ anatomy_of(body.skeleton, body.joint_centres).frames,
        origin=origin, own_feet=True,
    )  # fmt: skip


def _in_ground_places(joints: JointPlaces, turn: Floats) -> JointPlaces:
    """Rotate joint centres (3, 3) into OpenSim's ground."""
    each = np.kron(np.eye(len(joints.names)), turn)
    return JointPlaces(names=joints.names, places=joints.places @ turn.T, covariance=each @ joints.covariance @ each.T)


def _in_ground(motion: BoneMotion, turn: Floats) -> BoneMotion:
    """Rotate segments (3, 3) into OpenSim's ground; errors of rotations are about the axes of the segments."""
    slope = np.eye(6)
    slope[3:, 3:] = turn
    return BoneMotion(
        segments=motion.segments, rotation=turn @ motion.rotation, origin=motion.origin @ turn.T,
        covariance=slope @ motion.covariance @ slope.T,
    )  # fmt: skip


def _joints_of_body(body: Body) -> JointPlaces:
    """Return the joint centres at rest, with the covariance of the shape and of their offsets within the body."""
    own = body.joint_segments
    count = 3 * len(own)
    if body.numbers_covariance is None:
        covariance = np.full((count, count), np.nan)
    else:
        modes = body.space.joint_modes[:, own].reshape(-1, count)
        covariance = modes.T @ body.numbers_covariance @ modes
    if body.joint_offset_sd is not None:
        covariance = covariance + np.diag(np.repeat(body.joint_offset_sd[own] ** 2, 3))
    return JointPlaces(names=body.joint_names, places=body.joint_centres[own], covariance=covariance)


def _anatomical_motion(body: Body, motion: BodyMotion) -> BoneMotion:
    """Return the segments with anatomical axes; their errors are those of their joint and of their own coordinates."""
    anatomy = anatomy_of(body.skeleton, body.joint_centres)
    index = [anatomy.segment_names.index(name) for name in motion.segment_names]
    centres = motion.segment_origin.copy()
    spread = np.full(centres.shape, np.nan)
    for s, name in enumerate(motion.segment_names):
        if JOINT_OF_SEGMENT.get(name) in motion.joint_names:
            spread[:, s] = motion.joint_centres_sd[:, motion.joint_names.index(JOINT_OF_SEGMENT[name])]
    if set(_HIPS) <= set(motion.joint_names) and "pelvis" in motion.segment_names:
        pelvis = motion.segment_names.index("pelvis")
        sides = [motion.joint_names.index(name) for name in _HIPS]
        centres[:, pelvis] = motion.joint_centres[:, sides].mean(1)
        spread[:, pelvis] = motion.joint_centres_sd[:, sides].mean(1)
    covariance = np.zeros((*centres.shape[:2], 6, 6))
    for s, name in enumerate(motion.segment_names):
        turn = _turning_variance(body, motion, name)
        covariance[:, s, range(3), range(3)] = turn[:, None]
    covariance[..., range(3, 6), range(3, 6)] = spread**2
    return BoneMotion(
        segments=motion.segment_names, rotation=motion.segment_rotation @ anatomy.frames[index], origin=centres,
        covariance=covariance,
    )  # fmt: skip


def _turning_variance(body: Body, motion: BodyMotion, segment: str) -> Floats:
    """Return the variance (F,) of the rotation of a segment about an axis, by its own coordinates [rad2]."""
    own = [c.name for c in body.skeleton.coordinates if c.segment == segment]
    if segment == "pelvis":
        own += ["pelvis_turn", "pelvis_list", "pelvis_tilt"]
    columns = [motion.coordinate_names.index(name) for name in own if name in motion.coordinate_names]
    return np.asarray((motion.coordinates_sd[:, columns] ** 2).sum(1) if columns else np.full(len(motion), np.nan))


def _captured_mass(
    folder: Path, body: Body, given: PersonMass | None
) -> tuple[PersonMass | None, Mapping[str, float]]:
    """Return the mass of a captured person, and the masses of the segments in body.osim."""
    file = folder / "body.osim"
    root = read_osim(file) if file.is_file() else None
    segments = {} if root is None else body_masses(file, root)
    total = sum(segments.values())
    if given is not None:
        return given, {name: mass * given.mass_kg / total for name, mass in segments.items()} if total > 0 else {}
    model = None if root is None else root.find("Model")
    if total > 0 and model is not None and model.get("name") != _ESTIMATED:
        return PersonMass(mass_kg=total, sd=float("nan"), source="given with the trial"), segments
    mass_kg, sd = estimated_mass(body)
    return PersonMass(mass_kg=mass_kg, sd=sd, source="estimated from the volume of the body with its clothes"), segments


def _from_bones(folder: Path, bones: Bones, given: PersonMass | None) -> OpenSimPerson:
    """Read a person from bones beneath markers and the landmarks of the static trial."""
    file = folder / _LANDMARKS
    if not file.is_file():
        raise FileProblem(
            folder, f"has no {_LANDMARKS}, so the joint centres of the person are unknown",
            "Run `marey markers` with --static and [landmarks] in the TOML (--clusters).",
        )  # fmt: skip
    landmarks, sd = read_static_landmarks(file)
    joints = _joints_of_landmarks(landmarks, sd, bones.side)
    if not joints.names:
        raise FileProblem(file, "has no landmarks of a joint centre", "Add HJC, and LE and ME or KJC, to [landmarks].")
    turn = OPENSIM_FROM_WORLD @ _world_from_laboratory(folder)
    frames = anatomical_frames(landmarks, bones.segments, landmark_sd_m=sd, side=bones.side).frames
    names = tuple(_our_name(frame.segment, bones.side) for frame in frames)
    places = [_centre_of(name, joints) for name in names]
    centres = {
        frame.segment: frame.rotation.T @ (place - frame.origin)
        for frame, place in zip(frames, places, strict=True) if place is not None
    }  # fmt: skip
    origin = [frame.origin if place is None else place for frame, place in zip(frames, places, strict=True)]
    reference = StandingPosture(
        joints=_in_ground_places(joints, turn), segments=names, origin=np.reshape(origin, (-1, 3)) @ turn.T,
        rotation=np.reshape([turn @ frame.rotation for frame in frames], (-1, 3, 3)),
        own_feet=any(name.endswith("CA") for name in landmarks),
    )  # fmt: skip
    return OpenSimPerson(
        reference=reference, motion=_in_ground(_about_centres(bones, centres), turn), time=bones.time,
        rate=bones.rate, mass=given, segment_masses={}, events=bones.gait.events,
    )  # fmt: skip


def _joints_of_landmarks(landmarks: Mapping[str, Floats], sd: float, side: str | None) -> JointPlaces:
    """Return the joint centres that landmarks determine, with the covariance of their palpation."""
    names, places, variances = [], [], []
    for own in ("left", "right"):
        prefixes = (f"{own}_", "") if side == own else (f"{own}_",)
        for joint, choices in _CENTRES.items():
            known = [
                [f"{prefix}{name}" for name in choice]
                for prefix in prefixes for choice in choices if all(f"{prefix}{name}" in landmarks for name in choice)
            ]  # fmt: skip
            if known:
                names.append(f"{own}_{joint}")
                places.append(np.mean([landmarks[name] for name in known[0]], 0))
                variances += [sd**2 / len(known[0])] * 3
    return JointPlaces(
        names=tuple(names), places=np.reshape(places, (-1, 3)), covariance=np.diag(np.asarray(variances, float))
    )


def _our_name(segment: str, side: str | None) -> str:
    """Return our name of a segment of `marey markers`, with its side."""
    prefix = next((p for p in ("left_", "right_") if segment.startswith(p)), "")
    plain = segment.removeprefix(prefix)
    plain = _SEGMENTS.get(plain, plain)
    if not prefix and side is not None and f"left_{plain}" in JOINT_OF_SEGMENT:
        prefix = f"{side}_"
    return f"{prefix}{plain}"


def _centre_of(segment: str, joints: JointPlaces) -> Floats | None:
    """Return the place about which a segment rotates in the static trial; None if it is unknown."""
    wanted = _HIPS if segment == "pelvis" else (JOINT_OF_SEGMENT.get(segment, ""),)
    if not set(wanted) <= set(joints.names):
        return None
    return np.asarray(np.mean([joints.places[joints.names.index(name)] for name in wanted], 0))


def _about_centres(bones: Bones, centres: Mapping[str, Floats]) -> BoneMotion:
    """Move the origins of bones to their joint centres (3,) in the bone."""
    motion = bones.motion
    rotation, origin, covariance = motion.rotation, motion.origin.copy(), motion.covariance.copy()
    for s, segment in enumerate(motion.segments):
        place = centres.get(segment, np.zeros(3))
        x, y, z = place
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        origin[:, s] += rotation[:, s] @ place
        slope = np.zeros((len(motion), 6, 6))
        slope[:] = np.eye(6)
        slope[:, 3:, :3] = -rotation[:, s] @ cross
        covariance[:, s] = slope @ motion.covariance[:, s] @ np.swapaxes(slope, 1, 2)
    return BoneMotion(
        segments=tuple(_our_name(name, bones.side) for name in motion.segments), rotation=rotation, origin=origin,
        covariance=covariance,
    )  # fmt: skip


def _world_from_laboratory(folder: Path) -> Floats:
    """Return the rotation (3, 3) from the axes of a marker trial to the world: Y points up in every TRC."""
    inputs = [str(name) for record in records_in(folder)[:1] for name in record.get("inputs", {})]
    file = folder / "motion.c3d"
    if not file.is_file():
        raise FileProblem(folder, "has no motion.c3d", RUN_AGAIN)
    of_trc = bool(inputs) and inputs[0].lower().endswith(".trc")
    return np.asarray(OPENSIM_FROM_WORLD.T if of_trc or y_points_up(open_c3d(file)) else np.eye(3))
