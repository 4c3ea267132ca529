"""Reading of camera calibrations in any known format."""

import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np

from marey.cameras.camera import Camera
from marey.cameras.rig import Rig
from marey.errors import FileProblem
from marey.io.atomic import replacing
from marey.io.calibration.colmap import read_colmap
from marey.io.calibration.opencap import camera_files, read_opencap
from marey.io.calibration.opencv import read_opencv_pair
from marey.io.calibration.qualisys import read_qualisys
from marey.io.calibration.toml import read_toml
from marey.io.calibration.vicon import read_vicon

_KNOWN = (
    "cameras.toml (Pose2Sim, Anipose, FreeMoCap or Caliscope), intri.yml with extri.yml (OpenCV, EasyMocap), *.qca.txt "
    "(Qualisys), *.xcp (Vicon), cameras.txt with images.txt (COLMAP), or cameraIntrinsicsExtrinsics.pickle (OpenCap)"
)
"""Description of the known formats, for the error messages."""
_PATTERNS = (
    "cameras.toml",
    "Calib*.toml",
    "calib*.toml",
    "camera_array.toml",
    "*_camera_calibration.toml",
    "intri.yml",
    "extri.yml",
    "*.qca.txt",
    "*.qca",
    "*.xcp",
    "cameras.txt",
)
"""File names of calibrations, in the order in which a folder is searched."""
_GREATEST_SPREAD = 200.0
"""Largest distance of a camera from the mean of all [m]; beyond it, the unit is not the metre. Chosen by hand."""


def read_rig(path: Path | str) -> Rig:
    """Read a calibration in any known format.

    Args:
        path: The file, or a folder that contains one.

    Returns:
        The cameras, with positions in metres.

    Raises:
        FileProblem: There is no calibration, or it cannot be used; the message lists all faults.
    """
    path = calibration_file(Path(path))
    rig = read_opencap(path) if path.is_dir() else _reader(path)(path)
    spread = float(np.linalg.norm(rig.centres - rig.centres.mean(axis=0), axis=1).max())
    if spread > _GREATEST_SPREAD:
        wrong = f"has cameras {spread:.0f} m from their mean position, so the translations are not in metres"
        raise FileProblem(path, wrong, "Divide them by 1000 if they are in millimetres.")
    return rig


def calibration_file(path: Path) -> Path:
    """Find the calibration in a folder; the path of a file is returned as it is.

    Args:
        path: A file or folder.

    Returns:
        The file to read; the folder itself if it has one file for each camera, as that of an OpenCap session.

    Raises:
        FileProblem: The path does not exist, or the folder does not contain exactly one calibration.
    """
    found = found_calibration(path)
    if found is None:
        raise FileProblem(path, "has no calibration of the cameras", f"Add {_KNOWN}.")
    return found


def found_calibration(path: Path) -> Path | None:
    """Find the calibration in a folder as `calibration_file` does, but return None if there is none.

    Args:
        path: A file or folder.

    Raises:
        FileProblem: The path does not exist, or the folder contains several calibrations.
    """
    if path.is_file():
        return path
    if not path.is_dir():
        raise FileProblem(path, "does not exist", f"Give a folder with {_KNOWN}.")
    for pattern in _PATTERNS:
        found = sorted(path.glob(pattern))
        if len(found) > 1:
            names = ", ".join(file.name for file in found)
            remedy = f'Keep one of them, or name it in trial.toml: calibration = "{found[0].name}".'
            raise FileProblem(path, f"has several calibrations ({names})", remedy)
        if found:
            return found[0]
    return path if camera_files(path) else None


def calibration_parts(path: Path) -> tuple[Path, ...]:
    """Return all files of a calibration, some of which have two, or one for each camera.

    Args:
        path: The calibration, as `calibration_file` returns it.
    """
    if path.is_dir() or path.suffix.lower() in (".pickle", ".pkl"):
        return tuple(camera_files(path).values())
    both = {"cameras.txt": "images.txt", "images.txt": "cameras.txt"}.get(path.name.lower())
    if path.suffix.lower() in (".yml", ".yaml"):
        both = path.name.replace("intri", "extri") if "intri" in path.name else path.name.replace("extri", "intri")
    return (path,) if both is None else (path, path.with_name(both))


def _reader(path: Path) -> Callable[[Path], Rig]:
    """Choose the reader by the file's name."""
    name = path.name.lower()
    if name.endswith(".toml"):
        return read_toml
    if name.endswith((".yml", ".yaml")):
        return read_opencv_pair
    if name.endswith((".qca.txt", ".qca", ".xml")):
        return read_qualisys
    if name.endswith(".xcp"):
        return read_vicon
    if name in ("cameras.txt", "images.txt"):
        return read_colmap
    if name.endswith((".pickle", ".pkl")):
        return read_opencap
    raise FileProblem(path, "is not a calibration of a known format", f"The known formats are {_KNOWN}.")


def write_cameras_toml(rig: Rig, path: Path, *, poses_known: bool = True) -> None:
    """Write a calibration in the format of Pose2Sim and Anipose.

    Args:
        rig: The cameras.
        path: The file, usually `cameras.toml`; it is complete or absent.
        poses_known: Whether the poses of the cameras are meant; if not, the file says so and is not read as a rig.
    """
    tables = [_table(key, camera) for key, camera in zip(_keys(rig.names), rig, strict=True)]
    metadata = "[metadata]\nadjusted = true\nerror = 0.0\n" + ("" if poses_known else "poses_known = false\n")
    with replacing(path) as beside:
        beside.write_text("\n".join([*tables, metadata]), encoding="utf-8")


def _keys(names: Sequence[str]) -> list[str]:
    """Return the names of the tables: those of the cameras, in quotes where TOML needs them."""
    plain = [name if name != "metadata" else "camera_metadata" for name in names]
    return [name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else toml_text(name) for name in plain]


def toml_text(text: str) -> str:
    """Return a text as a string of TOML."""
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return '"' + "".join(c if c.isprintable() else f"\\U{ord(c):08x}" for c in escaped) + '"'


def _table(key: str, camera: Camera) -> str:
    pose = camera.camera_from_world
    # The other programs of this format expect at least four numbers, also for a lens without distortion.
    distortion = camera.distortion if len(camera.distortion) else np.zeros(4)
    return "\n".join(
        [
            f"[{key}]",
            f"name = {toml_text(camera.name)}",
            f"size = {_toml_array(camera.size)}",
            f"matrix = [{', '.join(_toml_array(row) for row in camera.matrix)}]",
            f"distortions = {_toml_array(distortion)}",
            f"rotation = {_toml_array(pose.rotation_vector)}",
            f"translation = {_toml_array(pose.translation)}",
            f"fisheye = {str(camera.fisheye).lower()}",
            "",
        ]
    )


def _toml_array(values: Iterable[float]) -> str:
    """Return numbers as TOML floats that are read back without rounding."""
    return "[" + ", ".join(repr(float(value)) for value in values) + "]"
