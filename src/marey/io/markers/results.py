"""Writing the results of `marey markers`: tables and a C3D."""

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.geometry.rigid import RigidTransform
from marey.io.atomic import replacing
from marey.io.axes import OPENSIM_FROM_WORLD
from marey.io.markers.c3d import (
    add_events,
    add_points,
    add_rotations,
    open_c3d,
    point_labels,
    point_unit,
    save_c3d,
    write_c3d,
    y_points_up,
)
from marey.io.markers.reading_results import landmark_columns
from marey.io.opensim.mot_sto import Orientations, TimeSeriesTable, write_orientations, write_table
from marey.io.opensim.trc import PointPaths
from marey.io.units import METRES, MM_PER_M
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.data.marker_motion import MarkerMotion
from marey.markers.data.trajectories import MarkerTrajectories
from marey.markers.kinematics.calibration_offsets import AngleOffset
from marey.markers.kinematics.joint_angles import JointKinematics
from marey.markers.kinematics.landmark_motion import LandmarkMotion
from marey.markers.preprocessing.gaps import FROM_CLUSTER, SPLINE, STILL_MISSING, FilledGaps
from marey.motion.events.cycles import GaitEvent


def write_joint_table(path: Path | str, time: Floats, joints: JointKinematics) -> None:
    """Write `angles.mot`: angles in degrees, translations in mm as `..._mm`, each with its standard deviation `..._sd`.

    Args:
        path: The file.
        time: (F,) [s].
        joints: The angles and translations to write.
    """
    columns, values = [], []
    for name, value, sd in joint_columns(joints, ("", "_mm"), "_sd"):
        columns += [name, sd[0]]
        values += [value, sd[1]]
    table = np.stack(values, -1) if values else np.zeros((len(time), 0))
    write_table(path, TimeSeriesTable(name="angles", columns=tuple(columns), time=time, values=table))


def write_joint_csv(path: Path | str, time: Floats, joints: JointKinematics) -> None:
    """Write `angles.csv`: one row per frame, angles in degrees and translations in mm with their standard deviations.

    Args:
        path: The file.
        time: (F,) [s].
        joints: The angles and translations to write; the cells of unknown ones are empty.
    """
    head, columns = ["time_s"], []
    for name, value, sd in joint_columns(joints, ("_deg", "_mm"), "_sd"):
        head += [name, sd[0]]
        columns += [value, sd[1]]
    write_timed_rows(path, head, time, np.stack(columns, -1) if columns else np.zeros((len(time), 0)))


def joint_columns(
    joints: JointKinematics, units: tuple[str, str], spread: str
) -> list[tuple[str, Floats, tuple[str, Floats]]]:
    """Return columns with their standard deviations: angles in degrees, translations in mm.

    Args:
        joints: The angles and translations of F frames.
        units: Suffixes of the names of angles and of translations.
        spread: Suffix of the name of a standard deviation, inserted before the unit.

    Returns:
        For each column its name and values (F,), and the name and values (F,) of its standard deviation.
    """
    kinds = (
        (joints.angle_names, np.degrees(joints.angles), np.degrees(joints.angles_sd), units[0]),
        (joints.translation_names, joints.translations * MM_PER_M, joints.translations_sd * MM_PER_M, units[1]),
    )
    return [
        (f"{name}{unit}", values[:, k], (f"{name}{spread}{unit}", sd[:, k]))
        for names, values, sd, unit in kinds
        for k, name in enumerate(names)
    ]


def write_marker_motion(path: Path | str, time: Floats, motion: MarkerMotion) -> None:
    """Write `marker_motion.csv`: the position of each marker in the frame of its bone [mm], one row per frame.

    Args:
        path: The file.
        time: (F,) [s].
        motion: The positions to write, in the columns `SEGMENT:LABEL_x_mm` and so on.
    """
    head = ["time_s"] + [
        f"{segment}:{label}_{axis}_mm"
        for segment, label in zip(motion.segments, motion.labels, strict=True)
        for axis in "xyz"
    ]
    write_timed_rows(path, head, time, motion.places.reshape(len(time), -1) * MM_PER_M)


def write_static_landmarks(path: Path | str, landmarks: Mapping[str, Floats], *, sd_m: float) -> None:
    """Write `landmarks.csv`: one row per landmark, its position in the static trial [mm] and its standard deviation.

    Args:
        path: The file.
        landmarks: Maps a landmark to its position (3,) in the laboratory of the static trial [m].
        sd_m: Standard deviation of a coordinate [m].
    """
    with replacing(path) as temporary, temporary.open("w", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(["landmark", "x_mm", "y_mm", "z_mm", "sd_mm"])
        for name, place in landmarks.items():
            rows.writerow([name, *(f"{MM_PER_M * v:.4f}" for v in place), f"{MM_PER_M * sd_m:.4f}"])


def write_landmark_motion(path: Path | str, time: Floats, motion: LandmarkMotion) -> None:
    """Write `landmark_motion.csv`: position of each landmark in the laboratory and standard deviation [mm].

    Args:
        path: The file.
        time: (F,) [s].
        motion: The paths to write.
    """
    six = np.concatenate([motion.points, motion.sd], -1).reshape(len(time), -1)
    write_timed_rows(path, ["time_s", *landmark_columns(motion.names)], time, six * MM_PER_M)


def write_angle_offsets(path: Path | str, offsets: Sequence[AngleOffset]) -> None:
    """Write `assumed.csv`: one row per assumed measurement and joint angle that depends on it.

    Args:
        path: The file.
        offsets: What the measurements contribute to the standard deviations.
    """
    with replacing(path) as temporary, temporary.open("w", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(["measurement", "value_mm", "sd_mm", "angle", "angle_sd_deg"])
        for row in offsets:
            size = row.measurement
            cells = (MM_PER_M * size.value_m, MM_PER_M * size.sd_m)
            rows.writerow([size.name, *(f"{v:.3f}" for v in cells), row.angle, f"{np.degrees(row.sd):.4f}"])


def write_filled(path: Path | str, filling: FilledGaps) -> None:
    """Write `filled.csv`: one row per gap with marker, first and last frame, method and standard deviation.

    Args:
        path: The file.
        filling: The filled and the remaining gaps.
    """
    words = {SPLINE: "spline", FROM_CLUSTER: "cluster", STILL_MISSING: "empty"}
    with replacing(path) as temporary, temporary.open("w", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(["marker", "first_frame", "last_frame", "filled_by", "sd_mm"])
        for m, label in enumerate(filling.trajectories.labels):
            way = filling.way[:, m]
            edges = np.flatnonzero(np.diff(way)) + 1
            for start, end in pairwise([0, *map(int, edges), len(way)]):
                if int(way[start]) in words:
                    sd = filling.sd[start:end, m]
                    spread = f"{MM_PER_M * float(np.nanmax(sd)):.3f}" if np.isfinite(sd).any() else ""
                    rows.writerow([label, start, end - 1, words[int(way[start])], spread])


def write_frames(path: Path | str, frames: Mapping[str, RigidTransform]) -> None:
    """Write `frames.json`: the frames of the force plates as 4x4 matrices, laboratory from plate, in millimetres.

    Args:
        path: The file.
        frames: Maps the name of a plate to its frame [m].
    """
    rows = {name: RigidTransform(f.rotation, f.translation * MM_PER_M).matrix.tolist() for name, f in frames.items()}
    with replacing(path) as temporary:
        temporary.write_text(json.dumps({"unit": "mm", "laboratory_from": rows}, indent=2) + "\n", encoding="utf-8")


def write_timed_rows(path: Path | str, head: Sequence[str], first: Floats, values: Floats) -> None:
    """Write a column of times and columns of values; NaN is an empty cell.

    Args:
        path: The file.
        head: Names of the columns.
        first: (F,) values of the first column, with six decimals.
        values: (F, N) values of the others.
    """
    with replacing(path) as temporary, temporary.open("w", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(head)
        for at, cells in zip(first, values, strict=True):
            rows.writerow([f"{at:.6f}", *("" if v != v else f"{v:.5f}" for v in cells)])


def write_bone_orientations(path: Path | str, time: Floats, rate: float, motion: BoneMotion, *, y_up: bool) -> None:
    """Write `orientations.sto`: the anatomical axes of each bone in OpenSim's ground.

    Args:
        path: The file.
        time: (F,) [s].
        rate: Sampling rate [Hz].
        motion: The poses in the trial's own axes.
        y_up: Whether Y points up in the trial, as in OpenSim and in a TRC; otherwise Z does.
    """
    # The axes of the bones are those of OpenSim (X anterior, Y up, Z right), so only the laboratory is rotated.
    to_world = OPENSIM_FROM_WORLD.T if y_up else np.eye(3)
    orientations = Orientations(
        names=motion.segments, time=time, rate=rate,
        world_from_body=to_world @ motion.rotation @ OPENSIM_FROM_WORLD,
    )  # fmt: skip
    write_orientations(path, orientations)


def write_motion_c3d(
    path: Path | str, source: Path, trajectories: MarkerTrajectories, motion: BoneMotion,
    events: Sequence[GaitEvent] = (), person: str = "",
    renamed: Mapping[str, str] | None = None, computed: Sequence[str] = (),
) -> None:  # fmt: skip
    """Write `motion.c3d`: the points of the trial, and the poses of the bones as 4x4 matrices in the group ROTATION.

    If the trial is a C3D, everything else is copied unchanged: force and analog channels, events, and the results of
    other programs. Filled points replace the gaps; measured points are unchanged, also in frames that were not
    processed.

    Args:
        path: The file.
        source: The file of the trial.
        trajectories: The markers as they were processed, with filled gaps.
        motion: The poses of the bones, in the same axes.
        events: Gait events that were found, for a trial that contains none.
        person: Name of the person whose events they are; empty if the labels have no names.
        renamed: Maps labels of the markers to those in the trial; the same by default.
        computed: Labels of points that were computed from others, such as joint centres; they are added.
    """
    if source.suffix.lower() != ".c3d":
        paths = PointPaths(
            names=trajectories.labels, time=trajectories.time, rate=trajectories.rate, points=trajectories.points
        )
        begun = [replace(event, time=event.time - float(trajectories.time[0])) for event in events]
        write_c3d(
            path, paths, segment_names=motion.segments, segment_rotation=motion.rotation,
            segment_origin=motion.origin, events=begun,
        )  # fmt: skip
        return
    c3d = open_c3d(source)
    unit = METRES[point_unit(source, c3d)]
    full = list(point_labels(c3d))
    labels = full if renamed else [label.rpartition(":")[2] for label in full]
    points = c3d["data"]["points"]
    residuals = c3d["data"]["meta_points"]["residuals"]
    for index, label in enumerate(trajectories.labels):
        filled, label = trajectories.filled[:, index], (renamed or {}).get(label, label)
        if filled.any() and labels.count(label) == 1:
            at = labels.index(label)
            points[:3, at, filled] = trajectories.points[filled, index].T / unit
            residuals[0, at, filled] = 0.0
    before = f"{person}:" if renamed else ""
    add_points(c3d, {f"{before}{x}": trajectories.select([x]).points[:, 0] / unit for x in computed})
    add_rotations(c3d, motion.segments, motion.rotation, motion.origin / unit)
    add_events(c3d, events, person=person)
    with replacing(path) as temporary:
        save_c3d(c3d, temporary)


def is_y_up(path: Path) -> bool:
    """Return whether Y points up in a file of markers: in every TRC, and in a C3D that states it."""
    return path.suffix.lower() == ".trc" or (path.suffix.lower() == ".c3d" and y_points_up(open_c3d(path)))
