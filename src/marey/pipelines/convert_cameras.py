"""`marey cameras`: a table of calibrated cameras, and their conversion to the formats of other programs."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from marey.cameras.camera import Camera
from marey.cameras.rig import Rig
from marey.errors import SettingProblem
from marey.geometry.rigid import RigidTransform
from marey.io.calibration.readers import calibration_file, read_rig
from marey.io.calibration.writers import FORMATS, caliscope_numbers, write_rig
from marey.io.trial.layout import board_vertical, find_layout, has_calibration, upward_axis
from marey.io.trial.trial import z_up_from

_LARGEST_FACTOR = 1e9
"""Largest factor between units of length, or its inverse: nanometres in a metre."""


def read_scaled(source: Path | str, scale: float = 1.0) -> Rig:
    """Read calibrated cameras in the world of a trial, whose Z is up if that is known, and multiply all lengths.

    Args:
        source: The calibration, or a folder with one, which may be the trial of another program.
        scale: The factor.

    Returns:
        The cameras.

    Raises:
        SettingProblem: The factor is not a positive number.
        FileProblem: There is no calibration, or it cannot be used.
    """
    if not 1 / _LARGEST_FACTOR <= scale <= _LARGEST_FACTOR:
        wanted = f"it should be from {1 / _LARGEST_FACTOR:g} to {_LARGEST_FACTOR:g}, for example 0.001"
        raise SettingProblem(f"The scale (--scale) is {scale}; {wanted}.")
    path = Path(source)
    found = calibration_file(find_layout(path).calibration if path.is_dir() and not has_calibration(path) else path)
    rig, vertical = read_rig(found), board_vertical(found)
    rig = rig if vertical is None else rig.moved(z_up_from(upward_axis(vertical, rig)))
    return rig if scale == 1 else Rig(tuple(_scaled(camera, scale) for camera in rig))


def _scaled(camera: Camera, scale: float) -> Camera:
    pose = camera.camera_from_world
    return replace(camera, camera_from_world=RigidTransform(pose.rotation, pose.translation * scale))


def camera_table(rig: Rig) -> str:
    """Return a table of cameras: image, lens, position, and the direction in which they look.

    Args:
        rig: The cameras.
    """
    rows: list[tuple[str, ...]] = [("camera", "size", "focal px", "view deg", "lens", "position m", "looks along")]
    rows += [_row(camera) for camera in rig]
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = ("  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip() for row in rows)
    return "\n".join(lines)


def _row(camera: Camera) -> tuple[str, ...]:
    focal = (camera.matrix[0, 0] + camera.matrix[1, 1]) / 2
    view = np.degrees(2 * np.arctan(camera.width / 2 / camera.matrix[0, 0]))
    count = int(np.count_nonzero(camera.distortion))
    lens = "fisheye" if camera.fisheye else f"{count} of {len(camera.distortion)}" if count else "straight"
    position = " ".join(f"{value:.3f}" for value in camera.centre)
    direction = " ".join(f"{value:+.2f}" for value in camera.camera_from_world.rotation[2])
    return camera.name, f"{camera.width} x {camera.height}", f"{focal:.1f}", f"{view:.0f}", lens, position, direction


def write_cameras(cameras: Rig, path: Path | str, *, to: str = "pose2sim") -> tuple[Path, ...]:
    """Write cameras in the format of another program.

    Args:
        cameras: The cameras.
        path: The file; a folder for `opencv` and `easymocap`, which have two files. It must not exist.
        to: `pose2sim` or `anipose` (the format that marey writes itself), `caliscope`, `opencv` or `easymocap`.

    Returns:
        The files.

    Raises:
        SettingProblem: The format is not known, or cannot hold these cameras.
        FileProblem: A file exists already, or cannot be written.

    Example:
        >>> import marey
        >>> import tempfile
        >>> rig = marey.read_cameras(marey.example_folder())
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     [file.name for file in marey.write_cameras(rig, folder, to="opencv")]
        ['intri.yml', 'extri.yml']
    """
    return write_rig(cameras, Path(path), to=to)


def convert_cameras(rig: Rig, out: Path | None, *, to: str | None) -> list[str]:
    """Write cameras in the format of another program.

    Args:
        rig: The cameras.
        out: The file or folder.
        to: The format.

    Returns:
        Lines that report what was written.

    Raises:
        SettingProblem: The format or the path is missing or unknown, or the format cannot hold these cameras.
        FileProblem: The file exists already, or cannot be written.
    """
    if out is None or to is None:
        missing = "path (--out)" if out is None else f"format (--to): one of {', '.join(FORMATS)}"
        raise SettingProblem(f"A conversion needs --to and --out; there is no {missing}.")
    files = write_cameras(rig, out, to=to)
    lines = [f"Written: {file}" for file in files]
    if to == "caliscope":
        numbers = caliscope_numbers(rig.names)
        lines.append("Numbers: " + ", ".join(f"{name} is cam_{number}" for name, number in numbers.items()))
    return lines
