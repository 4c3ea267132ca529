"""Reading of calibrations in two YAML files of OpenCV, named as by EasyMocap: intri.yml and extri.yml."""

from pathlib import Path

import cv2
import numpy as np

from marey.arrays import Floats
from marey.cameras.camera import Camera
from marey.cameras.rig import Rig
from marey.errors import FileProblem
from marey.io.calibration.parts import Faults, RawCamera, make_rig
from marey.io.video.take import pictures_of
from marey.io.video.video import open_clip

_REMEDY = (
    "intri.yml should have names, K_NAME (3 x 3, px), dist_NAME, and W_NAME and H_NAME (px); "
    "extri.yml should have R_NAME (axis times angle) or Rot_NAME (3 x 3), and T_NAME (m), world to camera."
)
"""Remedy in the error messages: the expected keys of both files."""


def read_opencv_pair(path: Path) -> Rig:
    """Read intri.yml and extri.yml from one folder.

    If the files have no image size (older ones do not), it is read from the camera's video or image in the folder.

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


def _open(path: Path) -> cv2.FileStorage:
    if not path.is_file():
        raise FileProblem(path, "does not exist", "Both intri.yml and extri.yml are needed in the folder.")
    try:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    except (cv2.error, SystemError) as error:
        raise FileProblem(path, "is not a YAML file of OpenCV", "Its first line should be %YAML:1.0.") from error
    if not storage.isOpened():
        raise FileProblem(path, "cannot be opened as a YAML file of OpenCV", "Its first line should be %YAML:1.0.")
    return storage


def _names(storage: cv2.FileStorage) -> list[str]:
    node = storage.getNode("names")
    return [node.at(i).string() for i in range(node.size())] if node.isSeq() else []


def _matrix(storage: cv2.FileStorage, key: str) -> Floats | None:
    node = storage.getNode(key)
    if node.empty() or not node.isMap():
        return None
    matrix = node.mat()
    return None if matrix is None else np.asarray(matrix, float)


def _number(storage: cv2.FileStorage, key: str) -> int | None:
    node = storage.getNode(key)
    return int(node.real()) if node.isInt() or node.isReal() else None


def _camera(faults: Faults, name: str, inner: cv2.FileStorage, outer: cv2.FileStorage, folder: Path) -> Camera | None:
    matrix, lens = _matrix(inner, f"K_{name}"), _matrix(inner, f"dist_{name}")
    rotation, shift = _matrix(outer, f"Rot_{name}"), _matrix(outer, f"T_{name}")
    if rotation is None and (vector := _matrix(outer, f"R_{name}")) is not None:
        rotation = vector.ravel()
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


def _size(inner: cv2.FileStorage, name: str, folder: Path) -> tuple[int, int] | None:
    width, height = _number(inner, f"W_{name}"), _number(inner, f"H_{name}")
    if width is not None and height is not None:
        return width, height
    pictures = pictures_of(folder, name)
    return open_clip(pictures[0]).size if pictures else None
