"""Reading the tables that `marey markers` writes: joint angles and marker motion."""

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.errors import FileProblem
from marey.io.documents import finite, read_rows, read_text
from marey.io.markers.bones import RUN_AGAIN
from marey.io.units import MM_PER_M
from marey.markers.data.marker_motion import MarkerMotion
from marey.markers.kinematics.joint_angles import JointKinematics
from marey.markers.kinematics.landmark_motion import LandmarkMotion


def read_joint_csv(path: Path | str) -> JointKinematics:
    """Read `angles.csv` as written by `write_joint_csv`.

    Args:
        path: The file.

    Returns:
        Angles [rad] and translations [m]; NaN where a cell is empty.

    Raises:
        FileProblem: The file does not exist, or is not a table of numbers.
    """
    head, values = read_timed_rows(path)
    columns = dict(zip(head, values.T, strict=True))
    angles = [name.removesuffix("_deg") for name in head if name.endswith("_deg") and not name.endswith("_sd_deg")]
    lengths = [name.removesuffix("_mm") for name in head if name.endswith("_mm") and not name.endswith("_sd_mm")]

    def stacked(names: list[str], ending: str) -> Floats:
        unknown = np.full(len(values), np.nan)
        return np.stack([columns.get(f"{name}{ending}", unknown) for name in names], 1).reshape(len(values), -1)

    none = np.zeros((len(values), 0))
    return JointKinematics(
        angle_names=tuple(angles),
        angles=np.radians(stacked(angles, "_deg")) if angles else none,
        angles_sd=np.radians(stacked(angles, "_sd_deg")) if angles else none,
        translation_names=tuple(lengths),
        translations=stacked(lengths, "_mm") / MM_PER_M if lengths else none,
        translations_sd=stacked(lengths, "_sd_mm") / MM_PER_M if lengths else none,
    )


def read_marker_motion(path: Path | str) -> MarkerMotion:
    """Read `marker_motion.csv` as written by `write_marker_motion`.

    Args:
        path: The file.

    Raises:
        FileProblem: The file does not exist, or is not a table of numbers.
    """
    head, values = read_timed_rows(path)
    named = [name.removesuffix("_x_mm").partition(":") for name in head if name.endswith("_x_mm")]
    if len(head) != 1 + 3 * len(named):
        raise FileProblem(path, "has a marker without three columns NAME_x_mm, NAME_y_mm and NAME_z_mm", RUN_AGAIN)
    places = values[:, 1:].reshape(len(values), -1, 3) / MM_PER_M
    return MarkerMotion(
        labels=tuple(label for _, _, label in named), segments=tuple(segment for segment, _, _ in named), places=places
    )  # fmt: skip


def read_landmark_motion(path: Path | str) -> LandmarkMotion:
    """Read `landmark_motion.csv` as written by `write_landmark_motion`.

    Args:
        path: The file.

    Raises:
        FileProblem: The file does not exist, or is not such a table.
    """
    head, values = read_timed_rows(path)
    names = tuple(name.removesuffix("_x_mm") for name in head[1::6])
    if head[1:] != landmark_columns(names):
        raise FileProblem(path, "has a landmark without six columns NAME_x_mm, ..., NAME_sd_z_mm", RUN_AGAIN)
    six = values[:, 1:].reshape(len(values), -1, 6) / MM_PER_M
    return LandmarkMotion(names=names, points=six[..., :3], sd=six[..., 3:])


def landmark_columns(names: Sequence[str]) -> list[str]:
    """Return the columns of `landmark_motion.csv`: position and standard deviation of each landmark.

    Args:
        names: Names of the landmarks.
    """
    return [f"{name}{kind}_{axis}_mm" for name in names for kind in ("", "_sd") for axis in "xyz"]


def read_static_landmarks(path: Path | str) -> tuple[dict[str, Floats], float]:
    """Read `landmarks.csv` as written by `write_static_landmarks`.

    Args:
        path: The file.

    Returns:
        Position (3,) of each landmark in the laboratory of the static trial [m], and the largest standard deviation of
        a coordinate [m].

    Raises:
        FileProblem: The file does not exist, or is not such a table.
    """
    head = ["landmark", "x_mm", "y_mm", "z_mm", "sd_mm"]
    rows = read_rows(path, read_text(path, RUN_AGAIN).splitlines(), RUN_AGAIN)
    if not rows or rows[0] != head:
        raise FileProblem(path, f"does not have the columns {', '.join(head)}", RUN_AGAIN)
    places, sds = {}, [0.0]
    for row in rows[1:]:
        numbers = finite(row[1:], (4,))
        if numbers is None:
            raise FileProblem(path, f"has no four numbers for the landmark {row[:1]}", RUN_AGAIN)
        places[row[0]] = numbers[:3] / MM_PER_M
        sds.append(float(numbers[3]) / MM_PER_M)
    return places, max(sds)


def read_timed_rows(path: Path | str) -> tuple[list[str], Floats]:
    """Read a header line and rows of numbers (F, N); an empty cell is NaN.

    Args:
        path: The file.

    Raises:
        FileProblem: The file does not exist, or is not a table of numbers.
    """
    try:
        with Path(path).open(newline="", encoding="utf-8") as file:
            rows = list(csv.reader(file))
        values = [[float(cell) if cell else np.nan for cell in row] for row in rows[1:]]
        if not values:
            raise ValueError("it has no row of numbers")
        return rows[0], np.array(values, float).reshape(len(values), len(rows[0]))
    except (OSError, ValueError, IndexError, csv.Error) as error:
        raise FileProblem(path, f"cannot be read ({error})", RUN_AGAIN) from error
