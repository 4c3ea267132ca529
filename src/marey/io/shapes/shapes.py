"""Reading and writing of recovered shapes: shapes.npz, residuals per point, point clouds per frame, and C3D."""

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from marey.arrays import Floats, Integers
from marey.io.atomic import replacing
from marey.io.markers.c3d import write_c3d
from marey.io.npz import consistent_arrays, read_arrays, write_arrays
from marey.io.opensim.trc import PointPaths
from marey.io.shapes.point_cloud import write_point_cloud
from marey.nonrigid.recovered import IN_LABORATORY, CameraRelations, RankCurve, RecoveredShapes

_FIELDS = (
    "kind", "shape", "shape_sd", "rotation", "rotation_sd", "translation", "basis", "coefficients", "residuals",
    "predicted", "modelled", "noise_sd", "metres_per_unit", "metres_per_unit_sd",
    "unit", "residual_unit",
)  # fmt: skip
"""Fields of `RecoveredShapes` that are arrays of the same names in the file."""
_WORDS = ("kind", "unit", "residual_unit")
"""The fields among them that are single texts."""
_NUMBERS = ("metres_per_unit", "metres_per_unit_sd")
"""The fields among them that are single numbers."""
_RELATIONS = {
    "camera_from_first": "camera_from_first", "camera_sd": "camera_sd", "camera_scale": "scale",
    "camera_translation": "translation", "camera_magnification": "magnification",
}  # fmt: skip
"""Arrays of several uncalibrated cameras: names in the file, with the fields of `CameraRelations`."""
_TEXTS = ("gauge", "notes")
"""Fields that are lists of texts."""
_SEEN, _PREDICTED = (47, 109, 181), (220, 111, 74)
"""Red, green and blue of points that were observed, and of predicted ones."""
WORLD_FROM_CAMERA = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])
"""(3, 3) Rotation from the axes of a camera (x right, y down, z ahead) to axes with Z up."""
WORLD_FROM_Y_UP = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
"""(3, 3) Rotation from axes with Y up to axes with Z up."""


def shape_arrays(found: RecoveredShapes) -> dict[str, np.ndarray]:
    """Return all results as named arrays, for a file."""
    arrays = {name: np.asarray(getattr(found, name)) for name in _FIELDS}
    arrays |= {name: np.array(getattr(found, name), np.str_) for name in _TEXTS}
    arrays |= {"rank": np.array(found.rank), "answered": found.answered}
    if found.path_ambiguity is not None:
        arrays["path_ambiguity"] = found.path_ambiguity
    if found.cameras is not None:
        arrays |= {name: getattr(found.cameras, own) for name, own in _RELATIONS.items()}
    if found.curve is not None:
        arrays |= {
            "curve_basis_shapes": found.curve.ranks, "curve_errors": found.curve.errors,
            "curve_errors_sd": found.curve.errors_sd, "curve_measure": np.array(found.curve.measure),
        }  # fmt: skip
    return arrays


def shapes_from(arrays: dict[str, np.ndarray]) -> RecoveredShapes:
    """Return the shapes from the arrays of `shape_arrays`."""
    curve = None
    if "curve_errors" in arrays:
        curve = RankCurve(
            ranks=arrays["curve_basis_shapes"], errors=arrays["curve_errors"], errors_sd=arrays["curve_errors_sd"],
            measure=str(arrays["curve_measure"]),
        )  # fmt: skip
    cameras = None
    if "camera_from_first" in arrays:
        cameras = CameraRelations(**{own: arrays[name] for name, own in _RELATIONS.items()})
    parts: dict[str, Any] = {name: arrays[name] for name in _FIELDS}
    parts |= {name: float(arrays[name]) for name in _NUMBERS} | {name: str(arrays[name]) for name in _WORDS}
    parts |= {name: tuple(map(str, arrays[name])) for name in _TEXTS}
    return RecoveredShapes(curve=curve, cameras=cameras, path_ambiguity=arrays.get("path_ambiguity"), **parts)


def write_shapes(
    path: Path | str,
    found: RecoveredShapes,
    *,
    labels: Sequence[str],
    camera_points: Integers | None = None,
    probability: Floats | None = None,
) -> None:
    """Write `shapes.npz`; docs/reference/files.md lists its keys.

    Args:
        path: The file.
        found: The recovered shapes.
        labels: The points' names.
        camera_points: (C, P) index of the track of each point in each camera, -1 where it has none; None where the
            cameras share their points.
        probability: (C, P) probability that this assignment is right.
    """
    arrays = shape_arrays(found) | {"labels": np.array(labels, np.str_)}
    if camera_points is not None:
        arrays["camera_points"] = camera_points
    if probability is not None:
        arrays["camera_points_probability"] = probability
    write_arrays(path, arrays)


def read_shapes(path: Path | str) -> RecoveredShapes:
    """Read `shapes.npz` as written by `write_shapes`.

    Args:
        path: The file.

    Raises:
        FileProblem: An array is missing or has another type.
    """
    arrays = read_arrays(path, (*_FIELDS, *_TEXTS), texts=(*_TEXTS, *_WORDS))
    with consistent_arrays(path, "Give a shapes.npz as `marey nonrigid` writes it."):
        return shapes_from(arrays)


def write_residuals(path: Path | str, found: RecoveredShapes, labels: Sequence[str]) -> None:
    """Write `residuals.csv`, one row per point, in the unit of the input; cells without a result are empty.

    Args:
        path: The file.
        found: The recovered shapes.
        labels: The points' names.
    """
    residuals = found.residuals
    seen = np.isfinite(residuals)
    largest = np.where(seen, residuals, -1).max(0)
    with replacing(path) as beside, beside.open("w", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(
            ["point", "label", "frames_seen", "frames_predicted", "rms", "largest", "largest_in_frame", "median_sd"]
        )
        for p, label in enumerate(labels):
            sd = np.linalg.norm(found.shape_sd[:, :, p], axis=1)
            sd = sd[np.isfinite(sd)]
            frame = int(largest[:, p].argmax())
            known = bool(seen[:, :, p].any())
            cells = [found.point_rms[p], largest[frame, p] if known else np.nan]
            rows.writerow(
                [p, label, int(seen[:, :, p].any(0).sum()), int(found.predicted[:, p].sum())]
                + [_cell(value) for value in cells]
                + [frame if known else "", _cell(float(np.median(sd)) if len(sd) else np.nan)]
            )


def _cell(value: float) -> str:
    return "" if value != value else f"{value:.6g}"


def write_point_clouds(folder: Path, found: RecoveredShapes, edges: Integers, *, scale: float, unit: str) -> None:
    """Write one PLY per frame with a result, in the object's axes: `frame_00000.ply`, ...

    Observed points are blue, predicted ones orange; points without a result are omitted together with their edges.

    Args:
        folder: Output folder.
        found: The recovered shapes.
        edges: (E, 2) lines between points.
        scale: Factor by which lengths are multiplied.
        unit: Unit of the multiplied lengths.
    """
    for frame in np.flatnonzero(found.answered):
        colours = np.where(found.predicted[frame][:, None], _PREDICTED, _SEEN)
        write_point_cloud(
            folder / f"frame_{frame:05d}.ply", scale * found.shape[frame].T, colours,
            comment=f"{unit}, the object's axes", edges=edges,
        )  # fmt: skip


def upright(found: RecoveredShapes, *, y_up: bool = False) -> Floats:
    """Return the rotation (3, 3) from the axes of the camera or laboratory to axes with Z up.

    Args:
        found: The recovered shapes.
        y_up: Whether Y points up in the laboratory; a camera is assumed to be upright.
    """
    if found.kind not in IN_LABORATORY:
        return WORLD_FROM_CAMERA
    return WORLD_FROM_Y_UP if y_up else np.eye(3)


def write_shape_c3d(
    path: Path | str, found: RecoveredShapes, labels: Sequence[str], *, rate: float, scale: float
) -> None:
    """Write the points at their positions in space, and the object's pose as ROTATION `object_4X4`.

    The axes are those of the laboratory; for uncalibrated cameras x right, y ahead, z up.

    Args:
        path: The file.
        found: The recovered shapes.
        labels: The points' names.
        rate: Sampling rate [Hz].
        scale: Metres per unit; 0.001 where no length is known, so that one unit is written as one millimetre.
    """
    turn = upright(found)
    paths = PointPaths(
        names=tuple(labels), time=np.arange(len(found)) / rate, rate=rate,
        points=scale * np.moveaxis(turn @ found.placed, 1, 2),
    )  # fmt: skip
    write_c3d(
        path, paths, segment_names=("object",), segment_rotation=(turn @ found.rotation)[:, None],
        segment_origin=scale * (found.origin @ turn.T)[:, None],
    )  # fmt: skip
