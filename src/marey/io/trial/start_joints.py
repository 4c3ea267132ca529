"""Reading of the 2-D joints of one frame, clicked or detected: our own JSON, or folders of OpenPose."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from marey.arrays import Floats, freeze_fields
from marey.cameras.rig import Rig
from marey.cameras.triangulate import triangulate
from marey.errors import FileProblem
from marey.io.documents import finite_number, read_json
from marey.io.trial.key_points import (
    FOLDER_REMEDY,
    JOINTS,
    LAYOUTS,
    detected_people,
    files_of_camera,
    joints_of_points,
)

_JSON_REMEDY = (
    'Write {"frame": 12, "cam01": {"left_hip": [310, 224], ...}, ...}, pixels counted from 0, x right, y down.'
)
"""Remedy in the error messages on a JSON file: the expected content."""


@dataclass(frozen=True, eq=False, kw_only=True)
class StartJoints:
    """Joint positions in the images of one frame."""

    frame: int
    camera_names: tuple[str, ...]
    """C cameras, in the rig's order."""
    joint_names: tuple[str, ...]
    """Names of the J joint centres."""
    pixels: Floats
    """(C, J, 2) [px]; NaN where a joint is not given."""
    confidence: Floats
    """(C, J) confidence from 0 to 1; 1 for clicked joints, 0 where a joint is not given."""
    layout: str
    """Source of the points: "clicked", or the name of the detector's layout."""

    def __post_init__(self) -> None:
        freeze_fields(self, "pixels", "confidence")


def read_start_joints(path: Path | str, rig: Rig, *, frames: range) -> StartJoints:
    """Read the joints from which the tracking starts.

    Args:
        path: A JSON file, or a folder of OpenPose, from which the frame with the clearest single person is taken.
        rig: The cameras; others in the file are ignored.
        frames: The frames that are used; the start must be in one of them.

    Returns:
        The joints.

    Raises:
        FileProblem: The file cannot be used; the message lists all faults.
    """
    path = Path(path)
    if path.is_dir():
        return _read_folder(path, rig, frames)
    content = read_json(path, _JSON_REMEDY)
    if not isinstance(content, dict) or "people" in content:
        remedy = f"{FOLDER_REMEDY} Or: {_JSON_REMEDY}" if isinstance(content, dict) else _JSON_REMEDY
        raise FileProblem(path, "does not contain the joints of one frame by camera", remedy)
    return _from_clicks(path, content, rig, frames)


def _from_clicks(path: Path, content: Mapping[str, Any], rig: Rig, frames: range) -> StartJoints:
    frame = content.get("frame")
    cameras = {name: joints for name, joints in content.items() if name != "frame"}
    if set(cameras) == {"cameras"} and isinstance(cameras["cameras"], dict):
        cameras = cameras["cameras"]
    faults = []
    if not isinstance(frame, int) or isinstance(frame, bool) or frame not in frames:
        faults.append(f"has frame = {frame!r}, which is not a whole number from {frames.start} to {frames.stop - 1}")
    pixels = np.full((len(rig), len(JOINTS), 2), np.nan)
    for name, joints in cameras.items():
        if not isinstance(joints, dict):
            faults.append(f"'{name}' has no table of joints by name")
            continue
        for joint, value in joints.items():
            faults += _fault_of_click(name, joint, value, rig)
            if not faults and name in rig.names:
                pixels[rig.names.index(name), JOINTS.index(joint)] = value[:2]
    if not faults and not any(name in rig.names for name in cameras):
        faults.append(f"has none of the cameras {', '.join(rig.names)}")
    if faults:
        raise FileProblem(path, "; ".join(faults), _JSON_REMEDY)
    return StartJoints(
        frame=int(frame or 0),
        camera_names=rig.names,
        joint_names=JOINTS,
        pixels=pixels,
        confidence=np.isfinite(pixels[..., 0]),
        layout="clicked",
    )


def _fault_of_click(camera: str, joint: str, value: object, rig: Rig) -> list[str]:
    if joint not in JOINTS:
        return [f"'{camera}' has an unknown joint '{joint}' (the joints are {', '.join(JOINTS)})"]
    pixel = [finite_number(each) for each in value[:2]] if isinstance(value, list) else []
    if len(pixel) < 2 or None in pixel:
        return [f"'{camera}' has {joint} = {str(value)[:40]}, which is not [x, y]"]
    if camera in rig.names and not rig[camera].sees(np.array(pixel, float)):
        size = rig[camera].size
        return [f"'{camera}' has {joint} = {str(value)[:40]} outside its image of {size[0]} x {size[1]}"]
    return []


def _read_folder(folder: Path, rig: Rig, used: range) -> StartJoints:
    """Take the frame in which a single person is most visible in all cameras together."""
    files = [files_of_camera(folder, name) for name in rig.names]
    if not any(files):
        raise FileProblem(folder, f"has no keypoints of {', '.join(rig.names)}", FOLDER_REMEDY)
    frames = sorted({frame for of_camera in files for frame in of_camera if frame in used})
    if not frames:
        raise FileProblem(folder, f"has no keypoints of the frames {used.start} to {used.stop - 1}", FOLDER_REMEDY)
    people = {frame: [detected_people(of_camera.get(frame)) for of_camera in files] for frame in frames}
    seen = {frame: sum(_visibility(persons) for persons in views) for frame, views in people.items()}
    best = max(frames, key=lambda frame: seen[frame])
    if seen[best] == 0:
        raise FileProblem(folder, "has no person in any frame", "Use another detector, or click some joints.")
    chosen = _same_person(people[best], rig)
    layout = {len(points) for points in chosen if points is not None}.pop()
    pixels, confidence = np.full((len(rig), len(JOINTS), 2), np.nan), np.zeros((len(rig), len(JOINTS)))
    for c, points in enumerate(chosen):
        if points is not None:
            pixels[c], confidence[c] = joints_of_points(points)
    return StartJoints(
        frame=best,
        camera_names=rig.names,
        joint_names=JOINTS,
        pixels=pixels,
        confidence=confidence,
        layout=LAYOUTS[layout][0],
    )


def _visibility(persons: Sequence[Floats]) -> float:
    """Return the mean confidence of the clearest person, divided by the number of persons in the image."""
    return float(persons[0][:, 2].mean()) / len(persons) if persons else 0.0


def _same_person(views: Sequence[Sequence[Floats]], rig: Rig) -> tuple[Floats | None, ...]:
    """Choose one person per view so that the median triangulation residual is smallest."""
    choices: list[Sequence[Floats | None]] = [persons or (None,) for persons in views]
    best = tuple(persons[0] for persons in choices)
    if all(len(persons) == 1 for persons in choices):
        return best
    smallest = np.inf
    for chosen in product(*choices):
        used = [c for c, points in enumerate(chosen) if points is not None]
        pixels = np.stack([joints_of_points(chosen[c])[0] for c in used])  # type: ignore[arg-type]
        found = triangulate([rig.cameras[c] for c in used], pixels, sigma_px=1.0)
        misses = found.residual_px[np.isfinite(found.residual_px)]
        if len(misses) and np.median(misses) < smallest:
            smallest, best = float(np.median(misses)), chosen
    return best
