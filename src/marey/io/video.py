"""One camera's pictures, from a video or from stills, decoded as they are needed and by exact frame numbers."""

import os
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import final

import cv2
import numpy as np

from marey.arrays import Floats, Image, frozen
from marey.errors import FileProblem

PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
VIDEO_SUFFIXES = (
    *(".mp4", ".avi", ".mov", ".mkv", ".m4v", ".webm", ".mpg", ".mpeg", ".mts", ".m2ts"),
    *(".wmv", ".flv", ".mjpeg", ".mjpg", ".ts", ".3gp", ".ogv", ".mxf", ".dv"),
)

_SEEK_BEYOND = 60
"""Frames that are sooner decoded and thrown away than sought (measured: a seek costs as much as 30 to 60 frames)."""
_HEADER_SLACK = 3
"""Frames by which an intact file's header may be wrong; MPEG-4 in AVI counts empty packets."""
_COPY_AGAIN = "Copy the file again from the camera"


class Clip(ABC):
    """The pictures of one camera, numbered from 0."""

    path: Path
    """The file; for stills the first one."""
    size: tuple[int, int]
    """Width and height [px]."""
    count: int
    """Number of pictures that can be read."""
    rate: float | None
    """Pictures a second as the container says; None for stills."""

    @property
    @abstractmethod
    def paths(self) -> tuple[Path, ...]:
        """All its files."""

    @abstractmethod
    def images(self, frames: Iterable[int]) -> Iterator[Image]:
        """Decode pictures one after the other; never more than one is held.

        Args:
            frames: Which, best in rising order; a number may come again.

        Yields:
            (height, width, 3) uint8, blue, green, red.

        Raises:
            FileProblem: A picture is damaged; the message names its frame.
        """

    def image(self, frame: int) -> Image:
        """Decode one picture.

        Args:
            frame: Which.

        Returns:
            (height, width, 3) uint8, blue, green, red.

        Raises:
            FileProblem: It is damaged.
        """
        return next(iter(self.images([frame])))


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class Video(Clip):
    """A video file."""

    path: Path
    size: tuple[int, int]
    count: int
    rate: float | None
    times_ms: Floats | None
    """When each frame is shown [ms], for checking a seek; None where the container's times do not tell frames apart."""

    @property
    def paths(self) -> tuple[Path, ...]:
        """The one file."""
        return (self.path,)

    def images(self, frames: Iterable[int]) -> Iterator[Image]:
        """Decode pictures one after the other; see `Clip.images`."""
        decoder = _Decoder(self)
        try:
            for frame in frames:
                yield decoder.image(frame)
        finally:
            decoder.close()


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class Stills(Clip):
    """Single pictures, one a frame."""

    files: tuple[Path, ...]
    """In the order of the frames."""
    size: tuple[int, int]
    rate: None = None

    @property
    def paths(self) -> tuple[Path, ...]:
        """All its files."""
        return self.files

    @property
    def path(self) -> Path:  # type: ignore[override]
        """The first picture."""
        return self.files[0]

    @property
    def count(self) -> int:  # type: ignore[override]
        """Number of pictures."""
        return len(self.files)

    def images(self, frames: Iterable[int]) -> Iterator[Image]:
        """Read pictures one after the other; see `Clip.images`."""
        for frame in frames:
            image = read_picture(self.files[frame])
            if (image.shape[1], image.shape[0]) != self.size:
                sizes = f"{image.shape[1]} x {image.shape[0]} and {self.path.name} {self.size[0]} x {self.size[1]}"
                raise FileProblem(self.files[frame], f"has the size {sizes}", "All stills of a camera have one size.")
            yield image


def open_clip(path: Path) -> Clip:
    """Open a video, or a picture as a clip of one frame.

    Args:
        path: The file.

    Returns:
        The clip; nothing but its first picture was decoded where the container is sound.

    Raises:
        FileProblem: It cannot be opened, or breaks off before its end.
    """
    if path.suffix.lower() in PICTURE_SUFFIXES:
        return open_stills((path,))
    return open_video(path)


def open_stills(paths: tuple[Path, ...]) -> Stills:
    """Take single pictures as a clip.

    Args:
        paths: The files in their order.

    Returns:
        The clip.

    Raises:
        FileProblem: The first cannot be read; the others are read when they are needed.
    """
    image = read_picture(paths[0])
    return Stills(files=paths, size=(image.shape[1], image.shape[0]))


def read_picture(path: Path) -> Image:
    """Read one picture.

    Args:
        path: The file.

    Returns:
        (height, width, 3) uint8, blue, green, red.

    Raises:
        FileProblem: It is no picture or damaged.
    """
    try:
        content = np.fromfile(path, np.uint8)
        image = cv2.imdecode(content, cv2.IMREAD_COLOR) if len(content) else None
    except (OSError, cv2.error) as error:
        raise FileProblem(path, f"cannot be read ({error})", f"{_COPY_AGAIN}.") from error
    if image is None:
        raise FileProblem(path, "is no picture that can be read, or damaged", f"{_COPY_AGAIN}, or save it as PNG.")
    return np.asarray(image, np.uint8)


def open_video(path: Path) -> Video:
    """Open a video and find out how many pictures can be read from it.

    The packets are counted without decoding them; where their times do not match what the decoder gives (empty packets
    of MPEG-4 in AVI), the pictures are counted by decoding them once.

    Args:
        path: The file.

    Returns:
        The clip.

    Raises:
        FileProblem: It cannot be opened, or breaks off before its end.
    """
    capture = _open(path)
    try:
        header, rate = capture.get(cv2.CAP_PROP_FRAME_COUNT), capture.get(cv2.CAP_PROP_FPS)
        found, first = capture.read()
        if not found:
            raise FileProblem(
                path, "opens, but not one picture can be decoded", f"{_COPY_AGAIN}, or convert it to MP4."
            )
        first_time = capture.get(cv2.CAP_PROP_POS_MSEC)
    finally:
        capture.release()
    times = _packet_times(path)
    sound = len(times) > 0 and len(np.unique(times)) == len(times) and abs(times[0] - first_time) < 1e-3
    count = len(times) if sound else _count_by_decoding(path)
    _require_all(path, header, rate, max(count, len(times)))
    size = (first.shape[1], first.shape[0])
    return Video(path=path, size=size, count=count, rate=_sane(rate), times_ms=frozen(times) if sound else None)


def _require_all(path: Path, header: float, rate: float, readable: int) -> None:
    """Compare what can be read with what the header promises (nothing where a live recording left it open)."""
    missing = header - readable
    if 0 < header < 1e7 and _sane(rate) is not None and missing > max(_HEADER_SLACK, 0.01 * header):
        wrong = f"breaks off: its header promises {header:.0f} frames, {readable} can be read"
        remedy = f"{_COPY_AGAIN}; if that is all there is, write it anew (for example with ffmpeg)."
        raise FileProblem(path, wrong, remedy)


def _sane(rate: float) -> float | None:
    # Containers without a rate give 0, NaN or their clock's ticks.
    return float(rate) if np.isfinite(rate) and 0 < rate < 10000 else None


def _open(path: Path, *, raw: bool = False) -> cv2.VideoCapture:
    """Open a video with one decoding thread: the cameras are decoded beside each other."""
    # FFmpeg and OpenCV would write their own lines about damaged files between ours.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)
    if not path.is_file():
        raise FileProblem(path, "does not exist", "Check its name.")
    parameters = [cv2.CAP_PROP_FORMAT, -1] if raw else [cv2.CAP_PROP_N_THREADS, 1]
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG, parameters)
    if not capture.isOpened() and not raw:
        wrong = "cannot be opened as a video: it is empty, damaged, or of a kind that OpenCV does not read"
        raise FileProblem(path, wrong, f"{_COPY_AGAIN}, or convert it to MP4 (H.264).")
    return capture


def _packet_times(path: Path) -> Floats:
    """List the times [ms] of all packets in the order in which they are shown, without decoding."""
    capture, times = _open(path, raw=True), []
    while capture.isOpened() and capture.grab():
        times.append(capture.get(cv2.CAP_PROP_POS_MSEC))
    capture.release()
    return np.sort(np.array(times))


def _count_by_decoding(path: Path) -> int:
    capture, count = _open(path), 0
    while capture.grab():
        count += 1
    capture.release()
    return count


class _Decoder:
    """A place in a video that is being read."""

    def __init__(self, video: Video):
        self.video = video
        self.capture = _open(video.path)
        self.next = 0

    def close(self) -> None:
        self.capture.release()

    def image(self, frame: int) -> Image:
        """Decode one frame, going on from here, seeking, or beginning anew."""
        if not 0 <= frame < self.video.count:
            raise IndexError(f"{self.video.path} has the frames 0 to {self.video.count - 1}, not {frame}.")
        if not (self._is_far(frame) and self._seek(frame)):
            if frame < self.next:
                self._restart()
            while self.next <= frame:
                self._advance()
        found, image = self.capture.retrieve()
        if not found:
            self._raise_damaged(frame)
        if (image.shape[1], image.shape[0]) != self.video.size:
            wrong = f"changes its size to {image.shape[1]} x {image.shape[0]} at frame {frame}"
            raise FileProblem(self.video.path, wrong, "Write it anew with one size (for example with ffmpeg).")
        return np.asarray(image, np.uint8)

    def _is_far(self, frame: int) -> bool:
        return self.video.times_ms is not None and not self.next <= frame < self.next + _SEEK_BEYOND

    def _restart(self) -> None:
        self.capture.release()
        self.capture, self.next = _open(self.video.path), 0

    def _advance(self) -> None:
        if not self.capture.grab() or not self._shows(self.next):
            self._raise_damaged(self.next)
        self.next += 1

    def _seek(self, frame: int) -> bool:
        """Jump to a frame; OpenCV's jump may miss, and only one that shows the frame's own time counts."""
        if frame < _SEEK_BEYOND:
            return False
        self.capture.set(cv2.CAP_PROP_POS_FRAMES, frame)
        if self.capture.grab() and self._shows(frame):
            self.next = frame + 1
            return True
        self._restart()
        return False

    def _shows(self, frame: int) -> bool:
        """Tell whether the picture just decoded is that frame: a decoder drops damaged ones without a word."""
        times = self.video.times_ms
        return times is None or abs(self.capture.get(cv2.CAP_PROP_POS_MSEC) - times[frame]) < 0.5

    def _raise_damaged(self, frame: int) -> None:
        wrong = f"is damaged: frame {frame} of {self.video.count} cannot be decoded"
        remedy = f"{_COPY_AGAIN}, or keep the frames before with frames = [0, {frame}] in trial.toml."
        raise FileProblem(self.video.path, wrong, remedy)
