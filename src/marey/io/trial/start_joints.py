"""Reading of the 2-D joints of one frame, clicked or detected: our own JSON, or folders of OpenPose."""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from marey.arrays import Floats, freeze_fields
from marey.body.articulation.skeleton import JOINT_OF_SEGMENT
from marey.cameras.rig import Rig
from marey.cameras.triangulate import triangulate
from marey.errors import FileProblem
from marey.io.calibration.parts import finite

JOINTS = tuple(JOINT_OF_SEGMENT.values())
"""Names of the joints that can be given."""

_SIDES = ("left", "right")
"""Prefixes of the joints' names, in the order of the point numbers in `LAYOUTS`."""
_LIMBS = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
"""Joints of one side, in the order of the point numbers in `LAYOUTS`."""


def _layout(limbs: Sequence[Sequence[int]], **others: tuple[int, ...]) -> dict[str, tuple[int, ...]]:
    """Return the point numbers of each joint: the limbs' by side, and others; several points stand for their mean."""
    pairs = {
        f"{side}_{joint}": (point,)
        for side, points in zip(_SIDES, limbs, strict=True)
        for joint, point in zip(_LIMBS, points, strict=True)
    }
    return pairs | others


LAYOUTS = {
    25: ("BODY_25", _layout(
        ((5, 6, 7, 12, 13, 14), (2, 3, 4, 9, 10, 11)),
        neck=(1,), head=(17, 18), left_toe=(19, 20), right_toe=(22, 23),
    )),
    18: ("COCO-18", _layout(((5, 6, 7, 11, 12, 13), (2, 3, 4, 8, 9, 10)), neck=(1,), head=(16, 17))),
    17: ("COCO-17", _layout(((5, 7, 9, 11, 13, 15), (6, 8, 10, 12, 14, 16)), neck=(5, 6), head=(3, 4))),
    26: ("Halpe-26", _layout(
        ((5, 7, 9, 11, 13, 15), (6, 8, 10, 12, 14, 16)),
        neck=(18,), head=(3, 4), left_toe=(20, 22), right_toe=(21, 23),
    )),
}  # fmt: skip
"""Keypoint layouts of detectors by their number of points; the head's centre is the midpoint of the ears."""

_JSON_REMEDY = (
    'Write {"frame": 12, "cam01": {"left_hip": [310, 224], ...}, ...}, pixels counted from 0, x right, y down.'
)
"""Remedy in the error messages on a JSON file: the expected content."""
_FOLDER_REMEDY = (
    "Give a folder with CAMERA_json/*_NUMBER_keypoints.json, CAMERA/*.json, or CAMERA_NUMBER_keypoints.json."
)
"""Remedy in the error messages on a folder: the expected files."""
_LEAST_CONFIDENCE = 0.05
"""Points with a lower confidence are treated as missing; OpenPose writes 0, 0, 0 for them. Chosen by hand."""
_MOST_PEOPLE = 4
"""Number of persons per image, the most confident ones, among which the same person is searched. Chosen by hand."""


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


def read_start_joints(path: Path | str, rig: Rig, *, count: int) -> StartJoints:
    """Read the joints from which the tracking starts.

    Args:
        path: A JSON file, or a folder of OpenPose, from which the frame with the clearest single person is taken.
        rig: The cameras; others in the file are ignored.
        count: Number of frames of the video.

    Returns:
        The joints.

    Raises:
        FileProblem: The file cannot be used; the message lists all faults.
    """
    path = Path(path)
    if path.is_dir():
        return _read_folder(path, rig, count)
    content = _read_json(path)
    if not isinstance(content, dict) or "people" in content:
        remedy = f"{_FOLDER_REMEDY} Or: {_JSON_REMEDY}" if isinstance(content, dict) else _JSON_REMEDY
        raise FileProblem(path, "does not contain the joints of one frame by camera", remedy)
    return _from_clicks(path, content, rig, count)


def _read_json(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise FileProblem(path, f"cannot be read ({error.strerror})", "Check its name.") from error
    except ValueError as error:
        raise FileProblem(path, f"is not JSON: {error}", _JSON_REMEDY) from error


def _from_clicks(path: Path, content: Mapping[str, Any], rig: Rig, count: int) -> StartJoints:
    frame = content.get("frame")
    cameras = {name: joints for name, joints in content.items() if name != "frame"}
    if set(cameras) == {"cameras"} and isinstance(cameras["cameras"], dict):
        cameras = cameras["cameras"]
    faults = []
    if not isinstance(frame, int) or isinstance(frame, bool) or not 0 <= frame < count:
        faults.append(f"has frame = {frame!r}, which is not a whole number from 0 to {count - 1}")
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
    numbers = value if isinstance(value, list) and len(value) >= 2 else []
    if not numbers or not all(isinstance(n, int | float) and not isinstance(n, bool) for n in numbers):
        return [f"'{camera}' has {joint} = {value!r}, which is not [x, y]"]
    if camera in rig.names and not rig[camera].sees(np.array(numbers[:2], float)):
        size = rig[camera].size
        return [f"'{camera}' has {joint} = {value!r} outside its image of {size[0]} x {size[1]}"]
    return []


def _read_folder(folder: Path, rig: Rig, count: int) -> StartJoints:
    """Take the frame in which a single person is most visible in all cameras together."""
    files = [_files_of(folder, name) for name in rig.names]
    if not any(files):
        raise FileProblem(folder, f"has no keypoints of {', '.join(rig.names)}", _FOLDER_REMEDY)
    frames = sorted({frame for of_camera in files for frame in of_camera if frame < count})
    if not frames:
        raise FileProblem(folder, f"has no keypoints of the frames 0 to {count - 1}", _FOLDER_REMEDY)
    people = {frame: [_people(of_camera.get(frame)) for of_camera in files] for frame in frames}
    seen = {frame: sum(_visibility(persons) for persons in views) for frame, views in people.items()}
    best = max(frames, key=lambda frame: seen[frame])
    if seen[best] == 0:
        raise FileProblem(folder, "has no person in any frame", "Use another detector, or click some joints.")
    chosen = _same_person(people[best], rig)
    layout = {len(points) for points in chosen if points is not None}.pop()
    pixels, confidence = np.full((len(rig), len(JOINTS), 2), np.nan), np.zeros((len(rig), len(JOINTS)))
    for c, points in enumerate(chosen):
        if points is not None:
            pixels[c], confidence[c] = _joints(points)
    return StartJoints(
        frame=best,
        camera_names=rig.names,
        joint_names=JOINTS,
        pixels=pixels,
        confidence=confidence,
        layout=LAYOUTS[layout][0],
    )


def _files_of(folder: Path, camera: str) -> dict[int, Path]:
    """Return one camera's files by frame number."""
    places = [folder / camera, folder / f"{camera}_json"]
    found = [path for place in places if place.is_dir() for path in place.glob("*.json")]
    found = found or list(folder.glob(f"{camera}_*.json"))
    numbered = ((re.search(r"(\d+)(?:_keypoints)?$", path.stem), path) for path in found)
    return {int(match[1]): path for match, path in numbered if match}


def _people(path: Path | None) -> list[Floats]:
    """Read the persons of one image, each (points, 3) with x, y [px] and confidence."""
    if path is None:
        return []
    content = _read_json(path)
    persons = content.get("people") if isinstance(content, dict) else None
    if not isinstance(persons, list):
        raise FileProblem(
            path, "has no list called people", "Write it with the option write_json of OpenPose or a similar program."
        )
    found = []
    for person in persons:
        numbers = finite(person.get("pose_keypoints_2d") if isinstance(person, dict) else None, None)
        if numbers is None or len(numbers) % 3 or len(numbers) // 3 not in LAYOUTS:
            known = ", ".join(f"{count} ({name})" for count, (name, _) in sorted(LAYOUTS.items()))
            has = "without numbers" if numbers is None else f"of {len(numbers) / 3:g} points"
            raise FileProblem(
                path, f"has a person {has} in pose_keypoints_2d", f"The known numbers of points are {known}."
            )
        found.append(numbers.reshape(-1, 3))
    return sorted(found, key=lambda points: -points[:, 2].sum())[:_MOST_PEOPLE]


def _visibility(persons: Sequence[Floats]) -> float:
    """Return the mean confidence of the clearest person, divided by the number of persons in the image."""
    return float(persons[0][:, 2].mean()) / len(persons) if persons else 0.0


def _joints(points: Floats) -> tuple[Floats, Floats]:
    """Convert a detector's points to our joints: pixels (J, 2) and confidence (J,)."""
    pixels, confidence = np.full((len(JOINTS), 2), np.nan), np.zeros(len(JOINTS))
    for joint, which in LAYOUTS[len(points)][1].items():
        least = points[list(which), 2].min()
        if least >= _LEAST_CONFIDENCE:
            row = JOINTS.index(joint)
            pixels[row], confidence[row] = points[list(which), :2].mean(axis=0), min(least, 1.0)
    return pixels, confidence


def _same_person(views: Sequence[Sequence[Floats]], rig: Rig) -> tuple[Floats | None, ...]:
    """Choose one person per view so that the median triangulation residual is smallest."""
    choices: list[Sequence[Floats | None]] = [persons or (None,) for persons in views]
    best = tuple(persons[0] for persons in choices)
    if all(len(persons) == 1 for persons in choices):
        return best
    smallest = np.inf
    for chosen in product(*choices):
        used = [c for c, points in enumerate(chosen) if points is not None]
        pixels = np.stack([_joints(chosen[c])[0] for c in used])  # type: ignore[arg-type]
        found = triangulate([rig.cameras[c] for c in used], pixels, sigma_px=1.0)
        misses = found.residual_px[np.isfinite(found.residual_px)]
        if len(misses) and np.median(misses) < smallest:
            smallest, best = float(np.median(misses)), chosen
    return best
