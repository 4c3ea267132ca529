"""Reading of one camera's images from a video or stills, decoded on demand by exact frame number."""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
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

from marey.arrays import Floats, Image, Integers, frozen
from marey.errors import FileProblem
from marey.io.video.picture_sizes import require_possible_picture

PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
"""File name extensions of images, in lower case."""
VIDEO_SUFFIXES = (
    *(".mp4", ".avi", ".mov", ".mkv", ".m4v", ".webm", ".mpg", ".mpeg", ".mts", ".m2ts"),
    *(".wmv", ".flv", ".mjpeg", ".mjpg", ".ts", ".3gp", ".ogv", ".mxf", ".dv"),
)
"""File name extensions of videos, in lower case."""

_SEEK_BEYOND = 60
"""Up to this number of frames ahead is decoded in sequence; farther frames are reached by seeking.

A seek took as long as decoding 30 to 60 frames when the reader was written; the script was not kept.
"""
VARIABLE_FRAMES = 0.25
"""Difference of the times of the frames from those of a constant rate, in frames, above which the rate varies: times
that are rounded to milliseconds are nearer. Chosen by hand."""
_COMPARED_FRAMES = 16
"""Number of frames whose times are compared when a video is opened; H.264 reorders at most 16 frames."""
_HEADER_FRAMES = 3
"""Largest error of the number of frames in the header of an intact file; MPEG-4 in AVI counts empty packets.

Chosen by hand."""
_HEADER_FRACTION = 0.01
"""The same as a fraction of the frames or seconds of a long file. Chosen by hand."""
_COPY_AGAIN = "Copy the file again from the camera"
"""Beginning of the remedy in the error messages on damaged files."""


class Clip(ABC):
    """The images of one camera, numbered from 0."""

    path: Path
    """The file; for stills the first one."""
    size: tuple[int, int]
    """Width and height [px]."""
    count: int
    """Number of images that can be read."""
    rate: float | None
    """Frame rate of the container [Hz]; None for stills, and where the container has none."""
    seconds: Floats | None = None
    """(F,) time of each image after the first one [s], if the frame rate varies; None if it is constant or unknown."""

    @property
    @abstractmethod
    def paths(self) -> tuple[Path, ...]:
        """All its files."""

    @abstractmethod
    def images(self, frames: Iterable[int]) -> Iterator[Image]:
        """Decode images one by one; only one is held in memory.

        Args:
            frames: Frame numbers, fastest in ascending order; a number may be repeated.

        Yields:
            (height, width, 3) uint8, blue, green, red.

        Raises:
            FileProblem: An image is damaged; the message names the frame.
        """

    def image(self, frame: int) -> Image:
        """Decode one image.

        Args:
            frame: Number of the frame.

        Returns:
            (height, width, 3) uint8, blue, green, red.

        Raises:
            FileProblem: The image is damaged.
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
    """(F,) presentation time of each frame in ticks of the container; None where the times are not unique."""
    seconds: Floats | None = None
    quarters: int = 0
    """Number of quarter turns, counterclockwise, by which the container states that its images are to be rotated."""
    upright: bool = True
    """Whether the images are rotated as the container states."""
    near_frames: int = _SEEK_BEYOND
    """Up to this number of frames ahead is decoded in sequence; farther frames, and earlier ones, are sought."""
    key_frames: int = 1
    """Largest distance of two key pictures, from which alone a decoder can begin, by the flags in the container."""

    def as_stored(self) -> "Video":
        """Return the video without the rotation that its container states."""
        size = self.size[::-1] if self.upright and self.quarters % 2 else self.size
        return replace(self, size=size, upright=False)

    @property
    def paths(self) -> tuple[Path, ...]:
        """The one file."""
        return (self.path,)

    def images(self, frames: Iterable[int]) -> Iterator[Image]:
        """Decode images one by one; see `Clip.images`."""
        decoder = _Decoder(self)
        try:
            for frame in frames:
                yield decoder.image(frame)
        finally:
            decoder.close()


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class Stills(Clip):
    """Single images, one per frame."""

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
        """The first image."""
        return self.files[0]

    @property
    def count(self) -> int:  # type: ignore[override]
        """Number of images."""
        return len(self.files)

    def images(self, frames: Iterable[int]) -> Iterator[Image]:
        """Read images one by one; see `Clip.images`."""
        for frame in frames:
            image = read_picture(self.files[frame])
            if (image.shape[1], image.shape[0]) != self.size:
                sizes = f"{image.shape[1]} x {image.shape[0]}, but {self.path.name} {self.size[0]} x {self.size[1]}"
                remedy = "All stills of a camera should have the same size."
                raise FileProblem(self.files[frame], f"has the size {sizes}", remedy)
            yield image


def open_clip(path: Path) -> Clip:
    """Open a video, or an image as a clip of one frame.

    Args:
        path: The file.

    Returns:
        The clip; of a valid container only the first images are decoded.

    Raises:
        FileProblem: The file cannot be opened, or is incomplete.
    """
    if path.suffix.lower() in PICTURE_SUFFIXES:
        return open_stills((path,))
    return open_video(path)


def open_stills(paths: tuple[Path, ...]) -> Stills:
    """Open single images as a clip.

    Args:
        paths: The files in the order of the frames.

    Returns:
        The clip.

    Raises:
        FileProblem: The first file cannot be read; the others are read on demand.
    """
    image = read_picture(paths[0])
    return Stills(files=paths, size=(image.shape[1], image.shape[0]))


def read_picture(path: Path) -> Image:
    """Read one image.

    Args:
        path: The file.

    Returns:
        (height, width, 3) uint8, blue, green, red.

    Raises:
        FileProblem: The file is not an image, or damaged.
    """
    try:
        content = path.read_bytes()
        require_possible_picture(path, content)
        image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR) if content else None
    except (OSError, cv2.error) as error:
        raise FileProblem(path, f"cannot be read ({error})", f"{_COPY_AGAIN}.") from error
    if image is None:
        raise FileProblem(path, "is not a readable image, or damaged", f"{_COPY_AGAIN}, or save it as PNG.")
    return np.asarray(image, np.uint8)


def open_video(path: Path) -> Video:
    """Open a video and count the images that can be read from it.

    The packets are counted without decoding. Where their times differ from those of the decoder (empty packets of
    MPEG-4 in AVI), the images are counted by decoding the video once.

    Args:
        path: The file.

    Returns:
        The clip; its images are rotated as specified in the container.

    Raises:
        FileProblem: The file cannot be opened, or is incomplete.
    """
    times, key_frames = _packet_times(path)
    with _Source(path) as source:
        shown = list(islice(source.frames, _COMPARED_FRAMES))
        if not shown:
            raise FileProblem(path, "can be opened, but none of its images can be decoded", f"{_COPY_AGAIN}.")
        sound = _has_valid_times(source.stream) and _agree(times, shown)
        count = len(times) if sound else len(shown) + sum(1 for _ in source.frames)
        _require_all(path, source, times, max(count, len(times)))
        height, width = source.picture(shown[0]).shape[:2]
        rate, quarters, tick = source.rate, _quarters(shown[0]), source.stream.time_base
    ticks = frozen(times, np.int64) if sound else None
    return Video(
        path=path,
        size=(width, height),
        count=count,
        rate=rate,
        times=ticks,
        quarters=quarters,
        key_frames=key_frames,
        seconds=None if ticks is None or tick is None else _variable_times(ticks, float(tick)),
    )


def _quarters(frame: VideoFrame) -> int:
    """Return the number of quarter turns, counterclockwise, that the container states for an image."""
    return round(frame.rotation / 90) % 4


def _variable_times(ticks: Integers, seconds_per_tick: float) -> Floats | None:
    """Return the times of a video whose frame rate varies.

    Args:
        ticks: (F,) ascending presentation times of the pictures.
        seconds_per_tick: Unit of the times [s].

    Returns:
        (F,) times after the first picture [s]; None if they are those of a constant rate within `VARIABLE_FRAMES`.
    """
    if len(ticks) < 3:
        return None
    seconds = (np.asarray(ticks) - ticks[0]) * seconds_per_tick
    period = seconds[-1] / (len(seconds) - 1)
    uniform = np.abs(seconds - np.arange(len(seconds)) * period).max() <= VARIABLE_FRAMES * period
    return None if uniform else seconds


def _packet_times(path: Path) -> tuple[list[int], int]:
    """Return the sorted presentation times of all packets, and the largest distance of key ones, without decoding."""
    with _Source(path) as source:
        packets = source.container.demux(source.stream)
        try:
            read = [(packet.pts, packet.is_keyframe) for packet in packets if packet.size > 0]
        except av.FFmpegError as error:
            raise FileProblem(path, f"is damaged ({error.strerror})", f"{_COPY_AGAIN}.") from error
    keys = [0, *(n for n, (_, is_key) in enumerate(read) if is_key), len(read)]
    return sorted(time for time, _ in read if time is not None), int(np.diff(keys).max())


def _has_valid_times(stream: VideoStream) -> bool:
    """Return whether the times of packets are valid: AVI has none, so they are guessed if frames are reordered."""
    return stream.container.format.name != "avi" or stream.codec_context.codec.intra_only


def _agree(times: list[int], shown: list[VideoFrame]) -> bool:
    return len(set(times)) == len(times) >= len(shown) and [frame.pts for frame in shown] == times[: len(shown)]


def _require_all(path: Path, source: "_Source", times: list[int], readable: int) -> None:
    """Compare the readable frames with the header, by their number or, where it has none, by the duration."""
    promised, duration, rate = source.stream.frames, source.container.duration, source.rate
    remedy = f"{_COPY_AGAIN}; if the original is incomplete too, re-encode it (for example with ffmpeg)."
    if promised > 0:
        if promised - readable > max(_HEADER_FRAMES, _HEADER_FRACTION * promised):
            wrong = f"is incomplete: its header states {promised} frames, but {readable} can be read"
            raise FileProblem(path, wrong, remedy)
    elif duration and times and rate and source.stream.time_base:
        seconds = duration / av.time_base
        # Some containers measure the duration from zero, others from the first image.
        last = float(max(times[-1], times[-1] - times[0]) * source.stream.time_base)
        if seconds - last > max((_HEADER_FRAMES + 1) / rate, _HEADER_FRACTION * seconds):
            wrong = f"is incomplete: its header states {seconds:.2f} s, but the last image is at {last:.2f} s"
            raise FileProblem(path, wrong, remedy)


class _Source:
    """An open video file, decoded in order."""

    def __init__(self, path: Path, *, upright: bool = True):
        self.path, self._upright = path, upright
        self._reformatter = VideoReformatter()
        if not path.is_file():
            raise FileProblem(path, "does not exist", "Check its name.")
        try:
            self.container: InputContainer = av.open(str(path))
        except (av.FFmpegError, ValueError) as error:
            wrong = "cannot be opened as a video: it is empty, damaged, or of an unknown format"
            raise FileProblem(path, wrong, f"{_COPY_AGAIN}, or convert it to MP4 (H.264).") from error
        if not self.container.streams.video:
            self.close()
            raise FileProblem(path, "has no video stream", f"{_COPY_AGAIN}.")
        self.stream = self.container.streams.video[0]
        # The cameras are decoded in parallel, so each has one thread.
        self.stream.thread_type = "NONE"
        self.stream.thread_count = 1
        self.frames = self._decoded()

    @property
    def rate(self) -> float | None:
        """Frame rate [Hz]; None where the container has none."""
        rate = self.stream.average_rate
        return float(rate) if rate else None

    def _decoded(self, start: int | None = None) -> Iterator[VideoFrame]:
        """Decode in order, and convert errors of FFmpeg; before a time, only what later images may refer to."""
        try:
            for packet in self.container.demux(self.stream):
                if start is not None:
                    is_before = packet.pts is not None and packet.pts < start
                    self.stream.codec_context.skip_frame = "NONREF" if is_before else "DEFAULT"
                yield from packet.decode()
        except av.FFmpegError as error:
            raise FileProblem(self.path, f"is damaged ({error.strerror})", f"{_COPY_AGAIN}.") from error

    def seek(self, time: int) -> None:
        """Seek the last key frame up to a time, before which images may be left out."""
        self.container.seek(time, stream=self.stream, backward=True)
        self.frames = self._decoded(time)

    def picture(self, frame: VideoFrame) -> Image:
        """Convert a decoded frame to blue, green, red, by default rotated as specified in the container."""
        image = np.asarray(self._reformatter.reformat(frame, format="bgr24").to_ndarray(), np.uint8)
        quarters = _quarters(frame) if self._upright else 0
        return np.ascontiguousarray(np.rot90(image, quarters)) if quarters else image

    def close(self) -> None:
        self.container.close()

    def __enter__(self) -> "_Source":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class _Decoder:
    """A reading position in a video."""

    def __init__(self, video: Video):
        self.video = video
        self.source = _Source(video.path, upright=video.upright)
        self.next = 0
        self.current: VideoFrame | None = None

    def close(self) -> None:
        self.source.close()

    def image(self, frame: int) -> Image:
        """Decode one frame by decoding forward, seeking, or reopening the file."""
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
            raise FileProblem(self.video.path, wrong, "Re-encode it with one size (for example with ffmpeg).")
        return image

    def _is_far(self, frame: int) -> bool:
        return self.video.times is not None and not self.next <= frame < self.next + self.video.near_frames

    def _restart(self) -> None:
        self.source.close()
        self.source = _Source(self.video.path, upright=self.video.upright)
        self.next, self.current = 0, None

    def _advance(self) -> None:
        try:
            self.current = next(self.source.frames, None)
        except FileProblem:
            self._raise_damaged(self.next)
        times = self.video.times
        # A decoder silently drops damaged images, so the time of each is compared.
        if self.current is None or (times is not None and self.current.pts != times[self.next]):
            self._raise_damaged(self.next)
        self.next += 1

    def _seek(self, frame: int) -> bool:
        """Seek a frame; return whether a frame of exactly its time was reached."""
        assert self.video.times is not None
        if frame < self.video.near_frames:
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
        wrong = f"is damaged: frame {frame} of {self.video.count} cannot be decoded completely"
        remedy = f"{_COPY_AGAIN}, or select the frames before it with frames = [0, {frame}] in trial.toml."
        raise FileProblem(self.video.path, wrong, remedy)
