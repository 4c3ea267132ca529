"""Reading of the uncertainty of cameras from calibration.json, which `marey calibrate` leaves beside cameras.toml."""

from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.cameras.parameters import PARAMETER_NAMES
from marey.cameras.rig import Rig
from marey.errors import FileProblem
from marey.io.documents import read_json_table

COVARIANCE_FILE = "calibration.json"
"""Name of the file beside the cameras."""
SAME_PX = 0.01
"""Largest difference of the focal lengths of the same camera in both files [px]; only rounding is allowed."""
_REMEDY = "Copy cameras.toml and calibration.json from one folder of `marey calibrate`, or remove calibration.json."
"""Remedy in the error messages."""


def read_camera_covariance(calibration: Path, rig: Rig) -> Floats | None:
    """Read the covariance of the parameters of cameras.

    Args:
        calibration: The file of the cameras; calibration.json is beside it.
        rig: C cameras of that file.

    Returns:
        (15 C, 15 C) in the order of `marey.cameras.parameters.PARAMETER_NAMES`; None without the file, and if it states
        no covariance of all of these cameras.

    Raises:
        FileProblem: The file is damaged, or is that of other cameras.
    """
    path = calibration.parent / COVARIANCE_FILE
    if not path.is_file():
        return None
    content = read_json_table(path, _REMEDY)
    try:
        stated = content.get("covariance")
        if stated is None or content.get("together") is False:
            return None
        rows = {name: k for k, name in enumerate(stated["parameters"])}
        matrix = np.array(stated["matrix"], float)
        lenses = {name: float(camera["lens"]["fx"]["value"]) for name, camera in content["cameras"].items()}
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
        raise FileProblem(path, "is not a calibration of marey", _REMEDY) from error
    wanted = [f"{name}.{key}" for name in rig.names for key in PARAMETER_NAMES]
    if any(name not in rows for name in wanted):
        return None
    if matrix.shape != (len(rows), len(rows)) or not np.isfinite(matrix).all():
        raise FileProblem(path, "has a covariance whose size is not that of its parameters", _REMEDY)
    for camera in rig:
        if abs(lenses.get(camera.name, np.nan) - camera.matrix[0, 0]) > SAME_PX:
            raise FileProblem(path, f"states another focal length of '{camera.name}' than {calibration.name}", _REMEDY)
    index = [rows[name] for name in wanted]
    return matrix[np.ix_(index, index)]
