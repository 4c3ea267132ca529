"""Folders of trials as other programs make them: where calibration, videos and settings are."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from marey.cameras.rig import Rig
from marey.errors import FileProblem
from marey.io.calibration.opencap import FILE_NAME, camera_files
from marey.io.calibration.readers import found_calibration
from marey.io.calibration.yaml_text import read_yaml
from marey.io.documents import read_tables
from marey.io.video.clip_files import VideoPlaces, videos_in
from marey.io.video.video import PICTURE_SUFFIXES

_CALIBRATION_TRIALS = ("calibration", "extrinsics", "intrinsics")
"""Names of recordings of an OpenCap session that show only the board, in lower case."""
_METADATA = "sessionMetadata.yaml"
"""File of an OpenCap session with the person's size and the placement of the board."""
_PLACEMENTS = {"backwall": 1, "ground": 2}
"""Axis of the checkerboard that is vertical, by the beginning of its placement in lower case: 1 is y, 2 is z."""
_CALISCOPE_FILES = ("camera_array.toml", "config.toml")
"""Calibrations in the folder of a Caliscope project, the second one of older versions."""


@dataclass(frozen=True, eq=False, kw_only=True)
class TrialLayout:
    """Where the parts of a trial are."""

    folder: Path
    """Folder of the files that belong to this recording alone: trial.toml, sync.json, background, masks, results."""
    calibration: Path
    """The calibration, or a folder with one."""
    places: VideoPlaces
    """The videos."""
    program: str = ""
    """The program that made the folder; empty for a folder of marey's own form."""
    keypoints: Path | None = None
    """Folder with detected joints."""
    vertical: int | None = None
    """Axis of the calibration that is vertical, 1 for y and 2 for z; None if the program does not state it."""
    settings: Mapping[str, float] = field(default_factory=dict)
    """Settings of trial.toml that the program has stored."""
    others: bool = False
    """Whether there may be videos of cameras without a calibration."""


def find_layout(folder: Path) -> TrialLayout:
    """Find the parts of a trial in a folder of marey, Pose2Sim, OpenCap, Caliscope, FreeMoCap or EasyMocap.

    Args:
        folder: The folder. A recording `walk` of an OpenCap session is `SESSION/walk`, which need not exist.

    Returns:
        The parts; whether they can be used is checked when they are opened.

    Raises:
        FileProblem: There is no such folder, or it has several recordings.
    """
    rules: tuple[Callable[[Path], TrialLayout | None], ...] = (_opencap, _caliscope, _folders)
    for rule in rules:
        layout = rule(folder)
        if layout is not None:
            return layout
    wrong = "is not a folder" if folder.exists() else "does not exist"
    raise FileProblem(folder, wrong, "Give a folder with cameras.toml and one video per camera.")


def _folders(folder: Path) -> TrialLayout | None:
    """Return the layout of a folder whose videos are in it or in `videos`, and whose calibration may be beside them."""
    if not folder.is_dir():
        return None
    places = [folder, folder / "videos", folder / "synchronized_videos"]
    videos = folder if _has_stills(folder) else next((place for place in places if videos_in(place)), folder)
    calibration = _calibration(folder)
    is_pose2sim = videos.name == "videos" and "calib" in calibration.name.lower()
    if not videos_in(videos) and not has_calibration(folder):
        _require_one_recording(folder)
    return TrialLayout(
        folder=folder,
        calibration=calibration,
        places=VideoPlaces(folder=videos, in_order=is_pose2sim, stored=(calibration / _CALISCOPE_FILES[0]).is_file()),
        program="Pose2Sim" if is_pose2sim else "FreeMoCap" if videos.name == "synchronized_videos" else "",
        keypoints=_pose_folder(folder) if is_pose2sim else None,
    )


def _has_stills(folder: Path) -> bool:
    """Return whether a folder with its own calibration has numbered stills, which are the take."""
    numbered = (path for path in folder.iterdir() if re.search(r"_\d+$", path.stem))
    return has_calibration(folder) and any(path.suffix.lower() in PICTURE_SUFFIXES for path in numbered)


def _calibration(folder: Path) -> Path:
    """Return the folder that holds the calibration: the trial itself, or that of a project of Pose2Sim above it."""
    if has_calibration(folder):
        return folder
    above = [parent for parent in (folder, *folder.absolute().parents[:2]) if _is_project(parent) or parent == folder]
    for parent in above:
        for place in sorted(parent.iterdir()):
            if "calib" in place.name.lower() and place.is_dir() and has_calibration(place):
                return place
    return folder


def _is_project(folder: Path) -> bool:
    return (folder / "Config.toml").is_file()


def has_calibration(folder: Path) -> bool:
    """Return whether a folder has at least one calibration."""
    try:
        found = found_calibration(folder)
    except FileProblem:
        return folder.is_dir()
    return found is not None


def _pose_folder(folder: Path) -> Path | None:
    """Return the folder with the joints that Pose2Sim detected, if there are any."""
    pose = folder / "pose"
    return pose if pose.is_dir() and any(pose.glob("*_json")) else None


def _require_one_recording(folder: Path) -> None:
    """Raise an error if the recordings are in sub-folders, as in a project of Pose2Sim with several trials."""
    inner = sorted(path.name for path in folder.iterdir() if videos_in(path / "videos"))
    if inner and any(_is_project(place) for place in (folder, *(folder / name for name in inner))):
        _raise_several(folder, inner)


def _raise_several(folder: Path, names: list[str]) -> None:
    wrong = f"has the recordings {', '.join(names)}"
    raise FileProblem(folder, wrong, f"Give one of them, for example {folder / names[0]}.")


def _caliscope(folder: Path) -> TrialLayout | None:
    """Return the layout of a recording of a Caliscope project, or of a project with one recording."""
    inside = folder / "recordings"
    if inside.is_dir() and caliscope_file(folder) is not None and not videos_in(folder):
        found = sorted(path for path in inside.iterdir() if videos_in(path))
        if len(found) > 1:
            _raise_several(inside, [path.name for path in found])
        if not found:
            raise FileProblem(inside, "has no recording", "Record the person there, in a folder with cam_1.mp4, ...")
        folder = found[0]
    project = folder.absolute().parent.parent
    calibration = caliscope_file(project) if folder.absolute().parent.name == "recordings" else None
    if calibration is None or not folder.is_dir() or has_calibration(folder):
        return None
    return TrialLayout(
        folder=folder,
        calibration=calibration,
        places=VideoPlaces(folder=folder, stored=True),
        program="Caliscope",
        others=True,
    )


def caliscope_file(project: Path) -> Path | None:
    """Return the calibration of a Caliscope project; None if the folder is not such a project."""
    current, older = (project / name for name in _CALISCOPE_FILES)
    if current.is_file():
        return current
    if not older.is_file():
        return None
    try:
        tables = read_tables(older)
    except FileProblem:
        return None
    return older if any(isinstance(table, dict) and "port" in table for table in tables.values()) else None


def _opencap(folder: Path) -> TrialLayout | None:
    """Return the layout of a recording of an OpenCap session, or of a session with one recording."""
    session, name = (folder, "") if _opencap_cameras(folder) else (folder.parent, folder.name)
    cameras = _opencap_cameras(session)
    recordings = _opencap_recordings(cameras)
    if not cameras or (name not in ("", *recordings) and folder.exists()):
        return None
    if name and name not in recordings:
        remedy = f"The recordings are {', '.join(recordings)}." if recordings else "The session has no recording."
        raise FileProblem(folder, "is not a recording of the OpenCap session", remedy)
    if not name:
        if len(recordings) > 1:
            _raise_several(session, recordings)
        if not recordings:
            raise FileProblem(session, "has no recording in Videos/Cam*/InputMedia", "Download the videos again.")
        name = recordings[0]
    named = {camera: video for camera, place in cameras.items() if (video := _opencap_video(place, name))}
    vertical, settings = _opencap_metadata(session)
    return TrialLayout(
        folder=folder,
        calibration=session,
        places=VideoPlaces(folder=next(iter(cameras.values())).parent, named=named),
        program="OpenCap",
        vertical=vertical,
        settings=settings,
    )


def _opencap_cameras(session: Path) -> dict[str, Path]:
    """Return the folders of the cameras of a session by name."""
    if not session.is_dir():
        return {}
    return {name: file.parent for name, file in camera_files(session).items() if file.name == FILE_NAME}


def _media(camera: Path) -> Path:
    """Return the folder with the recordings of a camera; data sets that OpenCap published have no `InputMedia`."""
    return camera / "InputMedia" if (camera / "InputMedia").is_dir() else camera


def _opencap_recordings(cameras: Mapping[str, Path]) -> list[str]:
    found = {path.name for camera in cameras.values() for path in _media(camera).iterdir() if videos_in(path)}
    return sorted(name for name in found if name.lower() not in _CALIBRATION_TRIALS)


def _opencap_video(camera: Path, recording: str) -> Path | None:
    """Return the video of a camera: the one that OpenCap synchronised, if there are several."""
    folder = _media(camera) / recording
    videos = videos_in(folder)
    chosen = videos if len(videos) == 1 else [video for video in videos if "sync" in video.stem.lower()]
    if videos and len(chosen) != 1:
        names = ", ".join(video.name for video in videos)
        raise FileProblem(folder, f"has several videos: {names}", "Keep one, or name it under [videos] in trial.toml.")
    return chosen[0] if chosen else None


def _opencap_metadata(session: Path) -> tuple[int | None, dict[str, float]]:
    """Read the vertical axis of the board, and the person's height and mass; what is missing is left out."""
    path = session / _METADATA
    if not path.is_file():
        return None, {}
    tables = read_yaml(path, "It should be the file of an OpenCap session; remove it to use the session without it.")
    board = tables.get("checkerBoard")
    placement = str(board.get("placement", "")).lower() if isinstance(board, dict) else ""
    vertical = next((axis for begin, axis in _PLACEMENTS.items() if placement.startswith(begin)), None)
    settings = {}
    for key, name in (("height_m", "stature_m"), ("mass_kg", "mass_kg")):
        try:
            settings[name] = float(str(tables.get(key)))
        except ValueError:
            continue
    return vertical, settings


def stated_calibration(folder: Path, stated: str | None) -> Path | None:
    """Return the calibration that trial.toml names.

    Args:
        folder: The trial.
        stated: Path relative to the trial; None if the file names none.

    Raises:
        FileProblem: It does not exist.
    """
    if stated is None:
        return None
    path = folder / stated
    if not path.exists():
        raise FileProblem(path, "does not exist", "Correct calibration in trial.toml.")
    return path


def video_places(
    layout: TrialLayout, videos: Mapping[str, str], cameras: Sequence[str], calibration: Path
) -> VideoPlaces:
    """Return the places of the videos of a trial, with those that trial.toml names.

    Args:
        layout: The parts of the trial.
        videos: Paths of videos relative to the trial, by camera.
        cameras: All cameras of the calibration.
        calibration: The file of the calibration.

    Raises:
        FileProblem: A camera of a named video is not in the calibration.
    """
    unknown = [f"'{name}'" for name in videos if name not in cameras]
    if unknown:
        wrong = f"has a video of {', '.join(unknown)} under [videos], which the calibration does not have"
        raise FileProblem(layout.folder / "trial.toml", wrong, f"Its cameras are {', '.join(cameras)}.")
    named = {**layout.places.named, **{name: layout.folder / path for name, path in videos.items()}}
    stored = layout.places.stored or calibration.name == _CALISCOPE_FILES[0]
    return replace(layout.places, named=named, stored=stored)


def board_vertical(calibration: Path) -> int | None:
    """Return the vertical axis of the world of a calibration, if the program that made it states one.

    Args:
        calibration: The calibration, as `marey.io.calibration.readers.calibration_file` returns it.

    Raises:
        FileProblem: The metadata of an OpenCap session are damaged.
    """
    if not calibration.is_dir():
        return None
    session = calibration if (calibration / _METADATA).is_file() else calibration.parent
    return _opencap_metadata(session)[0]


def upward_axis(vertical: int, rig: Rig) -> str:
    """Return the axis that points up, given which one is vertical: cameras are not upside down on average.

    Args:
        vertical: The vertical axis: 0, 1 or 2.
        rig: The cameras.

    Returns:
        The axis as in `[world] up`, for example `-y`.
    """
    upward = -np.mean([camera.camera_from_world.rotation[1, vertical] for camera in rig])
    return ("" if upward >= 0 else "-") + "xyz"[vertical]
