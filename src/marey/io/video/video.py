"""One camera's pictures, from a video or from stills, decoded as they are needed and by exact frame numbers."""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import NoReturn, final

import av
import cv2
import numpy as np
from av.container import InputContainer
from av.video.frame import VideoFrame
from av.video.reformatter import VideoReformatter
from av.video.stream import VideoStream

from marey.arrays import Image, Integers, frozen
from marey.errors import FileProblem

PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
VIDEO_SUFFIXES = (
    *(".mp4", ".avi", ".mov", ".mkv", ".m4v", ".webm", ".mpg", ".mpeg", ".mts", ".m2ts"),
    *(".wmv", ".flv", ".mjpeg", ".mjpg", ".ts", ".3gp", ".ogv", ".mxf", ".dv"),
)

_SEEK_BEYOND = 60
"""Frames that are sooner decoded and thrown away than sought."""
_TRIED = 16
"""Frames whose times are compared when a video is opened: enough for every reordering that codecs do."""
_HEADER_SLACK = 3
"""Frames by which an intact file's header may be wrong; MPEG-4 in AVI counts empty packets."""
_HEADER_SHARE = 0.01
"""The same as a share of a long file's frames or seconds."""
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
    times: Integers | None
    """When each frame is shown, in the container's ticks; None where its times do not tell frames apart."""

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
        FileProblem: It cannot be opened, or is not whole.
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
        The clip; its pictures are as a player shows them, turned where the container says so.

    Raises:
        FileProblem: It cannot be opened, or is not whole.
    """
    times = _packet_times(path)
    with _Source(path) as source:
        shown = list(islice(source.frames, _TRIED))
        if not shown:
            raise FileProblem(path, "opens, but not one picture in it can be decoded", f"{_COPY_AGAIN}.")
        sound = _tells_frames_apart(source.stream) and _agree(times, shown)
        count = len(times) if sound else len(shown) + sum(1 for _ in source.frames)
        _require_all(path, source, times, max(count, len(times)))
        height, width = source.picture(shown[0]).shape[:2]
        rate = source.rate
    return Video(
        path=path,
        size=(width, height),
        count=count,
        rate=rate,
        times=frozen(times, np.int64) if sound else None,
    )


def _packet_times(path: Path) -> list[int]:
    """List the times of all packets in the order in which they are shown, without decoding."""
    with _Source(path) as source:
        packets = source.container.demux(source.stream)
        try:
            times = [packet.pts for packet in packets if packet.size > 0]
        except av.FFmpegError as error:
            raise FileProblem(path, f"is damaged ({error.strerror})", f"{_COPY_AGAIN}.") from error
    return sorted(time for time in times if time is not None)


def _tells_frames_apart(stream: VideoStream) -> bool:
    """AVI has no times of its own: where pictures are stored out of order, those that are given are guesses."""
    return stream.container.format.name != "avi" or stream.codec_context.codec.intra_only


def _agree(times: list[int], shown: list[VideoFrame]) -> bool:
    return len(set(times)) == len(times) >= len(shown) and [frame.pts for frame in shown] == times[: len(shown)]


def _require_all(path: Path, source: "_Source", times: list[int], readable: int) -> None:
    """Compare what can be read with what the header promises, in frames or, where it counts none, in seconds."""
    promised, duration, rate = source.stream.frames, source.container.duration, source.rate
    remedy = f"{_COPY_AGAIN}; if that is all there is, write it anew (for example with ffmpeg)."
    if promised > 0:
        if promised - readable > max(_HEADER_SLACK, _HEADER_SHARE * promised):
            wrong = f"is not whole: its header promises {promised} frames, {readable} can be read"
            raise FileProblem(path, wrong, remedy)
    elif duration and times and rate and source.stream.time_base:
        seconds = duration / av.time_base
        # Some containers count the duration from zero, others from the first picture.
        last = float(max(times[-1], times[-1] - times[0]) * source.stream.time_base)
        if seconds - last > max((_HEADER_SLACK + 1) / rate, _HEADER_SHARE * seconds):
            wrong = f"is not whole: its header promises {seconds:.2f} s, the last picture is of {last:.2f} s"
            raise FileProblem(path, wrong, remedy)


class _Source:
    """An open video file with its pictures in order."""

    def __init__(self, path: Path):
        self.path = path
        self._reformatter = VideoReformatter()
        if not path.is_file():
            raise FileProblem(path, "does not exist", "Check its name.")
        try:
            self.container: InputContainer = av.open(str(path))
        except (av.FFmpegError, ValueError) as error:
            wrong = "cannot be opened as a video: it is empty, damaged, or of an unknown kind"
            raise FileProblem(path, wrong, f"{_COPY_AGAIN}, or convert it to MP4 (H.264).") from error
        if not self.container.streams.video:
            self.close()
            raise FileProblem(path, "holds no pictures", f"{_COPY_AGAIN}.")
        self.stream = self.container.streams.video[0]
        # The cameras are decoded beside each other, so each gets one thread.
        self.stream.thread_type = "NONE"
        self.stream.thread_count = 1
        self.frames = self._decoded()

    @property
    def rate(self) -> float | None:
        """Pictures a second, None where the container does not say."""
        rate = self.stream.average_rate
        return float(rate) if rate else None

    def _decoded(self) -> Iterator[VideoFrame]:
        """Decode in order; a generator must not end the file's reading with an error of FFmpeg's."""
        try:
            yield from self.container.decode(self.stream)
        except av.FFmpegError as error:
            raise FileProblem(self.path, f"is damaged ({error.strerror})", f"{_COPY_AGAIN}.") from error

    def seek(self, time: int) -> None:
        """Go to the last key picture up to a time."""
        self.container.seek(time, stream=self.stream, backward=True)
        self.frames = self._decoded()

    def picture(self, frame: VideoFrame) -> Image:
        """Turn a decoded frame into blue, green, red, upright as a player shows it."""
        image = np.asarray(self._reformatter.reformat(frame, format="bgr24").to_ndarray(), np.uint8)
        quarters = round(frame.rotation / 90) % 4
        return np.ascontiguousarray(np.rot90(image, quarters)) if quarters else image

    def close(self) -> None:
        self.container.close()

    def __enter__(self) -> "_Source":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class _Decoder:
    """A place in a video that is being read."""

    def __init__(self, video: Video):
        self.video = video
        self.source = _Source(video.path)
        self.next = 0
        self.current: VideoFrame | None = None

    def close(self) -> None:
        self.source.close()

    def image(self, frame: int) -> Image:
        """Decode one frame, going on from here, seeking, or beginning anew."""
        if not 0 <= frame < self.video.count:
            raise IndexError(f"{self.video.path} has the frames 0 to {self.video.count - 1}, not {frame}.")
        if frame == self.next - 1 and self.current is not None:
            return self._checked(self.source.picture(self.current), frame)
        if not (self._is_far(frame) and self._seek(frame)):
            if frame < self.next:
                self._restart()
            while self.next <= frame:
                self._advance()
        if self.current is None or self.current.is_corrupt:
            self._raise_damaged(frame)
        return self._checked(self.source.picture(self.current), frame)

    def _checked(self, image: Image, frame: int) -> Image:
        if (image.shape[1], image.shape[0]) != self.video.size:
            wrong = f"changes its size to {image.shape[1]} x {image.shape[0]} at frame {frame}"
            raise FileProblem(self.video.path, wrong, "Write it anew with one size (for example with ffmpeg).")
        return image

    def _is_far(self, frame: int) -> bool:
        return self.video.times is not None and not self.next <= frame < self.next + _SEEK_BEYOND

    def _restart(self) -> None:
        self.source.close()
        self.source, self.next, self.current = _Source(self.video.path), 0, None

    def _advance(self) -> None:
        try:
            self.current = next(self.source.frames, None)
        except FileProblem:
            self._raise_damaged(self.next)
        times = self.video.times
        # A decoder drops damaged pictures without a word: each must be of its own time.
        if self.current is None or (times is not None and self.current.pts != times[self.next]):
            self._raise_damaged(self.next)
        self.next += 1

    def _seek(self, frame: int) -> bool:
        """Jump to a frame; only a jump that arrives at the frame's own time counts."""
        assert self.video.times is not None
        if frame < _SEEK_BEYOND:
            return False
        time = int(self.video.times[frame])
        self.source.seek(time)
        for decoded in self.source.frames:
            if decoded.pts is None or decoded.pts >= time:
                if decoded.pts == time:
                    self.current, self.next = decoded, frame + 1
                    return True
                break
        self._restart()
        return False

    def _raise_damaged(self, frame: int) -> NoReturn:
        wrong = f"is damaged: frame {frame} of {self.video.count} cannot be decoded whole"
        remedy = f"{_COPY_AGAIN}, or keep the frames before with frames = [0, {frame}] in trial.toml."
        raise FileProblem(self.video.path, wrong, remedy)
