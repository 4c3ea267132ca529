"""Pictures of the videos for the page of `marey view`: decoded by frame number in the background, and kept as JPEG."""

import threading
from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from marey.arrays import Image
from marey.errors import MareyError
from marey.io.video.video import Clip

LARGE_WIDTH, SMALL_WIDTH = 1280, 320
"""Largest width of the picture of the camera that is looked at, and of those beside it [px]. Chosen by hand: about 30
and 3 kB."""
_LARGE_QUALITY, _SMALL_QUALITY = 85, 75
"""JPEG qualities of these pictures. Chosen by hand."""
MEMORY_BYTES = 384_000_000
"""Memory for the pictures of all cameras [bytes]: about 11,000 of 1280 px. Chosen by hand."""
_AHEAD = 90
"""Number of frames after the requested one that are decoded in advance when the memory is full. Chosen by hand."""
_REDUCED = 0.98
"""Part of the memory that is still used after frames were dropped. Chosen by hand: about 50 frames at a time."""
_LONGEST_WAIT_S = 30.0
"""Longest time for which a request waits for its picture [s]. Chosen by hand."""


@dataclass(frozen=True, kw_only=True)
class CodedPicture:
    """One picture in two sizes, as JPEG; empty if it cannot be decoded."""

    large: bytes = b""
    small: bytes = b""

    def __len__(self) -> int:
        return len(self.large) + len(self.small)


class DecodingTurn:
    """Which cameras of a take decode: those with requests, or without any request all of them.

    Several threads that decode in advance would delay each image of a requested one by their turns of the interpreter,
    and a request may need the 250 images after a key picture.
    """

    def __init__(self) -> None:
        self.changed = threading.Condition(threading.RLock())
        self.requests = 0


class CameraPictures:
    """The pictures of one camera.

    A thread decodes the video from its beginning to its end; a request for another frame is served first. What was
    decoded is kept while there is memory, then the frames farthest from the last request are dropped.

    Args:
        clip: The video.
        memory: Memory for its pictures [bytes].
        turn: Shared by all cameras of the take.
    """

    def __init__(self, clip: Clip, memory: int = MEMORY_BYTES, turn: DecodingTurn | None = None):
        self._clip, self._memory, self._turn = clip, memory, turn or DecodingTurn()
        self._kept: dict[int, CodedPicture] = {}
        self._bytes = 0
        self._wanted: deque[int] = deque()
        self._awaited: Counter[int] = Counter()
        self._next, self._last = 0, 0
        self._closed = False
        self._changed = self._turn.changed
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def want(self, frame: int) -> None:
        """Decode a frame next, if it is not yet in memory.

        Args:
            frame: Number of the frame in the clip; one beyond its ends is ignored.
        """
        with self._changed:
            if 0 <= frame < self._clip.count:
                self._last = frame
                if frame not in self._kept and frame not in self._wanted:
                    self._wanted.append(frame)
                    self._turn.requests += 1
                    self._changed.notify_all()

    def picture(self, frame: int) -> CodedPicture:
        """Return the picture of a frame, and wait until it is decoded.

        Args:
            frame: Number of the frame in the clip.

        Returns:
            The picture; an empty one beyond the ends of the clip, and where the video is damaged.
        """
        if not 0 <= frame < self._clip.count:
            return CodedPicture()
        with self._changed:
            self.want(frame)
            self._awaited[frame] += 1
            self._changed.wait_for(lambda: self._closed or frame in self._kept, _LONGEST_WAIT_S)
            self._awaited[frame] -= 1
            return self._kept.get(frame, CodedPicture())

    @property
    def kept(self) -> int:
        """Number of pictures in memory."""
        return len(self._kept)

    def close(self) -> None:
        """End the thread."""
        with self._changed:
            self._closed = True
            self._turn.requests -= len(self._wanted)
            self._wanted.clear()
            self._changed.notify_all()
        self._thread.join()

    def _work(self) -> None:
        while not self._closed:
            # An error ends the reading of the clip, which is then opened again at the next frame.
            numbers = self._numbers()
            self._at: int | None = None
            try:
                for image in self._clip.images(numbers):
                    self._keep(self._at, _coded(image))
            except (MareyError, cv2.error):
                self._keep(next(numbers, None) if self._at is None else self._at, CodedPicture())

    def _numbers(self) -> Iterator[int]:
        while True:
            with self._changed:
                while not self._closed and (frame := self._choice()) is None:
                    self._changed.wait()
                if self._closed or frame is None:
                    return
                self._at = frame
            yield frame

    def _choice(self) -> int | None:
        """Return the frame to decode: a requested one, or the next one that is missing; None if there is none."""
        if self._wanted:
            # The newest request is that of the frame that the user looks at now.
            self._next = self._wanted[-1] + 1
            return self._wanted[-1]
        if self._turn.requests:
            return None
        full, count = self._bytes >= self._memory, self._clip.count
        start, end = (self._last, min(self._last + _AHEAD, count)) if full else (self._next, count)
        found = next((frame for frame in range(start, end) if frame not in self._kept), None)
        if found is None and not full:
            found = next((frame for frame in range(start) if frame not in self._kept), None)
        if found is not None and not full:
            self._next = found + 1
        return found

    def _keep(self, frame: int | None, picture: CodedPicture) -> None:
        if frame is None:
            return
        with self._changed:
            if frame in self._wanted:
                self._wanted.remove(frame)
                self._turn.requests -= 1
            self._kept[frame] = picture
            self._bytes += len(picture)
            if self._bytes > self._memory:
                self._make_room()
            self._changed.notify_all()

    def _make_room(self) -> None:
        """Drop the frames that are needed last, some at once, because finding them takes time for each frame."""
        # What a request waits for stays until it was returned.
        free = sorted((frame for frame in self._kept if not self._awaited[frame]), key=self._distance)
        while free and self._bytes > _REDUCED * self._memory and len(self._kept) > 1:
            self._bytes -= len(self._kept.pop(free.pop()))

    def _distance(self, frame: int) -> int:
        """Return how soon a frame is needed; those before the last request are needed later."""
        away = frame - self._last
        return away if away >= 0 else -3 * away


def _coded(image: Image) -> CodedPicture:
    return CodedPicture(
        large=jpeg_of_width(image, LARGE_WIDTH, _LARGE_QUALITY), small=jpeg_of_width(image, SMALL_WIDTH, _SMALL_QUALITY)
    )


def jpeg_of_width(image: Image, width: int, quality: int) -> bytes:
    """Return an image as JPEG, reduced by the smallest whole number that makes it narrow enough.

    Whole numbers are four times as fast as other factors: 1.1 and 4.9 ms for an image of 1280 x 720.

    Args:
        image: (height, width, 3) blue, green, red.
        width: Largest width [px].
        quality: JPEG quality, 0 to 100.
    """
    factor = -(-image.shape[1] // width)
    if factor > 1:
        size = (max(1, image.shape[1] // factor), max(1, image.shape[0] // factor))
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
