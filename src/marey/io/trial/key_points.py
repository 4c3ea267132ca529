"""Reading of the joints that a detector found in every image: folders of JSON files as OpenPose writes them."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from marey.arrays import Floats, Integers, freeze_fields
from marey.body.articulation.skeleton import JOINT_OF_SEGMENT
from marey.cameras.rig import Rig
from marey.errors import FileProblem
from marey.io.documents import finite, read_json

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
    33: ("BlazePose-33", _layout(
        ((11, 13, 15, 23, 25, 27), (12, 14, 16, 24, 26, 28)), neck=(11, 12), head=(7, 8),
    )),
    133: ("COCO-WholeBody-133", _layout(
        ((5, 7, 9, 11, 13, 15), (6, 8, 10, 12, 14, 16)),
        neck=(5, 6), head=(3, 4), left_toe=(17, 18), right_toe=(20, 21),
    )),
}  # fmt: skip
"""Keypoint layouts of detectors by their number of points; the head's centre is the midpoint of the ears."""

FOLDER_REMEDY = (
    "Give a folder with CAMERA_json/*_NUMBER_keypoints.json, CAMERA/*.json, or CAMERA_NUMBER_keypoints.json."
)
"""Remedy in the error messages on a folder: the expected files."""
_DETECTOR_REMEDY = "Write it with the option write_json of OpenPose or a similar program."
"""Remedy in the error messages on a file of a detector."""
LEAST_CONFIDENCE = 0.05
"""Points with a lower confidence are treated as missing; OpenPose writes 0, 0, 0 for them. Chosen by hand."""
MOST_PEOPLE = 4
"""Number of persons per image, the most confident ones, among which the same person is searched. Chosen by hand."""


@dataclass(frozen=True, eq=False, kw_only=True)
class KeyPoints:
    """Joints that a detector found in the images of a take, for each of the persons in an image."""

    camera_names: tuple[str, ...]
    """C cameras, in the rig's order."""
    joint_names: tuple[str, ...]
    """Names of the J joint centres."""
    pixels: Floats
    """(F, C, P, J, 2) of at most P persons per image, in no common order [px]; NaN where a joint was not found."""
    confidence: Floats
    """(F, C, P, J) the detector's confidence from 0 to 1; 0 where a joint was not found."""
    layout: str
    """Name of the detector's layout of points."""

    def __post_init__(self) -> None:
        freeze_fields(self, "pixels", "confidence")


def read_key_points(
    folder: Path | str,
    rig: Rig,
    *,
    count: int,
    pictures: Integers | None = None,
    names: Mapping[str, Sequence[str]] | None = None,
) -> KeyPoints:
    """Read the detected joints of all frames.

    Args:
        folder: A folder with one sub-folder per camera, `CAMERA` or `CAMERA_json`, or with files that begin with the
            camera's name; the number at the end of a file's name is the frame.
        rig: The cameras; others in the folder are ignored.
        count: Number of frames of the video; files of later frames are ignored.
        pictures: (C, F) number of each camera's picture of each frame; by default the frame's number.
        names: Names that the files of a camera may have, by camera; by default its own.

    Returns:
        The joints. A camera without any file has none.

    Raises:
        FileProblem: The folder or a file cannot be used, fewer than two cameras have joints, or the layouts differ.
    """
    folder = Path(folder)
    if not folder.is_dir():
        wrong = "is not a folder" if folder.exists() else "does not exist"
        raise FileProblem(folder, wrong, FOLDER_REMEDY)
    files = [files_of_camera(folder, *(names or {}).get(name, (name,))) for name in rig.names]
    found = [name for name, of_camera in zip(rig.names, files, strict=True) if of_camera]
    if len(found) < 2:
        which = f"only of {found[0]}" if found else "of none"
        wrong = f"has key points {which} of the cameras {', '.join(rig.names)}"
        raise FileProblem(folder, wrong, f"At least two cameras are needed. {FOLDER_REMEDY}")
    if pictures is not None:
        files = [_by_frame(of_camera, numbers) for of_camera, numbers in zip(files, pictures, strict=True)]
    people = {
        (frame, c): detected_people(path)
        for c, of_camera in enumerate(files)
        for frame, path in of_camera.items()
        if frame < count
    }
    most = max((len(persons) for persons in people.values()), default=0)
    if most == 0:
        wrong = f"has no person in the frames 0 to {count - 1}"
        raise FileProblem(folder, wrong, "Check that the files belong to this recording, or use another detector.")
    layouts = {len(points) for persons in people.values() for points in persons}
    if len(layouts) > 1:
        wrong = f"mixes the layouts {' and '.join(LAYOUTS[layout][0] for layout in sorted(layouts))}"
        raise FileProblem(folder, wrong, "Write all files with one detector.")
    shape = (count, len(rig), most, len(JOINTS))
    pixels, confidence = np.full((*shape, 2), np.nan), np.zeros(shape)
    for (frame, c), persons in people.items():
        for p, points in enumerate(persons):
            pixels[frame, c, p], confidence[frame, c, p] = joints_of_points(points)
    return KeyPoints(
        camera_names=rig.names,
        joint_names=JOINTS,
        pixels=pixels,
        confidence=confidence,
        layout=LAYOUTS[layouts.pop()][0],
    )


def _by_frame(files: dict[int, Path], pictures: Integers) -> dict[int, Path]:
    """Return the files of the pictures (F,) by the number of their frame."""
    return {frame: files[int(number)] for frame, number in enumerate(pictures) if int(number) in files}


def files_of_camera(folder: Path, *cameras: str) -> dict[int, Path]:
    """Return one camera's files by frame number; the first of its names with any files counts."""
    found: list[Path] = []
    for camera in cameras:
        places = [folder / camera, folder / f"{camera}_json"]
        found = found or [path for place in places if place.is_dir() for path in place.glob("*.json")]
        found = found or [path for path in folder.glob("*.json") if path.name.startswith(f"{camera}_")]
    numbered = ((re.search(r"(\d+)(?:_keypoints)?$", path.stem), path) for path in found)
    return {int(match[1]): path for match, path in numbered if match}


def detected_people(path: Path | None) -> list[Floats]:
    """Read the persons of one image, each (points, 3) with x, y [px] and confidence."""
    if path is None:
        return []
    content = read_json(path, _DETECTOR_REMEDY)
    persons = content.get("people") if isinstance(content, dict) else None
    if not isinstance(persons, list):
        raise FileProblem(path, "has no list called people", _DETECTOR_REMEDY)
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
    return sorted(found, key=lambda points: -points[:, 2].sum())[:MOST_PEOPLE]


def joints_of_points(points: Floats) -> tuple[Floats, Floats]:
    """Convert a detector's points to our joints: pixels (J, 2) and confidence (J,)."""
    pixels, confidence = np.full((len(JOINTS), 2), np.nan), np.zeros(len(JOINTS))
    for joint, which in LAYOUTS[len(points)][1].items():
        least = points[list(which), 2].min()
        if least >= LEAST_CONFIDENCE:
            row = JOINTS.index(joint)
            pixels[row], confidence[row] = points[list(which), :2].mean(axis=0), min(least, 1.0)
    return pixels, confidence
