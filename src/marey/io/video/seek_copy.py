"""Copies of videos in short pieces with near key pictures, from which any frame is decoded within milliseconds."""

import os
from collections.abc import Generator, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from glob import escape
from pathlib import Path
from types import MappingProxyType

import av
import cv2
import numpy as np

from marey.arrays import Image
from marey.errors import FileProblem, MareyError
from marey.io.stages import file_fingerprint
from marey.io.video.video import Clip, Video, open_video
from marey.io.video.video_writer import VideoWriter

PIECE_FRAMES = 256
"""Number of frames of a piece: what a user looks at is copied within a second or two. Chosen by hand."""
KEY_FRAMES = 8
"""Distance of key pictures in a copy: the last of 8 frames of 1280 x 720 is decoded in 15 ms of one core."""
QUICK_PIXELS = 24e6
"""Videos with at most so many pixels between two key pictures are not copied: every frame of H.264 is decoded within
60 ms, at 2.3 ms per frame of 1280 x 720."""
CODING: Mapping[str, str] = MappingProxyType({"preset": "ultrafast", "crf": "20", "g": str(KEY_FRAMES), "bf": "0"})
"""Options of x264. In the takes `walk` and `balancing`, `ultrafast` takes half of the time of `veryfast` for writing
(8.7 ms per frame of 1280 x 720 on a busy core), two thirds for decoding, and twice the bytes: a third of JPEG."""
_FORM = 1
"""Number of the form of the copies; copies of another form are made again."""
_SUFFIX = ".piece"
"""Ending of the names of pieces, which are MP4 files: as videos they could be taken for those of a trial."""
_MARK = "CACHEDIR.TAG"
"""File that marks the folder as ours; programs for backups leave out folders with such a file."""
_MARK_TEXT = "Signature: 8a477f597d28d172789f06886806bc55\n# Copies of videos for marey view; they can be deleted.\n"
"""Content of the mark: the signature of the Cache Directory Tagging Specification, and the use."""
_RATE = 30.0
"""Frame rate of the pieces [Hz]; they are read by frame numbers only."""


class FrameReader:
    """Reads images of a clip in any order, and keeps its place in the file from one image to the next.

    Args:
        clip: The images.
    """

    def __init__(self, clip: Clip):
        self._clip, self._frame = clip, 0
        self._images: Iterator[Image] | None = None

    def image(self, frame: int) -> Image:
        """Decode one image.

        Args:
            frame: Number of the frame.

        Returns:
            (height, width, 3) uint8, blue, green, red.

        Raises:
            FileProblem: The image is damaged, or the file cannot be opened.
        """
        self._frame = frame
        self._images = self._images or self._clip.images(self._frames())
        try:
            return next(self._images)
        except Exception:
            self._images = None
            raise

    def _frames(self) -> Iterator[int]:
        while True:
            yield self._frame


class SeekCopy:
    """A copy of a clip that is written piece by piece, in any order, and kept for later.

    Args:
        clip: The images.
        folder: Folder for the pieces. Those of an earlier copy of the same file are used.
        width: Largest width of the images [px]; wider ones are reduced by a whole number.
    """

    def __init__(self, clip: Clip, folder: Path, width: int):
        self._clip, self._folder = clip, folder
        self._factor = -(-clip.size[0] // width)
        self._size = (max(1, clip.size[0] // self._factor), max(1, clip.size[1] // self._factor))
        self._source = FrameReader(clip)
        self._videos: dict[int, Video] = {}
        self._open: tuple[int, FrameReader] | None = None
        # What cannot be read or written is not tried again; its frames are decoded from the video itself.
        self._unusable: set[int] = set()
        self._held = {n for n in range(self._count) if self._path(n).is_file()}

    @property
    def _count(self) -> int:
        return -(-self._clip.count // PIECE_FRAMES)

    def _path(self, piece: int) -> Path:
        return self._folder / f"{piece:04d}{_SUFFIX}"

    def _frames(self, piece: int) -> range:
        return range(piece * PIECE_FRAMES, min((piece + 1) * PIECE_FRAMES, self._clip.count))

    @property
    def written(self) -> int:
        """Number of written pieces."""
        return len(self._held)

    def holds(self, frame: int) -> bool:
        """Return whether a frame is in a written piece."""
        return frame // PIECE_FRAMES in self._held

    def image(self, frame: int) -> Image | None:
        """Decode one frame of a written piece.

        Args:
            frame: Number of the frame in the clip.

        Returns:
            (height, width, 3) uint8, blue, green, red, reduced; None if its piece is damaged, which is then removed.
        """
        piece = frame // PIECE_FRAMES
        try:
            if self._open is None or self._open[0] != piece:
                self._open = (piece, FrameReader(self._video(piece)))
            image = self._open[1].image(frame - piece * PIECE_FRAMES)
        except (MareyError, cv2.error):
            self._open = None
            self._held.discard(piece)
            self._unusable.add(piece)
            with suppress(OSError):
                self._path(piece).unlink(missing_ok=True)
            return None
        return np.ascontiguousarray(image[: self._size[1], : self._size[0]])

    def _video(self, piece: int) -> Video:
        """Return the video of a piece, which is read through only once: 50 ms for one of 1280 x 720."""
        if piece not in self._videos:
            video = open_video(self._path(piece))
            if video.count != len(self._frames(piece)) or video.times is None:
                raise FileProblem(video.path, "is no piece of this video")
            self._videos[piece] = replace(video, near_frames=KEY_FRAMES)
        return self._videos[piece]

    def missing(self, near: int) -> int | None:
        """Return the piece that is written next: that of a frame, the ones after it, then the first ones.

        Args:
            near: Number of the frame that the user looks at.

        Returns:
            Number of a piece; None if nothing is missing, or what is missing cannot be written.
        """
        first = min(near // PIECE_FRAMES, self._count - 1)
        order = [*range(first, self._count), *range(first)]
        return next((n for n in order if n not in self._held and n not in self._unusable), None)

    def write(self, piece: int) -> Generator[None]:
        """Write a piece, one image at each step; it is used at the end. If the generator is closed, nothing is left.

        A piece that contains a damaged image is not written, and nothing more is written on a full disk.

        Args:
            piece: Number of the piece.
        """
        try:
            with VideoWriter(self._path(piece), self._size, rate=_RATE, coding=CODING) as video:
                for frame in self._frames(piece):
                    image = self._source.image(frame)
                    if self._factor > 1:
                        image = np.asarray(cv2.resize(image, self._size, interpolation=cv2.INTER_AREA), np.uint8)
                    video.add(image)
                    yield
        except FileProblem as problem:
            of_source = self._clip.path == problem.path
            self._unusable |= {piece} if of_source else set(range(self._count))
            return
        except (OSError, av.FFmpegError, cv2.error):
            self._unusable |= set(range(self._count))
            return
        self._held.add(piece)


def copies_folder(folder: Path) -> bool:
    """Create the folder of all copies of a result, marked as deletable.

    Args:
        folder: The folder.

    Returns:
        Whether it can be used: it can be written to, and is new or ours.
    """
    mark = folder / _MARK
    try:
        folder.mkdir(exist_ok=True)
        if not mark.exists() and not any(folder.iterdir()):
            mark.write_text(_MARK_TEXT, encoding="utf-8")
        return mark.read_text(encoding="utf-8", errors="replace") == _MARK_TEXT and os.access(folder, os.W_OK)
    except OSError:
        return False


def seek_copy(clip: Clip, folder: Path, camera: str, width: int) -> SeekCopy | None:
    """Return the copy of a camera's video; copies of other versions of the video are removed.

    Args:
        clip: The images.
        folder: Folder of all copies, see `copies_folder`.
        camera: Name of the camera.
        width: Largest width of the images [px].

    Returns:
        The copy; None where the clip needs none, because its images are stills, or its key pictures are near.

    Raises:
        FileProblem: The video cannot be read.
    """
    if not isinstance(clip, Video) or clip.key_frames * clip.size[0] * clip.size[1] <= QUICK_PIXELS:
        return None
    name = f"{camera}-{file_fingerprint(clip.path)}-{width}-{_FORM}"
    for other in folder.glob(f"{escape(camera)}-{'[0-9a-f]' * 32}-*"):
        if other.name != name:
            for piece in other.glob("[0-9][0-9][0-9][0-9]" + _SUFFIX):
                piece.unlink(missing_ok=True)
            with suppress(OSError):
                other.rmdir()
    return SeekCopy(clip, folder / name, width)
