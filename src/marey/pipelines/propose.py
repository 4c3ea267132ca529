"""`marey init`: which video belongs to which camera of a trial, proposed for the user to check."""

import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from marey.errors import FileProblem
from marey.io.calibration.readers import calibration_file, read_rig
from marey.io.trial.layout import TrialLayout, find_layout, has_calibration
from marey.io.trial.settings import read_settings
from marey.io.trial.trial_file import write_trial_file
from marey.io.video.clip_files import VideoPlaces, last_number, name_key, pair_videos, videos_in
from marey.io.video.pictures import write_picture
from marey.io.video.video import Video, open_video
from marey.view.pictures.contact_sheet import contact_sheet

_CHAPTER = re.compile(r"^(?:G[HXL](?P<chapter>\d{2})|GP(?P<older>\d{2}))(?P<number>\d{4})$", re.IGNORECASE)
"""Name of a chapter of a GoPro: its number and that of the recording; the first one of older models is GOPR1234."""
_DEVICE_NAME = re.compile(
    r"^(?:G[HXLP]\d{6}|GOPR\d{4}|(?:IMG|VID|PXL|DSC|MVI|DJI|MOV|C|P|S)_?\d{3,}.*|\d{6,}.*)$", re.IGNORECASE
)
"""Names that cameras and phones give their videos by themselves."""
_OTHER_FOLDERS = ("background", "masks", "marey", "images", "pose", "surface_masks")
"""Sub-folders of a trial that do not hold the video of a camera."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ProposedVideo:
    """The video that is proposed for a camera."""

    camera: str
    """Name of the camera."""
    video: Video
    why: str
    """The evidence for it, for example "the name"."""
    problem: str = ""
    """What prevents its use, for example another size than that of the calibration; empty if nothing does."""

    @property
    def is_certain(self) -> bool:
        """Whether the name of the video states the camera."""
        return "order" not in self.why and "size" not in self.why


@dataclass(frozen=True, eq=False, kw_only=True)
class TrialProposal:
    """Where the calibration and the videos of a trial are, for the user to check.

    Example:
        >>> import marey
        >>> proposal = marey.propose_trial(marey.example_folder())
        >>> {each.camera: each.video.path.name for each in proposal.videos}["cam01"]
        'cam01.mp4'
    """

    folder: Path
    """The trial."""
    program: str
    """The program that made the folder; empty for a folder of marey's own form."""
    calibration: Path | None
    """The calibration; None if there is none yet, so that the cameras are still to be calibrated."""
    stated: bool
    """Whether the calibration is elsewhere, so that trial.toml must name it."""
    videos: tuple[ProposedVideo, ...]
    """One video for each camera that has one."""
    missing: tuple[str, ...]
    """Cameras without a video."""
    left_out: tuple[tuple[Path, str], ...]
    """Videos that belong to no camera, with the reason."""

    def __str__(self) -> str:
        return "\n".join(self.lines())

    def lines(self) -> list[str]:
        """Return the proposal as a table, with what is to be checked."""
        origin = f" ({self.program})" if self.program else ""
        found = "none yet" if self.calibration is None else _relative(self.calibration, self.folder)
        if self.calibration is not None and self.calibration.is_dir():
            found = f"one file of each camera in {found}"
        rows: list[tuple[str, ...]] = [("camera", "video", "size", "Hz", "frames", "because of")]
        rows += [self._row(each) for each in self.videos]
        widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
        table = ["  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip() for row in rows]
        more = [f"{_relative(path, self.folder)} is left out: {why}." for path, why in self.left_out]
        more += [f"There is no video of the camera '{name}'." for name in self.missing]
        more += [f"{each.video.path.name} {each.problem}." for each in self.videos if each.problem]
        if not all(each.is_certain for each in self.videos):
            more.append("Check the videos that were paired by size or order: --picture FILE shows an image of each.")
        return [f"Calibration: {found}{origin}", *table, *more]

    def _row(self, each: ProposedVideo) -> tuple[str, ...]:
        size, rate = f"{each.video.size[0]} x {each.video.size[1]}", each.video.rate
        turned = f" (rotated {360 - 90 * each.video.quarters})" if each.video.quarters and each.video.upright else ""
        hertz = "?" if rate is None else f"{rate:.5g}"
        path = _relative(each.video.path, self.folder)
        return each.camera, path, size + turned, hertz, str(each.video.count), each.why

    def draw(self, path: Path | str) -> Path:
        """Draw an image from the middle of each video with its name and its camera, to check the proposal.

        Args:
            path: The picture, PNG or JPEG.

        Returns:
            The picture.

        Raises:
            FileProblem: An image is damaged, or the picture cannot be written.
        """
        clips = {f"{each.camera}: {each.video.path.name}": each.video for each in self.videos}
        write_picture(path, contact_sheet({name: clip.image(clip.count // 2) for name, clip in clips.items()}))
        return Path(path)

    def write(self) -> Path:
        """Write the proposal to trial.toml in the folder of the trial; what is in it stays.

        Returns:
            The file.

        Raises:
            FileProblem: A camera has no usable video, or trial.toml names the videos already.
        """
        if self.missing:
            wrong = f"has no video of {', '.join(self.missing)}"
            raise FileProblem(self.folder, wrong, "Add it, or remove the camera from the calibration.")
        problems = [each for each in self.videos if each.problem]
        if problems:
            raise FileProblem(problems[0].video.path, problems[0].problem, "Use the calibration of this recording.")
        calibration = _relative(self.calibration, self.folder) if self.calibration is not None and self.stated else None
        videos = {each.camera: _relative(each.video.path, self.folder) for each in self.videos}
        return write_trial_file(self.folder, videos=videos, calibration=calibration)


def _relative(path: Path, folder: Path) -> str:
    return Path(os.path.relpath(path, folder)).as_posix()


def propose_trial(folder: Path | str, *, calibration: Path | str | None = None) -> TrialProposal:
    """Propose which video belongs to which camera, as the command `marey init` does.

    The names are compared first, then what they contain, the sizes of the images, and at last the order.

    Args:
        folder: The folder of a trial, or of a session to be calibrated, in the form of marey or another program.
        calibration: The calibration, if it is elsewhere.

    Returns:
        The proposal; its method `write` stores it in trial.toml.

    Raises:
        FileProblem: The folder has no videos, or something in it cannot be used.

    Example:
        >>> import marey
        >>> print(marey.propose_trial(marey.example_folder()).lines()[0])
        Calibration: cameras.toml
    """
    layout = find_layout(Path(folder))
    file = _calibration(layout, None if calibration is None else Path(calibration))
    cameras = {} if file is None else {camera.name: camera.size for camera in read_rig(file)}
    videos, left_out = _without_chapters(_candidates(layout))
    if not videos:
        raise FileProblem(layout.places.folder, "has no videos", "Give the folder that holds one video of each camera.")
    opened = {path: open_video(path) for path in videos}
    if cameras:
        pairs = _paired(layout, cameras, opened)
    else:
        names = _named(videos)
        pairs = {name: (path, "a new name" if name != path.stem else "the name") for name, path in names.items()}
    used = {path for path, _ in pairs.values()}
    left_out += [(path, "no camera is left for it") for path in videos if path not in used]
    return TrialProposal(
        folder=layout.folder,
        program=layout.program,
        calibration=file,
        stated=calibration is not None,
        videos=tuple(
            _proposed(name, opened[path], why, cameras.get(name), layout) for name, (path, why) in pairs.items()
        ),
        missing=tuple(name for name in cameras if name not in pairs),
        left_out=tuple(left_out),
    )


def _calibration(layout: TrialLayout, given: Path | None) -> Path | None:
    stated = read_settings(layout.folder).calibration
    if given is None and stated is not None:
        given = layout.folder / stated
    if given is not None:
        return calibration_file(given)
    place = layout.calibration
    return calibration_file(place) if place.is_file() or has_calibration(place) else None


def _candidates(layout: TrialLayout) -> list[Path]:
    """Return the videos of the folder or, if there are none, of its sub-folders."""
    if layout.places.named:
        return list(layout.places.named.values())
    place = layout.places.folder
    found = videos_in(place)
    if found or not place.is_dir():
        return found
    inner = [path for path in sorted(place.iterdir()) if path.is_dir() and path.name.lower() not in _OTHER_FOLDERS]
    return [video for path in inner for video in videos_in(path)]


def _without_chapters(videos: Sequence[Path]) -> tuple[list[Path], list[tuple[Path, str]]]:
    """Leave out the later chapters of long recordings of a GoPro, whose first one alone is too short."""
    later = []
    for path in videos:
        match = _CHAPTER.match(path.stem)
        if match and int(match["chapter"] or 2) > 1:
            later.append(path)
    why = "it continues another video of the same GoPro; join them first (for example with ffmpeg)"
    return [path for path in videos if path not in later], [(path, why) for path in later]


def _named(videos: Sequence[Path]) -> dict[str, Path]:
    """Name cameras that are not calibrated yet: like their videos or folders, or cam01, cam02, ..."""
    ordered = sorted(videos, key=lambda path: (path.parent, last_number(path.stem)))
    stems = [path.stem for path in ordered]
    folders = [path.parent.name for path in ordered]
    if len(set(folders)) == len(folders) > 1:
        return dict(zip(folders, ordered, strict=True))
    if len(set(stems)) == len(stems) and not any(_DEVICE_NAME.match(stem) for stem in stems):
        return dict(zip(stems, ordered, strict=True))
    return {f"cam{number:02d}": path for number, path in enumerate(ordered, 1)}


def _paired(
    layout: TrialLayout, cameras: Mapping[str, tuple[int, int]], opened: Mapping[Path, Video]
) -> dict[str, tuple[Path, str]]:
    """Pair cameras with videos by ever weaker evidence."""
    named = {name: path for name, path in layout.places.named.items() if name in cameras}
    places = VideoPlaces(folder=layout.places.folder, named=named)
    found = {
        name: (path, f"the folder of {layout.program}" if name in named else "the name")
        for name, path in pair_videos(list(cameras), list(opened), places).items()
    }
    rules: tuple[tuple[str, Callable[[str, Path], bool]], ...] = (
        ("the name of its folder", lambda name, path: name_key(name) == name_key(path.parent.name)),
        ("a part of the name", lambda name, path: _contains(path.stem, name) or _contains(name, path.stem)),
        ("a part of the name of its folder", lambda name, path: _contains(path.parent.name, name)),
        ("the size of the image", lambda name, path: _fits(opened[path], cameras[name])),
    )
    for why, fits in rules:
        rest = [name for name in cameras if name not in found]
        free = [path for path in opened if path not in {path for path, _ in found.values()}]
        for name in rest:
            fitting = [path for path in free if fits(name, path)]
            if len(fitting) == 1 and [other for other in rest if fits(other, fitting[0])] == [name]:
                found[name] = (fitting[0], why)
    rest = [name for name in cameras if name not in found]
    free = sorted(
        (path for path in opened if path not in {path for path, _ in found.values()}),
        key=lambda path: (path.parent, last_number(path.stem)),
    )
    if len(rest) == len(free):
        found |= {name: (path, "the order: check it") for name, path in zip(rest, free, strict=True)}
    return {name: found[name] for name in cameras if name in found}


def _contains(text: str, part: str) -> bool:
    """Return whether the words and numbers of a name occur one after the other in another name."""
    whole, wanted = name_key(text), name_key(part)
    if not wanted or all(isinstance(each, int) for each in wanted):
        return False
    return any(whole[at : at + len(wanted)] == wanted for at in range(len(whole) - len(wanted) + 1))


def _fits(video: Video, size: tuple[int, int]) -> bool:
    return size in (video.size, video.as_stored().size)


def _proposed(name: str, video: Video, why: str, size: tuple[int, int] | None, layout: TrialLayout) -> ProposedVideo:
    problem = ""
    if size is not None and not _fits(video, size):
        problem = f"is {video.size[0]} x {video.size[1]}, but camera '{name}' was calibrated at {size[0]} x {size[1]}"
    stored = size is not None and video.quarters and video.as_stored().size == size
    shown = video.as_stored() if stored and (layout.places.stored or video.size != size) else video
    return ProposedVideo(camera=name, video=shown, why=why, problem=problem)
