"""Reading motions of all formats that can be compared: MOT, STO, TRC, C3D, NPZ, and result folders."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from marey.arrays import Floats
from marey.errors import FileProblem, MareyError
from marey.io.markers.bones import BoneFile, read_bones
from marey.io.markers.c3d import open_c3d, point_labels
from marey.io.markers.readers import read_markers
from marey.io.npz import read_arrays, read_motion
from marey.io.opensim.mot_sto import is_of_quaternions, read_orientations, read_table
from marey.io.opensim.trc import read_trc
from marey.markers.kinematics.given_agreement import OTHER_SEQUENCE, PLUG_IN_GAIT_ANGLES
from marey.markers.kinematics.joint_angles import joint_kinematics, joint_of, usual_joints
from marey.motion.motion import BodyMotion
from marey.motion.recording import Recording

_NO_ANGLES = ("_tx", "_ty", "_tz", "_mm")
"""Suffixes of columns that are translations in OpenSim's tables and in ours."""
_IN_FOLDERS = ("motion.npz", "bones.npz", "marey/motion.npz", "marey/bones.npz")
"""Files of a motion in a result folder, or in the folder of a trial with results."""


def read_recording(path: Path | str) -> Recording:
    """Read a motion from a file or a result folder.

    Args:
        path: A MOT or STO (angles or orientations), TRC (OpenSim's axes), C3D (its own axes, and the angles of Plug-in
            Gait), `motion.npz`, `bones.npz` (or any NPZ with NAME_rotation, NAME_origin and `rate`); or a folder that
            contains a `motion.npz` or `bones.npz`.

    Returns:
        The angles, points and orientations that the file contains.

    Raises:
        FileProblem: The file has none of these formats, is damaged, or contains no measured frame.
    """
    path = find_motion_file(Path(path))
    readers: dict[str, Callable[[Path], Recording]] = {
        ".mot": _from_table, ".sto": _from_sto, ".trc": _from_trc, ".c3d": _from_c3d, ".npz": _from_npz,
    }  # fmt: skip
    if path.suffix.lower() not in readers:
        raise FileProblem(path, "is not a file of a motion", "Give a MOT, STO, TRC, C3D or NPZ, or a result folder.")
    try:
        recording = readers[path.suffix.lower()](path)
    except FileProblem:
        raise
    except MareyError as error:
        raise FileProblem(path, str(error).rstrip(".")) from error
    held = np.isfinite(recording.angles).any() or np.isfinite(recording.points).any()
    if not held and not np.isfinite(recording.rotation).any():
        raise FileProblem(path, "has no measured frame", "Give a motion with at least one measured frame.")
    return recording


def recording_of(motion: BodyMotion) -> Recording:
    """Return a captured motion as a recording: its angles, joint centres and orientations."""
    return Recording(
        time=motion.time, angle_names=motion.angle_names, angles=np.radians(motion.angles_deg),
        angles_sd=np.radians(motion.angles_deg_sd), point_names=motion.joint_names, points=motion.joint_centres,
        segment_names=motion.segment_names, rotation=motion.segment_rotation,
    )  # fmt: skip


def find_motion_file(path: Path) -> Path:
    """Return the file of the motion in a result folder, or the path itself if it is a file.

    Raises:
        FileProblem: The folder has no such file, or both kinds.
    """
    if path.is_file():
        return path
    if not path.is_dir():
        raise FileProblem(path, "does not exist", "Give a file of a motion, or a result folder.")
    found = [path / name for name in _IN_FOLDERS if (path / name).is_file()]
    if not found:
        wrong = "contains neither motion.npz nor bones.npz"
        raise FileProblem(path, wrong, "Give a result folder, or a file of a motion.")
    if len({file.name for file in found}) > 1:
        wrong = "contains both motion.npz and bones.npz"
        raise FileProblem(path, wrong, f"Give one of the files: {found[0]} or {found[1]}.")
    return found[0]


def _from_table(path: Path) -> Recording:
    """Read angles and their standard deviations `NAME_sd`; columns of translations (_tx, _ty, _tz, _mm) are skipped."""
    table = read_table(path)
    values = np.radians(table.values) if table.in_degrees else table.values
    sd_columns = {name.removesuffix("_sd"): k for k, name in enumerate(table.columns) if name.endswith("_sd")}
    names = [name for name in table.columns if not name.endswith((*_NO_ANGLES, "_sd"))]
    unknown = np.full(len(values), np.nan)
    sds = [values[:, sd_columns[name]] if name in sd_columns else unknown for name in names]
    return Recording(
        time=table.time, angle_names=tuple(names), angles=values[:, [table.columns.index(name) for name in names]],
        angles_sd=np.stack(sds, 1) if sds else np.zeros((len(values), 0)),
    )  # fmt: skip


def _from_sto(path: Path) -> Recording:
    if not is_of_quaternions(path):
        return _from_table(path)
    read = read_orientations(path)
    return Recording(time=read.time, segment_names=read.names, rotation=read.world_from_body)


def _from_trc(path: Path) -> Recording:
    paths = read_trc(path)
    return Recording(time=paths.time, point_names=paths.names, points=paths.points)


def _from_c3d(path: Path) -> Recording:
    """Read points, the poses in ROTATION, and the angles of Plug-in Gait."""
    c3d = open_c3d(path)
    names, angles = _plug_in_gait(c3d)
    rotation_names, rotation = _rotations(c3d)
    frames = c3d["data"]["points"].shape[2]
    rate = float((c3d["parameters"]["POINT"]["RATE"]["value"] or [0])[0])
    if not rate > 0 or not frames:
        raise FileProblem(path, f"has {frames} frames at {rate:g} Hz", "Export the trial again.")
    common: dict[str, Any] = dict(
        time=(c3d["header"]["points"]["first_frame"] + np.arange(frames)) / rate, angle_names=names, angles=angles
    )
    if rotation.shape[0] == frames:
        common |= dict(segment_names=rotation_names, rotation=rotation)
    try:
        markers = read_markers(path)
    except FileProblem:
        if not names and not rotation_names:
            raise
        return Recording(**common)
    return Recording(**common, point_names=markers.labels, points=markers.points)


def _plug_in_gait(c3d: Any) -> tuple[tuple[str, ...], Floats]:
    """Read the names and values (F, A) [rad] of the angles of Plug-in Gait that have the same sequence here."""
    names, columns = [], []
    points = c3d["data"]["points"][:3]
    for index, label in enumerate(point_labels(c3d)):
        bare = label.rpartition(":")[2]
        side = {"L": "left_", "R": "right_"}.get(bare[:1])
        for axis, own in enumerate(PLUG_IN_GAIT_ANGLES.get(bare[1:], ())):
            if side and own not in OTHER_SEQUENCE:
                names.append(f"{side}{own}")
                columns.append(np.radians(points[axis, index]))
    return tuple(names), np.stack(columns, -1) if columns else np.zeros((points.shape[2], 0))


def _rotations(c3d: Any) -> tuple[tuple[str, ...], Floats]:
    """Read the names and rotations (F, S, 3, 3) of the segments in the group ROTATION."""
    parameters = c3d["parameters"]
    if "ROTATION" not in parameters or "LABELS" not in parameters["ROTATION"]:
        return (), np.zeros((0, 0, 3, 3))
    labels = [label.strip().removesuffix("_4X4") for label in parameters["ROTATION"]["LABELS"]["value"] or []]
    matrices = np.transpose(c3d["data"]["rotations"], (3, 2, 0, 1))[..., :3, :3]
    return tuple(labels[: matrices.shape[1]]), np.asarray(matrices)


def _from_npz(path: Path) -> Recording:
    arrays = read_arrays(path)
    if "segment_rotation" in arrays:
        return recording_of(read_motion(path))
    bones = read_bones(path)
    names, angles, angles_sd = _angles_of_bones(path, bones)
    return Recording(
        time=bones.time, angle_names=names, angles=angles, angles_sd=angles_sd,
        point_names=tuple(f"{name}_origin" for name in bones.motion.segments), points=bones.motion.origin,
        segment_names=bones.motion.segments, rotation=bones.motion.rotation,
    )  # fmt: skip


def _angles_of_bones(path: Path, bones: BoneFile) -> tuple[tuple[str, ...], Floats, Floats]:
    """Return the joint angles of bones: those in `angles.mot` beside the file, else those of neighbouring bones."""
    table_path = path.with_name("angles.mot")
    if path.name == "bones.npz" and table_path.is_file():
        table = _from_table(table_path)
        if len(table) == len(bones.time) and np.allclose(table.time, bones.time, atol=1e-5):
            return table.angle_names, table.angles, table.angles_sd
    joints = [joint_of(*pair, side=bones.side) for pair in usual_joints(bones.motion.segments)]
    found = joint_kinematics(bones.motion, joints)
    return found.angle_names, found.angles, found.angles_sd
