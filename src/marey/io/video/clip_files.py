"""The video or stills of each camera in a folder: matching of file names with the names of cameras."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from marey.cameras.rig import Rig
from marey.errors import FileProblem
from marey.io.video.video import PICTURE_SUFFIXES, VIDEO_SUFFIXES, Clip, Video, open_clip, open_stills
from marey.wording import listed

_SAME_WORDS = {"camera": "cam", "port": "cam"}
"""Words in names of videos that mean the same; old versions of Caliscope write `port_1.mp4` for the camera `cam_1`."""


@dataclass(frozen=True, eq=False, kw_only=True)
class VideoPlaces:
    """Where the videos of the cameras are, and how their names are paired."""

    folder: Path
    """Folder with the videos or stills."""
    named: Mapping[str, Path] = field(default_factory=dict)
    """Videos of cameras whose names need not agree, by camera."""
    in_order: bool = False
    """Whether videos without an own camera are those of the remaining cameras in their order, as in Pose2Sim."""
    stored: bool = False
    """Whether the calibration belongs to the images as they are stored, before a rotation by the container."""


def find_clips(
    folder: Path, names: Sequence[str], *, others: bool = False, places: VideoPlaces | None = None
) -> tuple[Clip, ...]:
    """Find and open one clip per camera.

    The names of files are compared without regard to case, ending and leading zeros.

    Args:
        folder: The trial.
        names: The cameras.
        others: Whether the folder may contain videos of other cameras.
        places: Where the videos are; by default in the folder.

    Returns:
        The clips, in the order of the names.

    Raises:
        FileProblem: A camera has no clip or several, or a video has no camera.
    """
    return _opened(folder, names, others, places or VideoPlaces(folder=folder))[0]


def find_fitting_clips(
    folder: Path, rig: Rig, *, others: bool = False, places: VideoPlaces | None = None
) -> tuple[tuple[Clip, ...], tuple[str, ...]]:
    """Find and open one clip per camera of a rig, in the orientation to which the calibration belongs.

    Args:
        folder: The trial.
        rig: The cameras.
        others: Whether the folder may contain videos of other cameras.
        places: Where the videos are; by default in the folder.

    Returns:
        The clips, in the order of the cameras, and remarks for the report.

    Raises:
        FileProblem: A camera has no clip or several, a video has no camera, or a clip has another size.
    """
    places = places or VideoPlaces(folder=folder)
    clips, notes = _opened(folder, rig.names, others, places)
    pairs = zip(clips, rig, strict=True)
    fitting = tuple(fitting_clip(clip, camera.size, stored=places.stored) for clip, camera in pairs)
    for clip, camera in zip(fitting, rig, strict=True):
        require_size(clip, camera.name, camera.size)
    stored = [f"'{name}'" for name, clip, own in zip(rig.names, clips, fitting, strict=True) if own is not clip]
    more = f"The videos of {listed(stored)} are not rotated as their containers state: the calibration is not either."
    return fitting, (*notes, *([more] if stored else []))


def fitting_clip(clip: Clip, size: tuple[int, int], *, stored: bool = False) -> Clip:
    """Return a clip without the rotation that its container states if the calibration belongs to the stored images.

    Args:
        clip: The clip.
        size: Width and height of the calibration [px].
        stored: Whether the calibration belongs to the images as they are stored; otherwise, it does if only they fit.
    """
    if not isinstance(clip, Video) or clip.quarters == 0:
        return clip
    as_stored = clip.as_stored()
    return as_stored if as_stored.size == size and (stored or clip.size != size) else clip


def _opened(
    folder: Path, names: Sequence[str], others: bool, places: VideoPlaces
) -> tuple[tuple[Clip, ...], tuple[str, ...]]:
    paired = pair_videos(names, videos_in(places.folder), places)
    found = [(paired[name],) if name in paired else stills_of(places.folder, name) for name in names]
    missing = [name for name, paths in zip(names, found, strict=True) if not paths]
    strange = [path.name for path in videos_in(places.folder) if path not in paired.values()]
    if missing:
        pair = f" Rename the videos without a camera, {', '.join(strange)}, or pair them by `marey init`."
        hint = pair if strange else ""
        where = "<camera>.mp4, stills <camera>_<number>.jpg, or images/<camera>.jpg"
        wrong = f"has no video of {listed(map(repr, missing))}"
        raise FileProblem(places.folder, wrong, f"Add {where}, or select the other cameras (--cameras).{hint}")
    if strange and not (others or places.named):
        wrong = f"has videos of cameras that are not in the calibration: {', '.join(strange)}"
        remedy = f"Calibrate them, select only {listed(map(repr, names))} (--cameras), or move the files elsewhere."
        raise FileProblem(places.folder, wrong, remedy)
    return _open_all(found), _order_notes(names, paired, places)


def _order_notes(names: Sequence[str], paired: Mapping[str, Path], places: VideoPlaces) -> tuple[str, ...]:
    """Return the remark on videos that were paired by their order."""
    by_name = pair_videos(names, videos_in(places.folder), VideoPlaces(folder=places.folder, named=places.named))
    guessed = [f"{name} {path.name}" for name, path in paired.items() if name not in by_name]
    if not guessed:
        return ()
    return (f"Videos were paired with cameras by their order, as in Pose2Sim; check it: {', '.join(guessed)}.",)


def videos_in(folder: Path) -> list[Path]:
    """Return the videos in a folder, sorted by name; none if it does not exist."""
    if not folder.is_dir():
        return []
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in VIDEO_SUFFIXES and path.is_file())


def pair_videos(names: Sequence[str], videos: Sequence[Path], places: VideoPlaces) -> dict[str, Path]:
    """Pair cameras with videos by their names.

    In turn, the names are compared exactly, without regard to case, and without regard to separators and leading zeros
    (`Cam1`, `cam_01`). Then the remaining ones are paired by their order, if that is the rule of the folder.

    Args:
        names: The cameras.
        videos: The videos.
        places: Named videos, and whether the order counts.

    Returns:
        The video of each camera that has one.

    Raises:
        FileProblem: A camera has several videos, or a named one does not exist.
    """
    paired = _named(names, places)
    rules: tuple[Callable[[str], object], ...] = (str, str.casefold, name_key)
    for rule in rules:
        free = [video for video in videos if video not in paired.values()]
        _pair(paired, names, free, rule)
    if places.in_order:
        rest = [name for name in names if name not in paired]
        unpaired = [video for video in videos if video not in paired.values()]
        free = sorted(unpaired, key=lambda path: last_number(path.stem))
        if len(rest) == len(free):
            paired |= dict(zip(rest, free, strict=True))
    return paired


def _named(names: Sequence[str], places: VideoPlaces) -> dict[str, Path]:
    found = {name: places.named[name] for name in names if name in places.named}
    for name, path in found.items():
        if not path.is_file():
            raise FileProblem(path, f"does not exist, but is the video of '{name}'", "Correct [videos] in trial.toml.")
    twice = sorted({str(path) for path in found.values() if list(found.values()).count(path) > 1})
    if twice:
        cameras = listed(repr(name) for name, path in found.items() if str(path) == twice[0])
        raise FileProblem(twice[0], f"is the video of {cameras}", "Correct [videos] in trial.toml.")
    return found


def _pair(paired: dict[str, Path], names: Sequence[str], free: Sequence[Path], rule: Callable[[str], object]) -> None:
    """Add the pairs whose names agree under a rule, which must be the same for one camera and one video."""
    keys = [rule(name) for name in names]
    for name, key in zip(names, keys, strict=True):
        if name in paired or keys.count(key) > 1:
            continue
        found = [path for path in free if rule(path.stem) == key]
        if len(found) > 1:
            wrong = f"has several videos of '{name}': {', '.join(path.name for path in found)}"
            raise FileProblem(found[0].parent, wrong, "Keep one of them, or name it under [videos] in trial.toml.")
        if found:
            paired[name] = found[0]


def name_key(name: str) -> tuple[str | int, ...]:
    """Return the words and numbers of a name, which are equal for `Cam1`, `cam_01` and `CAM-001`."""
    parts = re.findall(r"\d+|[^\W\d_]+", name.casefold())
    return tuple(int(part) if part.isdigit() and len(part) < 20 else _SAME_WORDS.get(part, part) for part in parts)


def last_number(name: str) -> tuple[bool, int, str]:
    """Return a key that sorts names by the last number in them, and names without a number last."""
    numbers = re.findall(r"\d{1,18}", name)
    return (False, int(numbers[-1]), name) if numbers else (True, 0, name)


def _open_all(found: Sequence[tuple[Path, ...]]) -> tuple[Clip, ...]:
    stills = [paths for paths in found if paths[0].suffix.lower() in PICTURE_SUFFIXES]
    least, most = min(stills, key=len, default=()), max(stills, key=len, default=())
    if len(least) < len(most):
        wrong = f"belongs to a camera with {len(least)} stills, but {most[0].name} to one with {len(most)}"
        raise FileProblem(least[0], wrong, "All cameras should have the same number of stills.")
    pictures = [paths[0].suffix.lower() in PICTURE_SUFFIXES for paths in found]
    return tuple(
        open_stills(paths) if still else open_clip(paths[0]) for paths, still in zip(found, pictures, strict=True)
    )


def pictures_of(folder: Path, name: str) -> tuple[Path, ...]:
    """Find one camera's video, or its stills in the order of their numbers.

    Args:
        folder: The trial.
        name: The camera.

    Returns:
        The video, or the stills; empty if there are none.

    Raises:
        FileProblem: There are several videos, or several stills with the same number.
    """
    paired = pair_videos([name], videos_in(folder), VideoPlaces(folder=folder))
    return (paired[name],) if name in paired else stills_of(folder, name)


def stills_of(folder: Path, name: str) -> tuple[Path, ...]:
    """Find one camera's stills in the order of their numbers, or its single image in `images`.

    Args:
        folder: The trial.
        name: The camera.

    Raises:
        FileProblem: There are several stills with the same number.
    """
    numbered = re.compile(re.escape(name) + r"_(\d+)", re.IGNORECASE)
    stills = [
        (int(match[1]), path)
        for path in (sorted(folder.iterdir()) if folder.is_dir() else [])
        if path.suffix.lower() in PICTURE_SUFFIXES and (match := numbered.fullmatch(path.stem)) and path.is_file()
    ]
    if stills:
        _require_one_each(folder, name, [number for number, _ in stills])
        return tuple(path for _, path in sorted(stills))
    return tuple(files_named(folder / "images", (name,), PICTURE_SUFFIXES))[:1]


def files_named(folder: Path, names: Sequence[str], suffixes: Sequence[str]) -> list[Path]:
    """Find the files of one camera in a folder, without regard to case.

    Args:
        folder: The folder.
        names: Names without ending: that of the camera, and others that it has. The first with any files counts.
        suffixes: Endings in lower case.
    """
    files = sorted(folder.iterdir()) if folder.is_dir() else []
    fitting = [path for path in files if path.suffix.lower() in suffixes]
    for name in names:
        exact = [path for path in fitting if path.stem == name]
        found = exact or [path for path in fitting if path.stem.casefold() == name.casefold()]
        if found:
            return found
    return []


def _require_one_each(folder: Path, name: str, numbers: Sequence[int]) -> None:
    twice = sorted({number for number in numbers if numbers.count(number) > 1})
    if twice:
        raise FileProblem(folder, f"has several stills of '{name}' with the number {twice[0]}", "Keep one of them.")


def require_size(clip: Clip, name: str, size: tuple[int, int]) -> None:
    """Check that a clip has the size of its camera's calibration.

    Args:
        clip: The clip.
        name: The camera.
        size: Width and height of the calibration [px].

    Raises:
        FileProblem: The clip has another size.
    """
    if clip.size == size:
        return
    turned = " (after the rotation that its container states)" if isinstance(clip, Video) and clip.quarters else ""
    wrong = f"is {clip.size[0]} x {clip.size[1]}{turned}, but camera '{name}' was calibrated at {size[0]} x {size[1]}"
    remedy = "Use the calibration of this recording."
    if clip.size == size[::-1]:
        remedy = "It seems to be rotated by 90 degrees: rotate it, or calibrate the camera again."
    elif clip.size[0] * size[1] == clip.size[1] * size[0]:
        remedy = f"It was resized: calibrate at its size, or use one of {size[0]} x {size[1]}."
    raise FileProblem(clip.path, wrong, remedy)
