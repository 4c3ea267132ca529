"""The videos or pictures of a calibration session: which cameras there are, and which pictures are synchronous."""

import re
from dataclasses import dataclass
from pathlib import Path

from marey.errors import FileProblem
from marey.io.video.video import PICTURE_SUFFIXES, VIDEO_SUFFIXES, Clip, open_stills, open_video

_NUMBERED = re.compile(r"^(?P<camera>.+?)[_\-. ]?(?P<number>\d+)$")
"""Name of a numbered picture: camera, an optional separator, number. A camera's own number needs a separator."""
_SEPARATED = re.compile(r"^(?P<camera>.+)[_\-. ](?P<number>\d+)$")
"""Name of a numbered picture with a separator before the number, as in `cam01_07`."""
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


def open_session(folder: Path) -> SessionFiles:
    """Find and open the videos or pictures of a session.

    Args:
        folder: The folder.

    Returns:
        The cameras in the order of their names.

    Raises:
        FileProblem: There is no folder, no picture, or a file cannot be read.
    """
    if not folder.is_dir():
        raise FileProblem(folder, "is not a folder", _REMEDY)
    for place in (folder, folder / "videos", folder / "calibration"):
        videos = _by_suffix(place, VIDEO_SUFFIXES)
        if videos:
            return _of_videos(folder, videos)
    stills = _numbered(_by_suffix(folder, PICTURE_SUFFIXES)) or _in_folders(folder)
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


def _of_videos(folder: Path, videos: list[Path]) -> SessionFiles:
    names = [path.stem for path in videos]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise FileProblem(folder, f"has several videos of camera '{twice[0]}'", "Keep one of them.")
    clips = [(path.stem, open_video(path)) for path in videos]
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
    for inner in sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith(".")):
        pictures = _by_suffix(inner, PICTURE_SUFFIXES)
        numbers = [re.findall(r"\d+", path.stem) for path in pictures]
        chosen = [int(each[-1]) if each else -1 for each in numbers]
        if len(set(chosen)) < len(chosen) or -1 in chosen:
            chosen = list(range(len(pictures)))
        if pictures:
            found[inner.name] = dict(sorted(zip(chosen, pictures, strict=True)))
    return found
