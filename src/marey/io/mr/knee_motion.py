"""`knee_motion.npz` and `proximity.csv`: motion of a knee's bones, and distances between its cartilages."""

import csv
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.errors import MareyError
from marey.io.atomic import replacing
from marey.io.npz import consistent_arrays, read_arrays, write_arrays
from marey.knee.motion.joint_motion import BASE, JOINTS, JointMotion, KneeMotion
from marey.knee.motion.joint_surface import StructureVertices
from marey.knee.motion.proximity import NEAR_MM, Proximity
from marey.knee.space.structures import CARTILAGE_OF_BONE
from marey.markers.kinematics.joint_angles import JointKinematics
from marey.markers.kinematics.transform_chain import CAPTURE_GLOBAL, MR_GLOBAL, NamedTransform

_BESIDE = "compared_"
"""Prefix of the keys of the second correction of the soft-tissue motion."""
_SIDES = {"unknown": None, "left": True, "right": False}
"""Whether it is a left knee, by the name of the side."""
_MM = 1e3
"""Millimetres in a metre."""


def write_knee_motion(path: Path | str, found: KneeMotion, compared: KneeMotion | None = None) -> None:
    """Write all results as named arrays; the names of a second correction begin with `compared_`.

    `time` s, `rate` Hz, `side`, `method`; `bones` (B,), `laboratory_from_scanner` and `tibia_from_bone` (F, B, 4, 4)
    mm, with `..._covariance` (F, B, 6, 6) of the rotation error from the right [rad] and of the translation [mm];
    `angle_names`, `angles_deg`, `angles_deg_sd`, `translation_names`, `translations_mm`, `translations_mm_sd`; of each
    joint, the fields of `marey.knee.motion.proximity.Proximity`, for example `tibiofemoral_gap_mm`; `..._vertices` are
    the indices of the mesh vertices to which the distance maps belong.

    Args:
        path: The file.
        found: The motion to write.
        compared: The same motion by another correction of the soft-tissue motion.
    """
    arrays = _arrays(found)
    if compared is not None:
        once = ("time", "rate", "side")
        arrays |= {_BESIDE + name: value for name, value in _arrays(compared).items() if name not in once}
    write_arrays(path, arrays)


def _arrays(found: KneeMotion) -> dict[str, object]:
    motion = found.motion
    arrays: dict[str, object] = {
        "time": motion.time, "side": {left: name for name, left in _SIDES.items()}[motion.left],
        "method": found.method, "bones": np.array(motion.bones, np.str_),
    }  # fmt: skip
    if len(motion) > 1:
        arrays["rate"] = 1 / float(np.median(np.diff(motion.time)))
    arrays |= _poses(motion)
    if found.angles is not None:
        arrays |= _angles(found.angles)
    for joint in found.joints:
        arrays |= _joint(joint)
    return arrays


def _poses(motion: JointMotion) -> dict[str, object]:
    """Return the poses of the bones in the laboratory and, where the tibia is tracked, in the tibia's frame."""
    kinds = {"laboratory_from_scanner": dict(motion.poses)}
    if BASE in motion.poses:
        kinds["tibia_from_bone"] = {bone: motion.held(bone) for bone in motion.bones}
    arrays: dict[str, object] = {}
    unknown = np.full((len(motion), 6, 6), np.nan)
    for name, poses in kinds.items():
        arrays[name] = np.stack([pose.matrix() for pose in poses.values()], 1)
        spread = [unknown if pose.covariance is None else pose.covariance for pose in poses.values()]
        arrays[f"{name}_covariance"] = np.stack(spread, 1)
    return arrays


def _angles(angles: JointKinematics) -> dict[str, object]:
    return {
        "angle_names": np.array(angles.angle_names, np.str_), "angles_deg": np.degrees(angles.angles),
        "angles_deg_sd": np.degrees(angles.angles_sd),
        "translation_names": np.array(angles.translation_names, np.str_),
        "translations_mm": _MM * angles.translations, "translations_mm_sd": _MM * angles.translations_sd,
    }  # fmt: skip


def _joint(joint: Proximity) -> dict[str, object]:
    arrays: dict[str, object] = {
        "compartments": np.array(joint.compartments, np.str_), "limit_mm": joint.limit_mm, "gap_mm": joint.gap_mm,
        "gap_sd_mm": joint.gap_sd_mm, "overlap_mm2": joint.overlap_mm2, f"below_{NEAR_MM:g}_mm2": joint.close_mm2,
        "near_mm2": joint.near_mm2,
    }  # fmt: skip
    sides = (
        (joint.base, joint.base_distance_mm, joint.centre_mm, joint.centre_sd_mm),
        (joint.moving, joint.moving_distance_mm, joint.moving_centre_mm, joint.moving_centre_sd_mm),
    )
    for side, distance, centre, spread in sides:
        arrays[f"{side.name}_vertices"] = side.sources
        # Rounded to a micrometre: further digits are noise and compress badly.
        arrays[f"{side.name}_distance_mm"] = np.round(distance, 3)
        arrays[f"{side.name}_centre_mm"], arrays[f"{side.name}_centre_sd_mm"] = centre, spread
    return {f"{joint.name}_{name}": value for name, value in arrays.items()}


def read_knee_motion(path: Path | str) -> tuple[KneeMotion, KneeMotion | None]:
    """Read a file that `write_knee_motion` wrote.

    Args:
        path: The file.

    Returns:
        The motion and, if the file has it, the same motion by a second correction of the soft-tissue motion. The poses
        of the anatomical frames are not in the file.

    Raises:
        FileProblem: The file cannot be read, lacks a key, or has arrays whose shapes do not agree.
    """
    wanted = ("time", "side", "method", "bones", "laboratory_from_scanner")
    arrays = read_arrays(path, wanted, texts=("side", "method", "bones"))
    beside = {name.removeprefix(_BESIDE): value for name, value in arrays.items() if name.startswith(_BESIDE)}
    with consistent_arrays(path, "Run `marey knee animate` again."):
        found = _knee_motion(arrays)
        return found, _knee_motion(arrays | beside) if beside else None


def _knee_motion(arrays: Mapping[str, np.ndarray]) -> KneeMotion:
    matrices, spread = arrays["laboratory_from_scanner"], arrays["laboratory_from_scanner_covariance"]
    poses = {
        bone: NamedTransform(
            to=CAPTURE_GLOBAL, from_=MR_GLOBAL, rotation=matrices[:, b, :3, :3], translation=matrices[:, b, :3, 3],
            covariance=spread[:, b],
        )
        for b, bone in enumerate(map(str, arrays["bones"]))
    }  # fmt: skip
    side = str(arrays["side"])
    if side not in _SIDES:
        raise MareyError(f"the side is {side!r}, and should be {' or '.join(_SIDES)}")
    motion = JointMotion(time=arrays["time"], left=_SIDES[side], poses=poses, anatomical={})
    joints = tuple(_proximity(name, bones, arrays) for name, *bones in JOINTS if f"{name}_gap_mm" in arrays)
    angles = _kinematics(arrays)
    for what, frames in (*((joint.name, len(joint)) for joint in joints), *(() if angles is None else _count(angles))):
        if frames != len(motion):
            raise MareyError(f"{what}: {frames} frames, and time has {len(motion)}")
    return KneeMotion(method=str(arrays["method"]), motion=motion, joints=joints, angles=angles)


def _count(angles: JointKinematics) -> tuple[tuple[str, int], ...]:
    return ("angles_deg", len(angles.angles)), ("translations_mm", len(angles.translations))


def _kinematics(arrays: Mapping[str, np.ndarray]) -> JointKinematics | None:
    if "angle_names" not in arrays:
        return None
    return JointKinematics(
        angle_names=tuple(map(str, arrays["angle_names"])), angles=np.radians(arrays["angles_deg"]),
        angles_sd=np.radians(arrays["angles_deg_sd"]),
        translation_names=tuple(map(str, arrays["translation_names"])),
        translations=arrays["translations_mm"] / _MM, translations_sd=arrays["translations_mm_sd"] / _MM,
    )  # fmt: skip


def _proximity(name: str, bones: list[str], arrays: Mapping[str, np.ndarray]) -> Proximity:
    """Restore the measurements of a joint; each bone has its cartilage or, without cartilage, its own surface."""
    own = {key.removeprefix(f"{name}_"): value for key, value in arrays.items() if key.startswith(f"{name}_")}
    base, moving = (
        StructureVertices(name=structure, sources=own[f"{structure}_vertices"])
        for structure in (_structure(bone, own) for bone in bones)
    )

    def centre(side: StructureVertices, of: str) -> Floats:
        return own[f"{side.name}_centre_{of}"]

    return Proximity(
        name=name, base=base, moving=moving, limit_mm=float(own["limit_mm"]),
        compartments=tuple(map(str, own["compartments"])), base_distance_mm=own[f"{base.name}_distance_mm"],
        moving_distance_mm=own[f"{moving.name}_distance_mm"], gap_mm=own["gap_mm"], gap_sd_mm=own["gap_sd_mm"],
        overlap_mm2=own["overlap_mm2"], close_mm2=own[f"below_{NEAR_MM:g}_mm2"], near_mm2=own["near_mm2"],
        centre_mm=centre(base, "mm"), centre_sd_mm=centre(base, "sd_mm"), moving_centre_mm=centre(moving, "mm"),
        moving_centre_sd_mm=centre(moving, "sd_mm"),
    )  # fmt: skip


def _structure(bone: str, arrays: Mapping[str, np.ndarray]) -> str:
    cartilage = CARTILAGE_OF_BONE[bone]
    return cartilage if f"{cartilage}_vertices" in arrays else bone


def write_proximity(path: Path | str, found: KneeMotion, compared: KneeMotion | None = None) -> None:
    """Write `proximity.csv`, one row per frame, joint, compartment and correction; unknown values are empty cells.

    Args:
        path: The file.
        found: The motion to write.
        compared: The same motion by another correction of the soft-tissue motion.
    """
    limits = {joint.limit_mm for joint in found.joints}
    near = f"area_below_{next(iter(limits)):g}mm_mm2" if limits else "area_near_mm2"
    head = ["frame", "time_s", "method", "joint", "compartment", "gap_mm", "gap_sd_mm", "gap_within_its_sd"]
    head += ["area_overlap_mm2", f"area_below_{NEAR_MM:g}mm_mm2", near]
    places = [f"{on}_{axis}_mm" for on in ("centre", "moving_centre") for axis in "xyz"]
    with replacing(path) as beside, beside.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow([*head, *places])
        for each in (found, *(() if compared is None else (compared,))):
            for joint in each.joints:
                rows.writerows(_rows(each, joint))


def _rows(found: KneeMotion, joint: Proximity) -> list[list[str]]:
    rows = []
    for frame, time in enumerate(found.motion.time):
        for c, compartment in enumerate(joint.compartments):
            numbers = [joint.gap_mm[frame, c], joint.gap_sd_mm[frame, c]]
            known = np.isfinite(numbers).all()
            areas = [joint.overlap_mm2[frame, c], joint.close_mm2[frame, c], joint.near_mm2[frame, c]]
            places = [*joint.centre_mm[frame, c], *joint.moving_centre_mm[frame, c]]
            rows.append(
                [
                    str(frame), f"{time:.6f}", found.method, joint.name, compartment, *map(_cell, numbers),
                    str(int(joint.unsure[frame, c])) if known else "", *map(_cell, [*areas, *places]),
                ]
            )  # fmt: skip
    return rows


def _cell(value: float) -> str:
    return "" if value != value else f"{value:.4f}"
