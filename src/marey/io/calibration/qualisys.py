"""Reading of calibrations of Qualisys Track Manager: .qca.txt, an XML file."""

from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from marey.arrays import Floats
from marey.cameras.camera import Camera
from marey.cameras.rig import Rig
from marey.errors import FileProblem
from marey.io.calibration.parts import Faults, RawCamera, make_rig
from marey.io.documents import read_xml

_REMEDY = "Export the calibration from Qualisys Track Manager again."
"""Remedy in the error messages."""
_VIDEO_MODELS = ("video", "none")
"""Words in the model of a camera that records videos, or of one that another program wrote."""
_FOV = ("left", "top", "right", "bottom")
"""Attributes of a field of view [px]."""
_TRANSFORM = ("x", "y", "z", "r11", "r12", "r13", "r21", "r22", "r23", "r31", "r32", "r33")
"""Attributes of the pose: centre [mm] and rotation matrix."""
_INTRINSIC = (
    *("sensorMinU", "sensorMaxU", "focalLengthU", "focalLengthV", "centerPointU", "centerPointV", "skew"),
    *("radialDistortion1", "radialDistortion2", "radialDistortion3", "tangentalDistortion1", "tangentalDistortion2"),
)
"""Attributes of the intrinsic parameters, as spelled by Qualisys."""
_CAMERA_FROM_QUALISYS = np.diag([1.0, -1.0, -1.0])
"""(3, 3) Rotation from the camera axes of Qualisys, which look along -z with y up."""


def read_qualisys(path: Path) -> Rig:
    """Read the cameras of a Qualisys calibration, named by their serial numbers.

    The calibration refers to the unrotated image of the sensor; a video rotated for viewing has another size.

    Args:
        path: The file.

    Returns:
        The active cameras.

    Raises:
        FileProblem: The file is not a Qualisys calibration, or values are missing or wrong; the message lists all.
    """
    root = read_xml(path, _REMEDY)
    active = [camera for camera in root.iter("camera") if camera.get("active", "1") != "0"]
    # A file of a laboratory also has the cameras that see only markers; files of other programs state no model.
    videos = [camera for camera in active if any(word in camera.get("model", "").lower() for word in _VIDEO_MODELS)]
    cameras = videos or active
    if not cameras:
        raise FileProblem(path, "has no active camera", _REMEDY)
    faults = Faults(path, _REMEDY)
    return make_rig(faults, [_camera(faults, camera) for camera in cameras])


def _camera(faults: Faults, camera: Element) -> Camera | None:
    name = camera.get("serial", "without serial")
    clauses: list[str] = []
    shown = _values(camera, "fov_video", _FOV, clauses)
    transform = _values(camera, "transform", _TRANSFORM, clauses)
    inner = _values(camera, "intrinsic", _INTRINSIC, clauses)
    unit = None if clauses else _unit(camera, inner, clauses)
    if unit is None:
        faults.add(name, clauses)
        return None
    # The rows are the camera's axes in the world; x, y, z is the camera's centre [mm].
    rotation = _CAMERA_FROM_QUALISYS @ np.array([transform[key] for key in _TRANSFORM[3:]]).reshape(3, 3)
    centre = np.array([transform[key] for key in "xyz"]) / 1000
    radial = [inner[f"radialDistortion{i}"] for i in (1, 2, 3)]
    tangential = [inner[f"tangentalDistortion{i}"] for i in (1, 2)]
    raw = RawCamera(
        name=name,
        size=(shown["right"] - shown["left"] + 1, shown["bottom"] - shown["top"] + 1),
        matrix=_matrix(inner, unit, shown),
        # Dimensionless: dividing these like the pixel values removes the distortion (checked on calibration boards).
        distortion=[*radial[:2], *tangential, radial[2]],
        rotation=rotation,
        translation=-rotation @ centre,
    )
    return raw.checked(faults)


def _matrix(inner: dict[str, float], unit: float, shown: dict[str, float]) -> Floats:
    centre_x, centre_y = inner["centerPointU"] / unit - shown["left"], inner["centerPointV"] / unit - shown["top"]
    return np.array(
        [
            [inner["focalLengthU"] / unit, inner["skew"] / unit, centre_x],
            [0, inner["focalLengthV"] / unit, centre_y],
            [0, 0, 1],
        ]
    )


def _unit(camera: Element, inner: dict[str, float], clauses: list[str]) -> float | None:
    """Return the intrinsic units per pixel: 64 in files, 1 in data that the program sends over the network."""
    full = _values(camera, "fov_video_max", _FOV, clauses)
    if clauses:
        return None
    width = full["right"] - full["left"] + 1
    ratio = (inner["sensorMaxU"] - inner["sensorMinU"] + 1) / width if width > 0 else float("nan")
    for unit in (64.0, 1.0):
        if abs(ratio / unit - 1) < 0.02:
            return unit
    clauses.append(f"has a sensor with {ratio:.3g} units per pixel; 64 or 1 are expected")
    return None


def _values(camera: Element, tag: str, keys: tuple[str, ...], clauses: list[str]) -> dict[str, float]:
    """Return the numbers of one element, and add missing ones to the clauses."""
    element = camera.find(tag)
    if element is None:
        clauses.append(f"has no <{tag}>")
        return {}
    values = {}
    for key in keys:
        try:
            values[key] = float(element.get(key, ""))
            if not np.isfinite(values[key]):
                raise ValueError
        except ValueError:
            clauses.append(f"has no number for {key} in <{tag}>")
    return values
