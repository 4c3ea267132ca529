"""Joint angles of a known marker set, without a TOML, beside the angles that another program wrote into the file.

The walk of `functional` (Plug-in Gait, 438 frames at 120 Hz) contains the angles of Vicon's Plug-in Gait. They are no
truth: the bias is mostly a difference of definitions. The foot of Plug-in Gait has two markers, which hardly determine
its inversion. `--methods` chooses the methods of the second table, which repeats the comparison with the static trial
and with the walk alone.
"""

import argparse
from collections.abc import Sequence

import numpy as np

from bench.declaration import Bench
from bench.recording import Column, Run
from marey.markers.kinematics.given_agreement import GivenAgreement
from marey.pipelines.markers.bones import Bones
from marey.pipelines.markers.estimate import estimate_bones, open_markers
from marey.pipelines.progress import RecordingProgress

BENCH = Bench(
    measures="Joint angles of Plug-in Gait beside those that Vicon's program wrote into the file.",
    sources=("src/marey/markers", "src/marey/pipelines/marker_sets", "src/marey/pipelines/markers"),
    minutes=2,
)
METHODS = ("skin", "rigid", "global", "pct")


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
        note="Ours minus the file's. The stated standard deviation does not include differences of definitions.",
    )  # fmt: skip
    for row in default.given_agreement:
        own = row.agreement
        sd = default.joints.angles_sd[:, default.joints.angle_names.index(own.name)]
        table.row(
            (own.name.replace("_", " "), f"{row.label} {row.component}"), own.frames, float(np.degrees(own.bias)),
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
            bias = [abs(np.degrees(row.agreement.bias)) for row in rows if "inversion" not in row.agreement.name]
            means = [float(np.mean(values)) for values in (*each, spreads(rows, "ankle", inversion=True))]
            other.row((posture, method), *means, max(max(values) for values in each), float(np.mean(bias)))
