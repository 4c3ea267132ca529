"""Reading of calibrations of Vicon: .xcp, an XML file."""

from dataclasses import replace
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from scipy.optimize import least_squares

from marey.arrays import Floats
from marey.cameras.camera import Camera
from marey.cameras.rig import Rig
from marey.errors import FileProblem
from marey.io.calibration.parts import Faults, RawCamera, make_rig, quaternion_matrix
from marey.io.documents import read_xml

_REMEDY = (
    "Save the calibration from Vicon Nexus again; each <Camera> needs DEVICEID and SENSOR_SIZE, and its <KeyFrame> "
    "FOCAL_LENGTH, PRINCIPAL_POINT, ORIENTATION, POSITION and VICON_RADIAL2 or VICON_RADIAL."
)
"""Remedy in the error messages."""
_RADIAL_MODEL = "Vicon3Parameter"
"""Name of the lens model in VICON_RADIAL2: centre and three coefficients."""
_GRID = 25
"""Points along each side of the image at which a lens is converted. Chosen by hand."""
_GOOD_FIT = 0.02
"""Error of a converted lens below which five coefficients are enough [px]. Chosen by hand: detectors reach 0.05 px."""
_LARGEST_ERROR = 0.5
"""Largest error of a converted lens anywhere in the image [px]. Chosen by hand."""


def read_vicon(path: Path) -> Rig:
    """Read the video cameras of a Vicon calibration, named by their DEVICEID; if it has none, all its cameras.

    A position is the camera's centre in millimetres, and a quaternion (real part last) the rotation from world to
    camera, whose axes are right, down and forward. Vicon's lens model corrects pixels, in the other direction than
    OpenCV's, to which it is converted.

    Args:
        path: The file.

    Returns:
        The cameras.

    Raises:
        FileProblem: The file is not a Vicon calibration, or values are missing or wrong; the message lists all.
    """
    root = read_xml(path, _REMEDY)
    every = [camera for camera in root.iter("Camera") if camera.find("KeyFrames/KeyFrame") is not None]
    cameras = [camera for camera in every if _is_video(camera)] or every
    if not cameras:
        raise FileProblem(path, "has no calibrated camera", _REMEDY)
    faults = Faults(path, _REMEDY)
    return make_rig(faults, [_camera(faults, camera) for camera in cameras])


def _is_video(camera: Element) -> bool:
    return "video" in (camera.get("TYPE", "") + camera.get("DISPLAY_TYPE", "")).lower()


def _camera(faults: Faults, camera: Element) -> Camera | None:
    name = camera.get("DEVICEID", "")
    frames = camera.findall("KeyFrames/KeyFrame")
    if len(frames) > 1:
        faults.add(name, ["has several key frames, so it moved during the recording"])
        return None
    clauses: list[str] = []
    size = _numbers(camera, "SENSOR_SIZE", 2, clauses)
    focal, point = _numbers(frames[0], "FOCAL_LENGTH", 1, clauses), _numbers(frames[0], "PRINCIPAL_POINT", 2, clauses)
    quaternion, centre = _numbers(frames[0], "ORIENTATION", 4, clauses), _numbers(frames[0], "POSITION", 3, clauses)
    radial = _radial(frames[0], clauses)
    aspect = _aspect(camera, clauses)
    rotation = None if quaternion is None else quaternion_matrix(np.roll(quaternion, 1))
    if not clauses and rotation is None:
        clauses.append("has an ORIENTATION that is not a quaternion of length 1")
    if clauses or size is None or focal is None or point is None or centre is None or rotation is None:
        faults.add(name, clauses)
        return None
    matrix = np.array([[focal[0], 0, point[0]], [0, focal[0] / aspect, point[1]], [0, 0, 1]])
    raw = RawCamera(
        name=name, size=size, matrix=matrix, distortion=np.zeros(4), rotation=rotation,
        translation=-rotation @ centre / 1000,
    )  # fmt: skip
    if raw.checked(faults) is None:
        return None
    matrix, lens = _lens(size, matrix, radial, clauses)
    faults.add(name, clauses)
    return None if clauses else replace(raw, matrix=matrix, distortion=lens).checked(faults)


def _numbers(element: Element, key: str, count: int, clauses: list[str]) -> Floats | None:
    """Return the finite numbers of an attribute, or add a clause."""
    try:
        found = np.array([float(part) for part in element.get(key, "").split()])
    except ValueError:
        found = np.zeros(0)
    if len(found) != count or not np.isfinite(found).all():
        clauses.append(f"has no {count} numbers in {key}" if count > 1 else f"has no number in {key}")
        return None
    return found


def _aspect(camera: Element, clauses: list[str]) -> float:
    """Return the ratio of the focal lengths of columns and rows, as Pose2Sim reads it; it is 1 in all known files."""
    if camera.get("PIXEL_ASPECT_RATIO") is None:
        return 1.0
    found = _numbers(camera, "PIXEL_ASPECT_RATIO", 1, clauses)
    if found is not None and not 0.1 < found[0] < 10:
        clauses.append(f"has the PIXEL_ASPECT_RATIO {found[0]:g}")
    return 1.0 if found is None else float(found[0])


def _radial(frame: Element, clauses: list[str]) -> tuple[Floats | None, Floats]:
    """Return the centre of the distortion [px], None for the principal point, and the coefficients [px^-2, px^-4, ...].

    The newer attribute states its model first; the older one has two coefficients about the principal point.
    """
    model, *parts = frame.get("VICON_RADIAL2", "").split() or [""]
    if not model:
        if frame.get("VICON_RADIAL") is None:
            return None, np.zeros(0)
        found = _numbers(frame, "VICON_RADIAL", 2, clauses)
        return None, np.zeros(0) if found is None else found
    try:
        numbers = np.array([float(part) for part in parts])
    except ValueError:
        numbers = np.zeros(0)
    if model != _RADIAL_MODEL or len(numbers) != 5 or not np.isfinite(numbers).all():
        clauses.append(f"has a VICON_RADIAL2 that is not '{_RADIAL_MODEL}' and 5 numbers")
        return None, np.zeros(0)
    return numbers[:2], numbers[2:]


def _lens(
    size: Floats, matrix: Floats, radial: tuple[Floats | None, Floats], clauses: list[str]
) -> tuple[Floats, Floats]:
    """Convert a correction of pixels to the matrix and coefficients of OpenCV: five or, if they are too few, twelve.

    The correction maps the offset d of a pixel from the centre to d (1 + k1 d^2 + k2 d^4 + k3 d^6); OpenCV's model
    maps straight rays to pixels. With a centre that is not the principal point, the matrix changes, too, so that the
    pixel of each ray stays the same.
    """
    centre, coefficients = radial
    if not np.any(coefficients):
        return matrix, np.zeros(4)
    sides = [np.linspace(0, side - 1, _GRID) for side in size]
    pixels = np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)
    offset = pixels - (matrix[:2, 2] if centre is None else centre)
    squared = np.sum(offset**2, axis=1, keepdims=True)
    with np.errstate(over="ignore", invalid="ignore"):
        scale = 1 + sum(k * squared ** (power + 1) for power, k in enumerate(coefficients))
        corrected = pixels + offset * (scale - 1)
    # Beyond the point at which the correction turns back, pixels would have the rays of others.
    if not np.isfinite(corrected).all() or np.abs(scale - 1).max() > 1 or not _grows(squared.ravel(), scale.ravel()):
        clauses.append("has radial coefficients that fold the image")
        return matrix, np.zeros(4)
    inner = np.array([matrix[0, 0], matrix[1, 1], *matrix[:2, 2]])
    straight, bent = (corrected - inner[2:]) / inner[:2], (pixels - inner[2:]) / inner[:2]
    found = np.concatenate([inner, _five_coefficients(straight, bent)])
    if np.abs(_errors(found, straight, pixels)).max() > _GOOD_FIT:
        start = np.concatenate([found, np.zeros(7)])
        scales = np.concatenate([np.abs(inner) + 1, np.ones(12)])
        found = least_squares(_flat_errors, start, x_scale=scales, args=(straight, pixels)).x
    worst = float(np.abs(_errors(found, straight, pixels)).max())
    if worst > _LARGEST_ERROR:
        clauses.append(f"has a lens that OpenCV's model approximates only to {worst:.2f} px")
    return np.array([[found[0], 0, found[2]], [0, found[1], found[3]], [0, 0, 1]]), found[4:]


def _grows(squared: Floats, scale: Floats) -> bool:
    order = np.argsort(squared)
    radius = np.sqrt(squared[order]) * scale[order]
    return bool(np.all(np.diff(radius) > -1e-6 * max(radius.max(), 1.0)))


def _five_coefficients(straight: Floats, bent: Floats) -> Floats:
    """Fit k1 k2 p1 p2 k3, in which the model is linear, to pairs of straight and bent points (n, 2)."""
    x, y = straight.T
    r2 = x**2 + y**2
    columns = [straight * r2[:, None], straight * r2[:, None] ** 2]
    columns += [np.stack([2 * x * y, r2 + 2 * y**2], axis=1), np.stack([r2 + 2 * x**2, 2 * x * y], axis=1)]
    columns += [straight * r2[:, None] ** 3]
    design = np.stack(columns, axis=-1).reshape(-1, len(columns))
    return np.asarray(np.linalg.lstsq(design, (bent - straight).ravel(), rcond=None)[0])


def _flat_errors(found: Floats, straight: Floats, pixels: Floats) -> Floats:
    return _errors(found, straight, pixels).ravel()


def _errors(found: Floats, straight: Floats, pixels: Floats) -> Floats:
    """Return the errors (n, 2) [px] of fx fy cx cy k1 k2 p1 p2 k3 [k4 k5 k6 s1 s2 s3 s4] of OpenCV."""
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = np.pad(found[4:], (0, 16 - len(found)))
    x, y = straight.T
    r2 = x**2 + y**2
    ratio = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    shift = np.stack([2 * p1 * x * y + p2 * (r2 + 2 * x**2), p1 * (r2 + 2 * y**2) + 2 * p2 * x * y], axis=1)
    shift += np.stack([s1 * r2 + s2 * r2**2, s3 * r2 + s4 * r2**2], axis=1)
    return np.asarray((straight * ratio[:, None] + shift) * found[:2] + found[2:4] - pixels)
