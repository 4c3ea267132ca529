"""Joint angles of a known marker set, without a TOML, beside the angles that another program wrote into the file.

The walk of `functional` (Plug-in Gait, 438 frames at 120 Hz) contains the angles of Vicon's Plug-in Gait. They are no
truth: the bias is mostly a difference of definitions. The foot of Plug-in Gait has two markers, which hardly determine
its inversion. `--methods` chooses the methods of the second table, which repeats the comparison with the static trial
and with the walk alone.

The same walk is estimated from its clusters (LF01 to 05 and LT01 to 03 on a thigh and a shank, renamed LTH1 and LSK1),
with the markers of Plug-in Gait on knees and ankles in the static trial only, by which the landmarks are known. The
markers that Plug-in Gait follows are then not among those that are followed.

The walk of `gait` (OpenSim's gait example, 151 frames at 60 Hz) is compared with the inverse kinematics of OpenSim 4.6
with the model that was scaled to the person, for the quantities of which model and markers have the same. There the
knee has one degree of freedom and the pelvis follows all markers of the model: its list goes from -8 to 6 degrees where
the line between the markers of the spines goes from 0 to 5.
"""

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path

import ezc3d
import numpy as np

from bench.declaration import Bench
from bench.recording import Column, Run
from marey.io.opensim.mot_sto import read_table
from marey.markers.kinematics.given_agreement import GivenAgreement
from marey.motion.comparison import agreement
from marey.pipelines.markers.bones import Bones
from marey.pipelines.markers.estimate import estimate_bones, open_markers
from marey.pipelines.progress import RecordingProgress

BENCH = Bench(
    measures="Joint angles of known marker sets beside those of Vicon's and OpenSim's programs.",
    sources=("src/marey/markers", "src/marey/pipelines/marker_sets", "src/marey/pipelines/markers"),
    minutes=2,
)
METHODS = ("skin", "rigid", "global", "pct")
COORDINATES = (
    ("hip_flexion", "hip_flexion", 1), ("hip_adduction", "hip_adduction", 1), ("hip_rotation", "hip_rotation", 1),
    ("knee_flexion", "knee_angle", -1), ("ankle_dorsiflexion", "ankle_angle", 1),
)  # fmt: skip
"""Our angle, the coordinate of the model Gait2354, and the sign between them."""
SHOWN = (
    *(f"{joint}_{turn}" for joint in ("hip", "knee") for turn in ("flexion", "adduction", "rotation")),
    "ankle_dorsiflexion",
)
"""Angles in the table of the clusters."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("--methods", nargs="+", default=list(METHODS), help="methods of the second table")


def estimated(run: Run, method: str, *, static: bool) -> Bones:
    """Return the bones of the walk by one method."""
    folder = run.shared / "data" / "markers" / "functional"
    trial = open_markers(folder / "walk.c3d", static=folder / "static.c3d" if static else None)
    return estimate_bones(trial, method, progress=RecordingProgress())


def spreads(rows: Sequence[GivenAgreement], joint: str, *, inversion: bool = False) -> list[float]:
    """Return the spreads about the bias of one joint on both sides [degrees]."""
    return [
        float(np.degrees(row.agreement.sd))
        for row in rows
        if f"_{joint}_" in row.agreement.name and row.agreement.name.endswith("inversion") == inversion
    ]


def run(run: Run) -> None:
    """Estimate, and compare."""
    default = estimated(run, METHODS[0], static=True)
    table = run.table(
        "Angles of the default method, with the static trial", ("angle", "in the file"), Column("frames"),
        Column("bias", "deg", 2), Column("spread about the bias", "deg", 2), Column("correlation", "", 3),
        Column("stated sd", "deg", 1),
        note="Ours minus the file's. The pelvis' rotation counts from y here, from the direction of walking there. The "
        "stated standard deviation does not include differences of definitions.",
    )  # fmt: skip
    for row in default.given_agreement:
        own = row.agreement
        sd = default.joints.angles_sd[:, default.joints.angle_names.index(own.name)]
        table.row(
            (own.name.replace("_", " "), f"{row.label} {'-' if row.sign < 0 else ''}{row.component}"),
            own.frames, float(np.degrees(own.bias)),
            float(np.degrees(own.sd)), own.correlation, float(np.degrees(np.nanmedian(sd))),
        )  # fmt: skip
    other = run.table(
        "Spread about the bias by method and posture", ("posture", "method"),
        *(Column(f"{joint}, mean of six", "deg", 2) for joint in ("hip", "knee")),
        Column("ankle without inversion, mean of four", "deg", 2), Column("inversion, mean of two", "deg", 2),
        Column("largest without inversion", "deg", 2), Column("mean absolute bias without inversion", "deg", 2),
    )  # fmt: skip
    for static, posture in ((True, "static trial"), (False, "most upright frame of the walk")):
        for method in run.arguments.methods:
            rows = estimated(run, method, static=static).given_agreement
            each = [spreads(rows, joint) for joint in ("hip", "knee", "ankle")]
            joints = [row for row in rows if not row.agreement.name.startswith("pelvis")]
            bias = [abs(np.degrees(row.agreement.bias)) for row in joints if "inversion" not in row.agreement.name]
            means = [float(np.mean(values)) for values in (*each, spreads(rows, "ankle", inversion=True))]
            other.row((posture, method), *means, max(max(values) for values in each), float(np.mean(bias)))
    of_clusters(run)
    beside_opensim(run)


def of_clusters(run: Run) -> None:
    """Compare the angles of clusters, and of the markers of Plug-in Gait, with those in the file."""
    folder = run.shared / "data" / "markers" / "functional"
    table = run.table(
        "Clusters with landmarks in the static trial", ("method", "markers"),
        *(Column(angle.replace("_", " "), "deg", 2) for angle in SHOWN),
        note="Spread about the bias from the angles in the file, root mean square of both sides. Neither is the truth.",
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as name:
        walk, static = (renamed(folder / file, Path(name)) for file in ("walk.c3d", "static.c3d"))
        for method in run.arguments.methods:
            clusters = estimate_bones(open_markers(walk, static=static), method, progress=RecordingProgress())
            for markers, found in (("clusters", clusters), ("Plug-in Gait", estimated(run, method, static=True))):
                spread = {row.agreement.name: float(np.degrees(row.agreement.sd)) for row in found.given_agreement}
                cells = [
                    float(np.hypot(spread[f"left_{angle}"], spread[f"right_{angle}"]) / np.sqrt(2)) for angle in SHOWN
                ]
                table.row((method, markers), *cells)


def renamed(path: Path, out: Path) -> Path:
    """Write a C3D with clusters, pelvis and feet, and in the static trial with knees and ankles."""
    c3d = ezc3d.c3d(str(path))
    kept = {f"{side}{name}" for side in "LR" for name in ("ASI", "PSI", "HEE", "TOE")}
    if path.stem == "static":
        kept |= {f"{side}{name}" for side in "LR" for name in ("KNE", "ANK", "THI", "TIB")}
    labels = []
    for k, label in enumerate(c3d["parameters"]["POINT"]["LABELS"]["value"]):
        if label[1:3] in ("F0", "T0"):
            labels.append(f"{label[0]}{'TH' if label[1] == 'F' else 'SK'}{label[-1]}")
        else:
            labels.append(label if label in kept or label.endswith("Angles") else f"*{k}")
    c3d["parameters"]["POINT"]["LABELS"]["value"] = labels
    c3d.write(str(out / path.name))
    return out / path.name


def beside_opensim(run: Run) -> None:
    """Compare the walk of OpenSim's gait example with the inverse kinematics of its scaled model."""
    folder = run.shared / "data" / "markers" / "gait"
    trial = open_markers(folder / "walk.trc", static=folder / "static.trc")
    found = estimate_bones(trial, METHODS[0], progress=RecordingProgress())
    stored = read_table(folder / "walk_reference_ik.mot")
    table = run.table(
        "Beside the inverse kinematics of OpenSim's scaled model", ("angle", "coordinate"), Column("frames"),
        Column("bias", "deg", 2), Column("spread about the bias", "deg", 2), Column("correlation", "", 3),
        Column("stated sd", "deg", 1), note="Default method, with the static trial; ours minus the model's.",
    )  # fmt: skip
    for side in ("left", "right"):
        for name, coordinate, sign in COORDINATES:
            column = found.joints.angle_names.index(f"{side}_{name}")
            theirs = sign * stored.values[:, stored.columns.index(f"{coordinate}_{side[0]}")]
            own = agreement(name, "angle", found.joints.angles[:, column], np.radians(theirs))
            table.row(
                (f"{side} {name.replace('_', ' ')}", f"{coordinate}_{side[0]}"), own.frames,
                float(np.degrees(own.bias)), float(np.degrees(own.sd)), own.correlation,
                float(np.degrees(np.nanmedian(found.joints.angles_sd[:, column]))),
            )  # fmt: skip
