"""Pictures of the videos for the page of `marey view`: decoded by frame number and kept as JPEG.

In the background, videos with distant key pictures are copied into pieces in which every frame is reached quickly.
"""

import os
import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from marey.arrays import Image
from marey.errors import MareyError
from marey.io.video.seek_copy import FrameReader, SeekCopy
from marey.io.video.video import Clip

LARGE_WIDTH, SMALL_WIDTH = 1280, 320
"""Largest width of the picture of the camera that is looked at, and of those beside it [px]. Chosen by hand: about 30
and 3 kB."""
_LARGE_QUALITY, _SMALL_QUALITY = 85, 75
"""JPEG qualities of these pictures. Chosen by hand."""
MEMORY_BYTES = 384_000_000
"""Memory for the pictures of all cameras [bytes]: about 11,000 of 1280 px. Chosen by hand."""
_QUIET_S = 2.0
"""Time after the last request from which on copies are written, so that a page that is opened or played has the
processor for itself [s]. Chosen by hand."""
_DECODING, _BACKGROUND = 5, 10
"""Priorities of the threads that decode requests and of the one that writes copies, from 0 (as the others) to 19: a
browser on the same processor draws first. Chosen by hand."""
_REDUCED = 0.98
"""Part of the memory that is still used after frames were dropped. Chosen by hand: about 50 frames at a time."""
_ENDED = object()
"""Stands for the end of a generator."""
_LONGEST_WAIT_S = 30.0
"""Longest time for which a request waits for its picture [s]. Chosen by hand."""


@dataclass(frozen=True, kw_only=True)
class CodedPicture:
    """One picture in two sizes, as JPEG; empty if it cannot be decoded."""

    large: bytes = b""
    small: bytes = b""

    def __len__(self) -> int:
        return len(self.large) + len(self.small)


class Requests:
    """What the cameras of a take have still to decode, and when the last request came."""

    def __init__(self) -> None:
        self.changed = threading.Condition(threading.RLock())
        self.open = 0
        self._last: float | None = None

    def came(self) -> None:
        """Note a request."""
        self._last = time.monotonic()
        self.changed.notify_all()

    def quiet_in(self) -> float | None:
        """Return the time until copies may be written [s]: 0 if now; None while there are requests, or before any."""
        return None if self.open or self._last is None else max(0.0, self._last + _QUIET_S - time.monotonic())


class CameraPictures:
    """The pictures of one camera.

    A thread serves requests, the newest one first. What was decoded is kept while there is memory, then the frames
    farthest from the last request are dropped.

    Args:
        clip: The video.
        memory: Memory for its pictures [bytes].
        requests: Those of all cameras of the take.
        copy: A copy of the video in which every frame is reached quickly; None where the clip needs none.
    """

    def __init__(
        self, clip: Clip, memory: int = MEMORY_BYTES, requests: Requests | None = None, copy: SeekCopy | None = None
    ):  # fmt: skip
        self._clip, self._memory, self._requests, self.copy = clip, memory, requests or Requests(), copy
        self._source = FrameReader(clip)
        self._kept: dict[int, CodedPicture] = {}
        self._bytes = 0
        self._wanted: deque[int] = deque()
        self._awaited: Counter[int] = Counter()
        self.last = 0
        self._closed = False
        self._changed = self._requests.changed
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def want(self, frame: int) -> None:
        """Decode a frame next, if it is not yet in memory.

        Args:
            frame: Number of the frame in the clip; one beyond its ends is ignored.
        """
        with self._changed:
            if 0 <= frame < self._clip.count:
                self.last = frame
                if frame not in self._kept and frame not in self._wanted:
                    self._wanted.append(frame)
                    self._requests.open += 1
                self._requests.came()

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
            self._requests.open -= len(self._wanted)
            self._wanted.clear()
            self._changed.notify_all()
        self._thread.join()

    def _work(self) -> None:
        lower_priority(_DECODING)
        while (frame := self._next()) is not None:
            self._keep(frame, self._decoded(frame))

    def _next(self) -> int | None:
        """Wait for a request and return its frame, the newest one first; None at the end."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._wanted)
            return None if self._closed else self._wanted[-1]

    def _decoded(self, frame: int) -> CodedPicture:
        image = self.copy.image(frame) if self.copy is not None and self.copy.holds(frame) else None
        try:
            return _coded(self._source.image(frame) if image is None else image)
        except (MareyError, cv2.error):
            return CodedPicture()

    def _keep(self, frame: int, picture: CodedPicture) -> None:
        with self._changed:
            if frame in self._wanted:
                self._wanted.remove(frame)
                self._requests.open -= 1
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
        away = frame - self.last
        return away if away >= 0 else -3 * away


class CopyWriter:
    """Writes the copies of a take in the background, while there are no requests.

    One thread of low priority leaves the processor to the browser and to the requests.

    Args:
        cameras: All cameras of the take.
        requests: Those of all cameras.
    """

    def __init__(self, cameras: Sequence[CameraPictures], requests: Requests):
        self._cameras, self._requests = cameras, requests
        self._closed = False
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread; a piece that is not complete is removed."""
        with self._requests.changed:
            self._closed = True
            self._requests.changed.notify_all()
        self._thread.join()

    def _work(self) -> None:
        lower_priority(_BACKGROUND)
        while not self._closed and (piece := self._next_piece()) is not None:
            camera, number = piece
            assert camera.copy is not None
            writing = camera.copy.write(number)
            while self._is_time() and next(writing, _ENDED) is not _ENDED:
                pass
            writing.close()

    def _is_time(self) -> bool:
        """Wait until there are no requests; return whether the thread shall go on."""
        with self._requests.changed:
            while not self._closed and (wait_s := self._requests.quiet_in()) != 0.0:
                self._requests.changed.wait(wait_s)
            return not self._closed

    def _next_piece(self) -> tuple[CameraPictures, int] | None:
        """Return the piece with the frame of the last request of a camera, then the others; None if all are written."""
        self._is_time()
        missing = [
            (camera, piece)
            for camera in self._cameras
            if camera.copy is not None and (piece := camera.copy.missing(camera.last)) is not None
        ]
        return min(missing, key=lambda each: each[0].copy.written if each[0].copy else 0, default=None)


def lower_priority(priority: int) -> None:
    """Set the priority of this thread and of those that it starts.

    Only Linux gives each thread a priority of its own; elsewhere nothing changes.

    Args:
        priority: From 0 (as the others) to 19, the lowest.
    """
    if sys.platform == "linux":
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), priority)


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
