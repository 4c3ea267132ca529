"""The videos or pictures of a calibration session: which cameras there are, and which pictures are synchronous."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from marey.errors import FileProblem
from marey.io.file_names import name_faults
from marey.io.video.video import PICTURE_SUFFIXES, VIDEO_SUFFIXES, Clip, open_stills, open_video

_NUMBERED = re.compile(r"^(?P<camera>.+?)[_\-. ]?(?P<number>\d+)$")
"""Name of a numbered picture: camera, an optional separator, number. A camera's own number needs a separator."""
_SEPARATED = re.compile(r"^(?P<camera>.+)[_\-. ](?P<number>\d+)$")
"""Name of a numbered picture with a separator before the number, as in `cam01_07`."""
_CALISCOPE = "calibration/extrinsic"
"""Sub-folder of the synchronous videos of the board in a project of Caliscope."""
_POSE2SIM = ("calibration/extrinsics", "calibration/intrinsics")
"""Sub-folders with one folder per camera in a project of Pose2Sim."""
_VIDEO_PLACES = ("videos", "calibration", "synchronized_videos")
"""Other sub-folders with videos named like the cameras; FreeMoCap has the last one."""
_FEWEST_PICTURES = 3
"""Number of pictures of a camera from which a folder of Pose2Sim shows a board that moves, not a scene. By hand."""
_OTHER_FOLDERS = ("background", "masks", "marey", "recordings")
"""Sub-folders that do not belong to one camera."""
_REMEDY = (
    "It needs a video of each camera (cam01.mp4, ...), or pictures named camera_number (left_01.jpg, right_01.jpg, "
    "...), "
    "or a folder of pictures for each camera."
)
"""Remedy in the error messages: the expected files."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SessionClip:
    """The pictures of one camera."""

    name: str
    """Name of the camera."""
    clip: Clip
    instants: tuple[int, ...]
    """Number of the instant of each image of the clip; equal numbers are synchronous."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SessionFiles:
    """All pictures of a calibration session."""

    folder: Path
    clips: tuple[SessionClip, ...]
    videos: bool
    """Whether the cameras recorded videos, whose pictures follow each other at a constant rate."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the cameras."""
        return tuple(each.name for each in self.clips)

    @property
    def sizes(self) -> tuple[tuple[int, int], ...]:
        """Width and height of the images of each camera [px]."""
        return tuple(each.clip.size for each in self.clips)

    @property
    def instants(self) -> tuple[int, ...]:
        """Numbers of all instants, in ascending order."""
        return tuple(sorted({number for each in self.clips for number in each.instants}))

    @property
    def rate(self) -> float | None:
        """Frame rate of the videos [Hz]; None for pictures."""
        return self.clips[0].clip.rate if self.videos else None

    def picture_name(self, instant: int) -> str:
        """Return the name of an instant in messages and results."""
        return f"{'frame' if self.videos else 'picture'} {instant}"


def open_session(folder: Path, *, named: Mapping[str, Path] | None = None) -> SessionFiles:
    """Find and open the videos or pictures of a session.

    Args:
        folder: The folder; in projects of Pose2Sim, Caliscope and FreeMoCap, the videos are in its sub-folders.
        named: Video of each camera, where the names of the files are not those of the cameras.

    Returns:
        The cameras in the order of their names.

    Raises:
        FileProblem: There is no folder, no picture, or a file cannot be read.
    """
    if not folder.is_dir():
        raise FileProblem(folder, "is not a folder", _REMEDY)
    if named:
        return _of_videos(folder, named)
    videos = _by_suffix(folder, VIDEO_SUFFIXES) or _by_suffix(folder / _CALISCOPE, VIDEO_SUFFIXES)
    if videos:
        return _of_videos(folder, _by_stem(folder, videos))
    stills = _numbered(_by_suffix(folder, PICTURE_SUFFIXES))
    for place in (folder / inside for inside in _POSE2SIM):
        one_each = {} if stills else _one_video_each(place)
        if one_each:
            return _of_videos(folder, one_each)
        stills = stills or _enough(place)
    for place in () if stills else (folder / inside for inside in _VIDEO_PLACES):
        videos = _by_suffix(place, VIDEO_SUFFIXES)
        if videos:
            return _of_videos(folder, _by_stem(folder, videos))
    stills = stills or _in_folders(folder)
    one_each = {} if stills else _one_video_each(folder)
    if one_each:
        return _of_videos(folder, one_each)
    if not stills:
        raise FileProblem(folder, "has neither videos nor numbered pictures", _REMEDY)
    clips = tuple(
        SessionClip(name=name, clip=open_stills(tuple(files.values())), instants=tuple(files))
        for name, files in sorted(stills.items())
    )
    return SessionFiles(folder=folder, clips=clips, videos=False)


def _by_suffix(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    if not folder.is_dir():
        return []
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in suffixes and path.is_file())


def _by_stem(folder: Path, videos: list[Path]) -> dict[str, Path]:
    names = [path.stem for path in videos]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise FileProblem(folder, f"has several videos of camera '{twice[0]}'", "Keep one of them.")
    return dict(zip(names, videos, strict=True))


def _one_video_each(place: Path) -> dict[str, Path]:
    """Return the videos of the cameras if at least two sub-folders hold one video each."""
    inner = sorted(path for path in place.iterdir() if path.is_dir()) if place.is_dir() else []
    inner = [path for path in inner if not path.name.startswith(".") and path.name.lower() not in _OTHER_FOLDERS]
    videos = {path.name: _by_suffix(path, VIDEO_SUFFIXES) for path in inner}
    if sum(len(found) == 1 for found in videos.values()) < 2:
        return {}
    return {_camera_of(name): found[0] for name, found in videos.items() if len(found) == 1}


def _enough(place: Path) -> dict[str, dict[int, Path]]:
    """Return the pictures of the cameras in their folders, if there are enough of them to calibrate."""
    found = {_camera_of(name): files for name, files in _in_folders(place).items()}
    return found if max(map(len, found.values()), default=0) >= _FEWEST_PICTURES else {}


def _camera_of(folder_name: str) -> str:
    """Return the camera of a folder of Pose2Sim, such as `int_cam01_img`."""
    return re.sub(r"_img$", "", re.sub(r"^(int|ext)_", "", folder_name)) or folder_name


def _of_videos(folder: Path, videos: Mapping[str, Path]) -> SessionFiles:
    wrong = [fault for name in videos for fault in name_faults(name)]
    if wrong:
        raise FileProblem(folder, f"has a camera that {wrong[0]}", "Give it a plain name.")
    clips = [(name, open_video(path)) for name, path in sorted(videos.items())]
    opened = tuple(SessionClip(name=name, clip=clip, instants=tuple(range(clip.count))) for name, clip in clips)
    return SessionFiles(folder=folder, clips=opened, videos=True)


def _numbered(pictures: list[Path]) -> dict[str, dict[int, Path]]:
    """Group pictures by camera and number; where several share a number, the folder is not numbered."""
    for pattern in (_SEPARATED, _NUMBERED):
        found: dict[str, dict[int, Path]] = {}
        for path in pictures:
            match = pattern.match(path.stem)
            if match:
                found.setdefault(match["camera"], {})[int(match["number"])] = path
        if found:
            return {name: dict(sorted(files.items())) for name, files in found.items()}
    return {}


def _in_folders(folder: Path) -> dict[str, dict[int, Path]]:
    """Group pictures by sub-folder; the last number in a name is the instant, or else the order of the names."""
    found: dict[str, dict[int, Path]] = {}
    places = sorted(folder.iterdir()) if folder.is_dir() else []
    for inner in (path for path in places if path.is_dir() and not path.name.startswith(".")):
        pictures = _by_suffix(inner, PICTURE_SUFFIXES)
        numbers = [re.findall(r"\d+", path.stem) for path in pictures]
        chosen = [int(each[-1]) if each else -1 for each in numbers]
        if len(set(chosen)) < len(chosen) or -1 in chosen:
            chosen = list(range(len(pictures)))
        if pictures:
            found[inner.name] = dict(sorted(zip(chosen, pictures, strict=True)))
    return found
