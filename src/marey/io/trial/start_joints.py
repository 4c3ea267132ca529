"""2-D joints of one frame, clicked or detected: JSON of our own, or folders that OpenPose and its kin write."""

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

_SIDES = ("left", "right")
_LIMBS = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")


def _layout(limbs: Sequence[Sequence[int]], **others: tuple[int, ...]) -> dict[str, tuple[int, ...]]:
    """Name the points of a detector: per side the limbs' in order, then others; several points mean their middle."""
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
"""Detectors' layouts by their number of points. The head's centre is the middle between the ears."""

_JSON_REMEDY = (
    'Write {"frame": 12, "cam01": {"left_hip": [310, 224], ...}, ...}, pixels counted from 0, x right, y down.'
)
_FOLDER_REMEDY = (
    "Give a folder with CAMERA_json/*_NUMBER_keypoints.json, CAMERA/*.json, or CAMERA_NUMBER_keypoints.json."
)
_LEAST_CONFIDENCE = 0.05
"""Below it a detector has not found a point; OpenPose writes 0, 0, 0."""
_MOST_PEOPLE = 4


@dataclass(frozen=True, eq=False, kw_only=True)
class StartJoints:
    """Joints in the pictures of one frame."""

    frame: int
    camera_names: tuple[str, ...]
    """C cameras, in the rig's order."""
    joint_names: tuple[str, ...]
    """J joint centres."""
    pixels: Floats
    """(C, J, 2) [px]; NaN where a joint is not given."""
    confidence: Floats
    """(C, J) from 0 to 1; 1 for what was clicked, 0 where a joint is not given."""
    layout: str
    """Where the points come from: "clicked", or the detector's layout."""

    def __post_init__(self) -> None:
        freeze_fields(self, "pixels", "confidence")


def read_start_joints(path: Path | str, rig: Rig, *, count: int) -> StartJoints:
    """Read the joints from which to start.

    Args:
        path: A JSON file, or a folder of OpenPose's files; of those the frame that shows most of one person is taken.
        rig: The cameras; others in the file are left out.
        count: Frames of the video.

    Returns:
        The joints.

    Raises:
        FileProblem: The file cannot be used; the message lists everything that is wrong.
    """
    path = Path(path)
    if path.is_dir():
        return _read_folder(path, rig, count)
    said = _read_json(path)
    if not isinstance(said, dict) or "people" in said:
        remedy = f"{_FOLDER_REMEDY} Or: {_JSON_REMEDY}" if isinstance(said, dict) else _JSON_REMEDY
        raise FileProblem(path, "does not hold the joints of one frame by camera", remedy)
    return _from_clicks(path, said, rig, count)


def _read_json(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise FileProblem(path, f"cannot be read ({error.strerror})", "Check its name.") from error
    except ValueError as error:
        raise FileProblem(path, f"is not JSON: {error}", _JSON_REMEDY) from error


def _from_clicks(path: Path, said: Mapping[str, Any], rig: Rig, count: int) -> StartJoints:
    frame = said.get("frame")
    cameras = {name: joints for name, joints in said.items() if name != "frame"}
    if set(cameras) == {"cameras"} and isinstance(cameras["cameras"], dict):
        cameras = cameras["cameras"]
    faults = []
    if not isinstance(frame, int) or isinstance(frame, bool) or not 0 <= frame < count:
        faults.append(f"has frame = {frame!r}, which is no whole number from 0 to {count - 1}")
    pixels = np.full((len(rig), len(JOINTS), 2), np.nan)
    for name, joints in cameras.items():
        if not isinstance(joints, dict):
            faults.append(f"'{name}' holds no joints by name")
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
        return [f"'{camera}' has an unknown joint '{joint}' (known are {', '.join(JOINTS)})"]
    numbers = value if isinstance(value, list) and len(value) >= 2 else []
    if not numbers or not all(isinstance(n, int | float) and not isinstance(n, bool) for n in numbers):
        return [f"'{camera}' has {joint} = {value!r}, which is not [x, y]"]
    if camera in rig.names and not rig[camera].sees(np.array(numbers[:2], float)):
        size = rig[camera].size
        return [f"'{camera}' has {joint} = {value!r} outside its picture of {size[0]} x {size[1]}"]
    return []


def _read_folder(folder: Path, rig: Rig, count: int) -> StartJoints:
    """Take the frame in which one person is seen best by all cameras together."""
    files = [_files_of(folder, name) for name in rig.names]
    if not any(files):
        raise FileProblem(folder, f"has no key points of {', '.join(rig.names)}", _FOLDER_REMEDY)
    frames = sorted({frame for of_camera in files for frame in of_camera if frame < count})
    if not frames:
        raise FileProblem(folder, f"has no key points of the frames 0 to {count - 1}", _FOLDER_REMEDY)
    people = {frame: [_people(of_camera.get(frame)) for of_camera in files] for frame in frames}
    seen = {frame: sum(_clarity(persons) for persons in views) for frame, views in people.items()}
    best = max(frames, key=lambda frame: seen[frame])
    if seen[best] == 0:
        raise FileProblem(folder, "shows nobody in any frame", "Take another detector, or click some joints.")
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
    """Find one camera's files by frame."""
    places = [folder / camera, folder / f"{camera}_json"]
    found = [path for place in places if place.is_dir() for path in place.glob("*.json")]
    found = found or list(folder.glob(f"{camera}_*.json"))
    numbered = ((re.search(r"(\d+)(?:_keypoints)?$", path.stem), path) for path in found)
    return {int(match[1]): path for match, path in numbered if match}


def _people(path: Path | None) -> list[Floats]:
    """Read the persons of one picture, each (points, 3): x, y, confidence."""
    if path is None:
        return []
    said = _read_json(path)
    persons = said.get("people") if isinstance(said, dict) else None
    if not isinstance(persons, list):
        raise FileProblem(path, "has no list called people", "Write it with OpenPose's write_json or a like option.")
    found = []
    for person in persons:
        numbers = finite(person.get("pose_keypoints_2d") if isinstance(person, dict) else None, None)
        if numbers is None or len(numbers) % 3 or len(numbers) // 3 not in LAYOUTS:
            known = ", ".join(f"{count} ({name})" for count, (name, _) in sorted(LAYOUTS.items()))
            has = "without numbers" if numbers is None else f"of {len(numbers) / 3:g} points"
            raise FileProblem(path, f"has a person {has} in pose_keypoints_2d", f"Known are {known} points.")
        found.append(numbers.reshape(-1, 3))
    return sorted(found, key=lambda points: -points[:, 2].sum())[:_MOST_PEOPLE]


def _clarity(persons: Sequence[Floats]) -> float:
    """Rate how well a picture shows one person: the clearest's confidence, less where others are about."""
    return float(persons[0][:, 2].mean()) / len(persons) if persons else 0.0


def _joints(points: Floats) -> tuple[Floats, Floats]:
    """Turn a detector's points into our joints: pixels (J, 2) and confidence (J,)."""
    pixels, confidence = np.full((len(JOINTS), 2), np.nan), np.zeros(len(JOINTS))
    for joint, which in LAYOUTS[len(points)][1].items():
        least = points[list(which), 2].min()
        if least >= _LEAST_CONFIDENCE:
            row = JOINTS.index(joint)
            pixels[row], confidence[row] = points[list(which), :2].mean(axis=0), min(least, 1.0)
    return pixels, confidence


def _same_person(views: Sequence[Sequence[Floats]], rig: Rig) -> tuple[Floats | None, ...]:
    """Choose one person a view so that the views' rays meet best; with one person in each there is no choice."""
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
