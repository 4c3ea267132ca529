"""One door to camera calibrations: Pose2Sim, Anipose, Caliscope, OpenCV's YAML pair and Qualisys."""

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from marey.cameras.camera import Camera
from marey.cameras.rig import Rig
from marey.errors import FileProblem
from marey.io.calibration.opencv import read_opencv_pair
from marey.io.calibration.qualisys import read_qualisys
from marey.io.calibration.toml import read_toml

_KNOWN = "cameras.toml (Pose2Sim, Anipose or Caliscope), intri.yml with extri.yml (OpenCV), or *.qca.txt (Qualisys)"
_PATTERNS = (
    "cameras.toml",
    "Calib*.toml",
    "calib*.toml",
    "camera_array.toml",
    "intri.yml",
    "extri.yml",
    "*.qca.txt",
    "*.qca",
)
_GREATEST_SPREAD = 200.0
"""Cameras further apart than this [m] were written in millimetres or in squares of a board."""


def read_rig(path: Path | str) -> Rig:
    """Read a calibration in any layout that is known.

    Args:
        path: The file, or a folder that holds one.

    Returns:
        The cameras, in metres.

    Raises:
        FileProblem: There is no calibration, or it cannot be used; the message lists everything that is wrong in it.
    """
    path = calibration_file(Path(path))
    rig = _reader(path)(path)
    spread = float(np.linalg.norm(rig.centres - rig.centres.mean(axis=0), axis=1).max())
    if spread > _GREATEST_SPREAD:
        wrong = f"puts cameras {spread:.0f} m from their middle; the translations are not in metres"
        raise FileProblem(path, wrong, "Divide them by 1000 if they are in millimetres.")
    return rig


def calibration_file(path: Path) -> Path:
    """Find the calibration in a folder; a file is its own answer.

    Args:
        path: A file or folder.

    Returns:
        The file to read.

    Raises:
        FileProblem: The path does not exist, or the folder holds no calibration.
    """
    if path.is_file():
        return path
    if not path.is_dir():
        raise FileProblem(path, "does not exist", f"Give a folder with {_KNOWN}.")
    for pattern in _PATTERNS:
        found = sorted(path.glob(pattern))
        if len(found) > 1:
            names = ", ".join(file.name for file in found)
            raise FileProblem(path, f"holds several calibrations ({names})", "Keep one, called cameras.toml.")
        if found:
            return found[0]
    raise FileProblem(path, "holds no calibration of the cameras", f"Put {_KNOWN} there.")


def _reader(path: Path) -> Callable[[Path], Rig]:
    """Choose the reader by the file's name."""
    name = path.name.lower()
    if name.endswith(".toml"):
        return read_toml
    if name.endswith((".yml", ".yaml")):
        return read_opencv_pair
    if name.endswith((".qca.txt", ".qca", ".xml")):
        return read_qualisys
    raise FileProblem(path, "is no calibration that is known", f"Known are {_KNOWN}.")


def write_cameras_toml(rig: Rig, path: Path) -> None:
    """Write a calibration in the layout of Pose2Sim and Anipose.

    Args:
        rig: The cameras.
        path: The file, usually `cameras.toml`.
    """
    tables = [_table(camera) for camera in rig]
    path.write_text("\n".join([*tables, "[metadata]\nadjusted = true\nerror = 0.0\n"]), encoding="utf-8")


def _table(camera: Camera) -> str:
    key = "".join(letter if letter.isalnum() or letter in "_-" else "_" for letter in camera.name)
    name = camera.name.replace("\\", "\\\\").replace('"', '\\"')
    pose = camera.camera_from_world
    # Four numbers at least: that is what the programs that share this layout expect of a lens without distortion.
    distortion = camera.distortion if len(camera.distortion) else np.zeros(4)
    return "\n".join(
        [
            f"[{key}]",
            f'name = "{name}"',
            f"size = {_listed(camera.size)}",
            f"matrix = [{', '.join(_listed(row) for row in camera.matrix)}]",
            f"distortions = {_listed(distortion)}",
            f"rotation = {_listed(pose.rotation_vector)}",
            f"translation = {_listed(pose.translation)}",
            f"fisheye = {str(camera.fisheye).lower()}",
            "",
        ]
    )


def _listed(values: Iterable[float]) -> str:
    """Write numbers so that reading gives back the same bits, and as TOML floats."""
    return "[" + ", ".join(repr(float(value)) for value in values) + "]"
