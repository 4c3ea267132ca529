"""Reading of calibrations in TOML: the format of Pose2Sim, Anipose and FreeMoCap, and that of Caliscope."""

from pathlib import Path
from typing import Any

import numpy as np

from marey.cameras.camera import Camera
from marey.cameras.rig import Rig
from marey.errors import FileProblem
from marey.io.calibration.parts import Faults, RawCamera, make_rig
from marey.io.documents import finite, numbers, read_tables

_KEYS = ("size", "matrix", "distortions", "rotation", "translation")
"""Keys that each camera must have."""
_REMEDY = (
    "Each camera is a table with size = [width, height], matrix (3 x 3, px), distortions (k1 k2 p1 p2 [k3 ...]), "
    "rotation (axis times angle) and translation (m), both from world to camera."
)
"""Remedy in the error messages: the expected keys of a camera."""


def read_toml(path: Path) -> Rig:
    """Read a calibration in the format of Pose2Sim, Anipose and FreeMoCap, or in that of Caliscope.

    FreeMoCap writes millimetres, and the side of the squares among the metadata.

    Args:
        path: The file.

    Returns:
        The cameras.

    Raises:
        FileProblem: A key is missing or wrong; the message lists all faults.
    """
    tables = read_tables(path)
    nested = tables.get("cameras")
    if isinstance(nested, dict) and all(isinstance(table, dict) for table in nested.values()):
        return _read_caliscope(path, nested)
    metadata = tables.get("metadata")
    if isinstance(metadata, dict) and metadata.get("poses_known") is False:
        wrong = "holds the lenses of cameras that were calibrated apart, not their poses"
        raise FileProblem(path, wrong, "Film the board with all cameras at the same time, and calibrate again.")
    unit = _unit(path, metadata if isinstance(metadata, dict) else {})
    # Other programs store further tables beside the cameras: metadata, boards, ground planes.
    cameras = {key: table for key, table in tables.items() if isinstance(table, dict) and set(_KEYS) & set(table)}
    cameras = {key: table for key, table in cameras.items() if table.get("ignore") is not True}
    if not cameras:
        raise FileProblem(path, "has no camera", _REMEDY)
    faults = Faults(path, _REMEDY)
    made = [_camera(faults, str(table.get("name", key)), table, unit=unit) for key, table in cameras.items()]
    return make_rig(faults, made)


def _unit(path: Path, metadata: dict[str, Any]) -> float:
    """Return the unit of lengths [m], for which the side of the squares that FreeMoCap was given is evidence."""
    side = metadata.get("charuco_square_size")
    if isinstance(side, bool) or not isinstance(side, int | float):
        return 1.0
    if side == 1:
        wrong = "was made by FreeMoCap with squares of size 1, so its unit of length is not known"
        raise FileProblem(path, wrong, "Calibrate again with the side of a square in millimetres.")
    return 0.001 if side > 1 else 1.0


def _camera(faults: Faults, name: str, table: dict[str, Any], *, unit: float = 1.0) -> Camera | None:
    missing = [key for key in _KEYS if key not in table]
    if missing:
        faults.add(name, [f"has no {' and no '.join(missing)}"])
        return None
    fisheye = table.get("fisheye", False)
    if not isinstance(fisheye, bool):
        faults.add(name, [f"has fisheye = {fisheye!r}; it must be true or false"])
        return None
    raw = RawCamera(
        name=name,
        size=table["size"],
        matrix=table["matrix"],
        distortion=_flat(table["distortions"]),
        rotation=table["rotation"],
        translation=_scaled(table["translation"], unit),
        fisheye=fisheye,
    )
    return raw.checked(faults)


def _flat(value: object) -> object:
    """Return a list of numbers from a matrix with one row or one column; anything else as it is."""
    nested = numbers(value, np.shape(value)) if isinstance(value, list) and value and _is_nested(value) else None
    return value if nested is None or max(nested.shape) != nested.size else nested.ravel()


def _is_nested(value: list[Any]) -> bool:
    return all(isinstance(row, list) and len(row) == len(value[0]) for row in value)


def _scaled(value: object, unit: float) -> object:
    """Return a translation in metres; anything that is not numbers as it is."""
    vector = finite(value, (3,))
    return value if vector is None or unit == 1 else vector * unit


def _read_caliscope(path: Path, cameras: dict[str, dict[str, Any]]) -> Rig:
    """Read the cameras of Caliscope, named cam_N like its videos.

    The calibration refers to the stored images, so `rotation_count`, by which Caliscope rotates them for display, is
    not needed.
    """
    faults = Faults(path, _REMEDY)
    made = []
    for key, table in cameras.items():
        number = table.get("cam_id", table.get("port", key))
        if not table.get("ignore", False):
            made.append(_camera(faults, f"cam_{number}", table))
    return make_rig(faults, made)
