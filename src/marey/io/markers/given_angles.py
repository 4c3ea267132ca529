"""Angles of another program: reading them from a C3D, and the files in which `marey markers` keeps them."""

import csv
from collections.abc import Sequence
from pathlib import Path

import ezc3d
import numpy as np

from marey.arrays import Floats
from marey.io.atomic import replacing
from marey.io.markers.c3d import point_labels
from marey.io.markers.reading_results import read_timed_rows
from marey.io.markers.results import write_timed_rows
from marey.markers.data.given_angles import GivenAngles
from marey.markers.kinematics.given_agreement import GivenAgreement, given_meaning


def angles_in(c3d: ezc3d.c3d) -> GivenAngles | None:
    """Return the points of a C3D that are angles; None if there are none with a value.

    These are the ones that the parameters POINT:ANGLES list, and those with a label of Plug-in Gait. A point with a
    negative residual, or of exactly (0, 0, 0), is missing, as for positions.

    Args:
        c3d: The content of the file.
    """
    point = c3d["parameters"]["POINT"]
    lists = [key for key in point if key.rstrip("0123456789") == "ANGLES"]
    listed = {label for key in lists for label in (point[key]["value"] or [])}
    labels = point_labels(c3d)
    listed |= {label for label in labels if given_meaning(label.rpartition(":")[2].strip())}
    kept = [n for n, label in enumerate(labels) if label in listed]
    values = np.transpose(c3d["data"]["points"][:3, kept], (2, 1, 0))
    residuals = np.transpose(c3d["data"]["meta_points"]["residuals"][0][kept])
    missing = (residuals < 0) | ~np.isfinite(values).all(-1) | (values == 0).all(-1)
    seen = [a for a in range(len(kept)) if not missing[:, a].all()]
    if not seen:
        return None
    unit = str((point["ANGLE_UNITS"]["value"] or ["deg"])[0] if "ANGLE_UNITS" in point else "deg").strip().lower()
    turned = values if unit.startswith("rad") else np.radians(values)
    turned = np.where(missing[..., None], np.nan, turned)
    return GivenAngles(labels=tuple(labels[kept[a]] for a in seen), values=turned[:, seen])


def write_given_angles(path: Path, time: Floats, given: GivenAngles) -> None:
    """Write `given_angles.csv`: one row per frame, three columns in degrees per label.

    Args:
        path: The file.
        time: (F,) [s].
        given: The angles of the file.
    """
    head = ["time_s", *(f"{label}_{axis}_deg" for label in given.labels for axis in "xyz")]
    write_timed_rows(path, head, time, np.degrees(given.values.reshape(len(time), -1)))


def read_given_angles(path: Path) -> GivenAngles:
    """Read `given_angles.csv`.

    Args:
        path: The file.

    Raises:
        FileProblem: The file is missing, or not a table of numbers.
    """
    head, values = read_timed_rows(path)
    labels = tuple(name.removesuffix("_x_deg") for name in head if name.endswith("_x_deg"))
    return GivenAngles(
        labels=labels, values=np.radians(values[:, 1 : 1 + 3 * len(labels)].reshape(len(values), len(labels), 3))
    )


def write_given_agreement(path: Path, rows: Sequence[GivenAgreement]) -> None:
    """Write `given_agreement.csv`: one row per joint angle that is also in the file of the trial.

    Args:
        path: The file.
        rows: The agreements.
    """
    with replacing(path) as temporary, temporary.open("w", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(["angle", "label", "component", "sign", "frames", "bias_deg", "spread_deg", "correlation"])
        for row in rows:
            own = row.agreement
            numbers = (float(np.degrees(own.bias)), float(np.degrees(own.sd)), own.correlation)
            cells = ["" if value != value else f"{value:.5f}" for value in numbers]
            table.writerow([own.name, row.label, row.component, row.sign, own.frames, *cells])
