"""Reading of calibrations in TOML: the format of Pose2Sim and Anipose, and that of Caliscope."""

import tomllib
from pathlib import Path
from typing import Any

from marey.cameras.camera import Camera
from marey.cameras.rig import Rig
from marey.errors import FileProblem
from marey.io.calibration.parts import Faults, RawCamera, make_rig

_KEYS = ("size", "matrix", "distortions", "rotation", "translation")
"""Keys that each camera must have."""
_REMEDY = (
    "Each camera is a table with size = [width, height], matrix (3 x 3, px), distortions (k1 k2 p1 p2 [k3 ...]), "
    "rotation (axis times angle) and translation (m), both from world to camera."
)
"""Remedy in the error messages: the expected keys of a camera."""


def read_tables(path: Path) -> dict[str, Any]:
    """Read a TOML file.

    Args:
        path: The file.

    Returns:
        Its tables.

    Raises:
        FileProblem: The file cannot be read, or is not TOML.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        remedy = "Check its name and its permissions."
        raise FileProblem(path, f"cannot be read ({error.strerror})", remedy) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise FileProblem(path, f"is not TOML: {error}", "Correct that line.") from error


def read_toml(path: Path) -> Rig:
    """Read a calibration in the format of Pose2Sim and Anipose, or in that of Caliscope.

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
    # Other programs store further tables beside the cameras: metadata, boards, ground planes.
    cameras = {key: table for key, table in tables.items() if isinstance(table, dict) and set(_KEYS) & set(table)}
    if not cameras:
        raise FileProblem(path, "has no camera", _REMEDY)
    faults = Faults(path, _REMEDY)
    return make_rig(faults, [_camera(faults, str(table.get("name", key)), table) for key, table in cameras.items()])


def _camera(faults: Faults, name: str, table: dict[str, Any]) -> Camera | None:
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
        distortion=table["distortions"],
        rotation=table["rotation"],
        translation=table["translation"],
        fisheye=fisheye,
    )
    return raw.checked(faults)


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
