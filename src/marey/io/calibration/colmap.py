"""Reading of calibrations of COLMAP: cameras.txt and images.txt."""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path, PurePosixPath

import numpy as np

from marey.arrays import Floats
from marey.cameras.camera import Camera
from marey.cameras.rig import Rig
from marey.errors import FileProblem
from marey.io.calibration.parts import Faults, RawCamera, make_rig, quaternion_matrix
from marey.io.documents import read_text

_REMEDY = (
    "cameras.txt should have CAMERA_ID MODEL WIDTH HEIGHT PARAMS..., and images.txt pairs of lines, the first of which "
    "is IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME; export the model as text."
)
"""Remedy in the error messages: the expected lines of both files."""
_MODELS: Mapping[str, tuple[int, tuple[int, ...], bool]] = {
    "SIMPLE_PINHOLE": (1, (), False),
    "PINHOLE": (2, (), False),
    "SIMPLE_RADIAL": (1, (0, -1, -1, -1), False),
    "RADIAL": (1, (0, 1, -1, -1), False),
    "OPENCV": (2, (0, 1, 2, 3), False),
    "FULL_OPENCV": (2, (0, 1, 2, 3, 4, 5, 6, 7), False),
    "SIMPLE_RADIAL_FISHEYE": (1, (0, -1, -1, -1), True),
    "RADIAL_FISHEYE": (1, (0, 1, -1, -1), True),
    "OPENCV_FISHEYE": (2, (0, 1, 2, 3), True),
}
"""Number of focal lengths, the place in the parameters of each coefficient of OpenCV (-1: zero), and the fisheye."""
_CORNER = 0.5
"""Coordinate of the centre of the first pixel in COLMAP, whose origin is the corner of the image [px]."""


def read_colmap(path: Path) -> Rig:
    """Read cameras.txt and images.txt from one folder.

    A camera is named like its picture, or like the folder of its pictures. COLMAP has no scale of its own: lengths are
    read as metres.

    Args:
        path: One of the two files.

    Returns:
        The cameras, in the order of their names.

    Raises:
        FileProblem: A file or a value is missing or wrong, or a camera moved; the message lists everything.
    """
    lens_path, pose_path = path.with_name("cameras.txt"), path.with_name("images.txt")
    for each in (lens_path, pose_path):
        if not each.is_file():
            raise FileProblem(each, "does not exist", "Both cameras.txt and images.txt are needed in the folder.")
    lenses, poses = _lenses(lens_path), _poses(pose_path)
    faults = Faults(pose_path, _REMEDY)
    return make_rig(faults, [_camera(faults, name, pose, lenses) for name, pose in sorted(poses.items())])


def _lenses(path: Path) -> dict[str, list[str]]:
    """Return the fields of each camera after its number."""
    found = {}
    for number, fields in _fields(path):
        if len(fields) < 5:
            raise FileProblem(path, f"has {len(fields)} fields in line {number}; at least 5 are expected", _REMEDY)
        found[fields[0]] = fields[1:]
    return found


def _poses(path: Path) -> dict[str, list[str]]:
    """Return the fields of the pose of each camera by its name, without the number of the image."""
    found: dict[str, list[str]] = {}
    lines = iter(enumerate(read_text(path, _REMEDY).splitlines(), 1))
    for number, line in lines:
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        fields = line.split(maxsplit=9)
        if len(fields) < 10:
            raise FileProblem(path, f"has {len(fields)} fields in line {number}; 10 are expected", _REMEDY)
        name = _camera_name(fields[9].strip())
        if found.setdefault(name, fields[1:9]) != fields[1:9]:
            wrong = f"has several poses of camera '{name}' (line {number})"
            raise FileProblem(path, wrong, "Only cameras that stand still can be used: keep one picture of each.")
        # The second line of an image holds its points, and may be empty.
        next(lines, None)
    return found


def _fields(path: Path) -> Iterator[tuple[int, list[str]]]:
    for number, line in enumerate(read_text(path, _REMEDY).splitlines(), 1):
        if line.strip() and not line.lstrip().startswith("#"):
            yield number, line.split()


def _camera_name(picture: str) -> str:
    """Return the camera of a picture: its folder, or its name without ending (and without a number after `_frame`)."""
    path = PurePosixPath(picture.replace("\\", "/"))
    if path.is_absolute() or ".." in path.parts:
        return picture
    return path.parts[0] if len(path.parts) > 1 else re.sub(r"\.\w+$", "", path.name)


def _camera(faults: Faults, name: str, pose: list[str], lenses: Mapping[str, list[str]]) -> Camera | None:
    lens = lenses.get(pose[7])
    if lens is None:
        faults.add(name, [f"uses the camera {pose[7]}, which cameras.txt does not have"])
        return None
    model = _MODELS.get(lens[0])
    if model is None:
        faults.add(name, [f"has the lens model {lens[0]}; the known ones are {', '.join(_MODELS)}"])
        return None
    try:
        size, parameters = [float(part) for part in lens[1:3]], np.array([float(part) for part in lens[3:]])
        quaternion, shift = np.array([float(part) for part in pose[:4]]), [float(part) for part in pose[4:7]]
    except ValueError as error:
        faults.add(name, [f"has a value that is not a number ({error})"])
        return None
    inner = _inner(parameters, model)
    if inner is None:
        faults.add(name, [f"has {len(parameters)} parameters, which do not fit the lens model {lens[0]}"])
        return None
    raw = RawCamera(
        name=name, size=size, matrix=inner[0], distortion=inner[1], rotation=quaternion_matrix(quaternion),
        translation=shift, fisheye=model[2],
    )  # fmt: skip
    return raw.checked(faults)


def _inner(parameters: Floats, model: tuple[int, tuple[int, ...], bool]) -> tuple[Floats, Floats] | None:
    """Return the matrix (3, 3) and the distortion coefficients in OpenCV's order."""
    focals, places, _ = model
    if len(parameters) != focals + 2 + len({place for place in places if place >= 0}):
        return None
    focal, centre, lens = parameters[:focals], parameters[focals : focals + 2] - _CORNER, parameters[focals + 2 :]
    matrix = np.array([[focal[0], 0, centre[0]], [0, focal[-1], centre[1]], [0, 0, 1]])
    return matrix, np.array([lens[place] if place >= 0 else 0.0 for place in places])
