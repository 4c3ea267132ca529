"""Writing of camera calibrations in the formats of other programs."""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.cameras.camera import Camera
from marey.cameras.rig import Rig
from marey.errors import FileProblem, SettingProblem
from marey.io.atomic import replacing
from marey.io.calibration.readers import write_cameras_toml

_SAFE_KEY = re.compile(r"[A-Za-z0-9_\-]+")
"""Names of cameras that can be parts of the keys of OpenCV's YAML."""


def write_rig(rig: Rig, path: Path, *, to: str) -> tuple[Path, ...]:
    """Write a calibration in the format of another program.

    Args:
        rig: The cameras.
        path: The file, or the folder for files of fixed names; a name with an ending is a file.
        to: The format, a key of `FORMATS`.

    Returns:
        The files.

    Raises:
        SettingProblem: The format is not known, or cannot hold these cameras.
        FileProblem: A file exists already, or cannot be written.
    """
    if to not in FORMATS:
        raise SettingProblem(f"There is no format '{to}'; the formats are {', '.join(FORMATS)}.")
    names, write = FORMATS[to]
    folder = path.parent if path.suffix else path
    files = (path,) if path.suffix and len(names) == 1 else tuple(folder / name for name in names)
    if path.suffix and len(names) > 1 and path.name not in names:
        raise SettingProblem(f"The format '{to}' has the files {' and '.join(names)}: give a folder (--out).")
    there = [file for file in files if file.exists()]
    if there:
        raise FileProblem(there[0], "already exists", "Give another name (--out), or remove it.")
    write(rig, files)
    return files


def caliscope_numbers(names: Sequence[str]) -> dict[str, int]:
    """Return the numbers by which Caliscope names cameras: those at the end of their names, or else 0, 1, ...

    Args:
        names: Names of the cameras.
    """
    found = [re.search(r"(\d{1,9})$", name) for name in names]
    numbers = [int(match[1]) for match in found if match]
    if len(numbers) < len(names) or len(set(numbers)) < len(numbers):
        numbers = list(range(len(names)))
    return dict(zip(names, numbers, strict=True))


def _write_anipose(rig: Rig, files: Sequence[Path]) -> None:
    write_cameras_toml(rig, files[0])


def _write_caliscope(rig: Rig, files: Sequence[Path]) -> None:
    """Write camera_array.toml, whose cameras have numbers in place of names."""
    numbers = caliscope_numbers(rig.names)
    tables = [_caliscope_table(numbers[camera.name], camera) for camera in rig]
    with replacing(files[0]) as beside:
        beside.write_text("\n".join(tables), encoding="utf-8")


def _caliscope_table(number: int, camera: Camera) -> str:
    pose = camera.camera_from_world
    distortion = camera.distortion if camera.fisheye else _padded(camera.distortion)
    rows = ", ".join(_numbers(row) for row in camera.matrix)
    lines = [
        f"[cameras.{number}]", f"cam_id = {number}", "rotation_count = 0",
        f"size = [{camera.width}, {camera.height}]", f"matrix = [{rows}]", f"distortions = {_numbers(distortion)}",
        f"translation = {_numbers(pose.translation)}", f"rotation = {_numbers(pose.rotation_vector)}",
        f"fisheye = {str(camera.fisheye).lower()}", "",
    ]  # fmt: skip
    return "\n".join(lines)


def _write_opencv(rig: Rig, files: Sequence[Path]) -> None:
    """Write intri.yml and extri.yml."""
    unsafe = [camera.name for camera in rig if not _SAFE_KEY.fullmatch(camera.name)]
    if unsafe:
        raise SettingProblem(
            f"The camera '{unsafe[0]}' cannot be written as YAML of OpenCV, whose names have only letters, digits, "
            "hyphens and underscores."
        )
    fisheye = [camera.name for camera in rig if camera.fisheye]
    if fisheye:
        raise SettingProblem(
            f"The camera '{fisheye[0]}' has a fisheye lens, which the YAML of OpenCV cannot state; use pose2sim."
        )
    names = "names:\n" + "".join(f'   - "{camera.name}"\n' for camera in rig)
    inner = "".join(_opencv_lens(camera) for camera in rig)
    outer = "".join(_opencv_pose(camera) for camera in rig)
    with replacing(files[0]) as first, replacing(files[1]) as second:
        first.write_text("%YAML:1.0\n---\n" + names + inner, encoding="utf-8")
        second.write_text("%YAML:1.0\n---\n" + names + outer, encoding="utf-8")


def _opencv_lens(camera: Camera) -> str:
    distortion = _padded(camera.distortion)
    return (
        _opencv_matrix(f"K_{camera.name}", camera.matrix)
        + _opencv_matrix(f"dist_{camera.name}", distortion[None])
        + f"H_{camera.name}: {camera.height}\nW_{camera.name}: {camera.width}\n"
    )


def _opencv_pose(camera: Camera) -> str:
    pose = camera.camera_from_world
    return (
        _opencv_matrix(f"R_{camera.name}", pose.rotation_vector[:, None])
        + _opencv_matrix(f"Rot_{camera.name}", pose.rotation)
        + _opencv_matrix(f"T_{camera.name}", pose.translation[:, None])
    )


def _opencv_matrix(key: str, matrix: Floats) -> str:
    rows, columns = matrix.shape
    head = f"{key}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n"
    return head + f"   data: {_numbers(matrix.ravel())}\n"


def _padded(distortion: Floats) -> Floats:
    """Return at least the five coefficients that the programs expect."""
    return np.pad(distortion, (0, max(5 - len(distortion), 0)))


def _numbers(values: Iterable[float]) -> str:
    """Return numbers in brackets that are read back without rounding."""
    return "[" + ", ".join(repr(float(value)) for value in values) + "]"


FORMATS: Mapping[str, tuple[tuple[str, ...], Callable[[Rig, Sequence[Path]], None]]] = {
    "pose2sim": (("cameras.toml",), _write_anipose),
    "anipose": (("calibration.toml",), _write_anipose),
    "caliscope": (("camera_array.toml",), _write_caliscope),
    "opencv": (("intri.yml", "extri.yml"), _write_opencv),
    "easymocap": (("intri.yml", "extri.yml"), _write_opencv),
}
"""Names of the files of each format, and the function that writes them."""
