"""Reading of calibrations in two YAML files of OpenCV, named as by EasyMocap: intri.yml and extri.yml."""

from collections.abc import Mapping
from pathlib import Path
from typing import TypeAlias

import numpy as np

from marey.arrays import Floats
from marey.cameras.camera import Camera
from marey.cameras.rig import Rig
from marey.errors import FileProblem
from marey.io.calibration.parts import Faults, RawCamera, make_rig
from marey.io.calibration.yaml_text import Value, read_yaml
from marey.io.file_names import name_faults
from marey.io.video.clip_files import pictures_of
from marey.io.video.video import open_clip

_REMEDY = (
    "intri.yml should have names, K_NAME (3 x 3, px), dist_NAME, and W_NAME and H_NAME (px); "
    "extri.yml should have R_NAME (axis times angle) or Rot_NAME (3 x 3), and T_NAME (m), world to camera."
)
"""Remedy in the error messages: the expected keys of both files."""
_FOLDERS = ("", "videos", "images")
"""Sub-folders in which the videos are, from which a missing size is read."""

_Tables: TypeAlias = Mapping[str, Value]
"""The content of a file."""


def read_opencv_pair(path: Path) -> Rig:
    """Read intri.yml and extri.yml from one folder.

    If the files have no image size (older ones do not), it is read from the camera's video or image in the folder or
    its `videos` or `images`.

    Args:
        path: One of the two files.

    Returns:
        The cameras.

    Raises:
        FileProblem: A file or a value is missing or wrong; the message lists everything.
    """
    inner_path = path.with_name(path.name.replace("extri", "intri"))
    outer_path = path.with_name(path.name.replace("intri", "extri"))
    if inner_path == outer_path:
        raise FileProblem(path, "is neither intri.yml nor extri.yml", "Give the two files these names.")
    inner, outer = _open(inner_path), _open(outer_path)
    faults = Faults(inner_path, _REMEDY)
    names = _names(inner) or _names(outer)
    if not names:
        raise FileProblem(inner_path, "has no list called names", _REMEDY)
    return make_rig(faults, [_camera(faults, name, inner, outer, path.parent) for name in names])


def _open(path: Path) -> _Tables:
    if not path.is_file():
        raise FileProblem(path, "does not exist", "Both intri.yml and extri.yml are needed in the folder.")
    return read_yaml(path, "It should be a YAML file as OpenCV writes it.")


def _names(tables: _Tables) -> list[str]:
    names = tables.get("names")
    return [name for name in names if isinstance(name, str)] if isinstance(names, list) else []


def _matrix(tables: _Tables, key: str) -> Floats | None:
    """Return a matrix; None if it is missing, or if its numbers do not fit its rows and columns."""
    table = tables.get(key)
    data = table.get("data") if isinstance(table, dict) else None
    if not isinstance(table, dict) or not isinstance(data, list):
        return None
    try:
        numbers = np.array([float(str(number)) for number in data])
        rows, columns = int(str(table.get("rows"))), int(str(table.get("cols")))
    except ValueError:
        return None
    return numbers.reshape(rows, columns) if min(rows, columns) > 0 and rows * columns == len(numbers) else None


def _number(tables: _Tables, key: str) -> float | None:
    try:
        return float(str(tables.get(key)))
    except ValueError:
        return None


def _camera(faults: Faults, name: str, inner: _Tables, outer: _Tables, folder: Path) -> Camera | None:
    unusable = name_faults(name)
    if unusable:
        faults.add(name, unusable)
        return None
    # Old files of EasyMocap name the distortion D_.
    matrix, lens = _matrix(inner, f"K_{name}"), _matrix(inner, f"dist_{name}")
    lens = _matrix(inner, f"D_{name}") if lens is None else lens
    rotation, shift = _matrix(outer, f"Rot_{name}"), _matrix(outer, f"T_{name}")
    if rotation is None and (vector := _matrix(outer, f"R_{name}")) is not None:
        rotation = vector if vector.shape == (3, 3) else vector.ravel()
    size = _size(inner, name, folder)
    wanted = {f"K_{name}": matrix, f"dist_{name}": lens, f"R_{name}": rotation, f"T_{name}": shift}
    missing = [key for key, value in wanted.items() if value is None]
    missing += [f"W_{name}, no H_{name} and no video with its size"] if size is None else []
    if missing or lens is None or shift is None:
        faults.add(name, [f"has no {key}" for key in missing])
        return None
    raw = RawCamera(
        name=name,
        size=size,
        matrix=matrix,
        distortion=lens.ravel(),
        rotation=rotation,
        translation=shift.ravel(),
    )
    return raw.checked(faults)


def _size(inner: _Tables, name: str, folder: Path) -> tuple[float, float] | None:
    width, height = _number(inner, f"W_{name}"), _number(inner, f"H_{name}")
    if width is not None and height is not None:
        return width, height
    for place in (folder / inside for inside in _FOLDERS):
        pictures = pictures_of(place, name) if place.is_dir() else ()
        if pictures:
            return open_clip(pictures[0]).size
    return None
