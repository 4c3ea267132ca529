"""Writing of H.264 videos in MP4 for browsers and players, without partial files."""

import struct
from collections.abc import Mapping
from contextlib import ExitStack
from fractions import Fraction
from pathlib import Path
from types import MappingProxyType, TracebackType

import av
import numpy as np

from marey.arrays import Image
from marey.io.atomic import replacing, require_complete

WATCHED: Mapping[str, str] = MappingProxyType({"preset": "veryfast", "crf": "23"})
"""Options of x264 for a video to be watched. Chosen by hand."""


class VideoWriter:
    """Writes images to a video one by one; used as a context manager.

    The file is created when the context ends; after an error, no file is left.

    Args:
        path: The MP4 file.
        size: Width and height of the images [px]; odd sizes are padded by one column or row, as
            H.264 requires.
        rate: Frame rate [Hz].
        coding: Options of the encoder x264; by default those of a video to be watched and kept.

    Raises:
        FileProblem: The file cannot be written.
    """

    def __init__(self, path: Path, size: tuple[int, int], *, rate: float, coding: Mapping[str, str] = WATCHED):
        self._size = size
        self._whole = ExitStack()
        self._beside = self._whole.enter_context(replacing(path))
        self._container = av.open(str(self._beside), "w", format="mp4", options={"movflags": "faststart"})
        frequency = Fraction(rate).limit_denominator(1001)
        stream = self._container.add_stream("libx264", rate=frequency, options=dict(coding))
        stream.width, stream.height = size[0] + size[0] % 2, size[1] + size[1] % 2
        stream.pix_fmt = "yuv420p"
        # One thread leaves the other cores to the drawing of the images.
        stream.codec_context.thread_count = 1
        self._stream = stream

    def add(self, image: Image) -> None:
        """Append an image (height, width, 3) in blue, green, red, uint8."""
        if image.shape != (self._size[1], self._size[0], 3):
            raise ValueError(f"The image has the shape {image.shape}, but the video has the size {self._size}.")
        image = np.pad(image, ((0, self._size[1] % 2), (0, self._size[0] % 2), (0, 0)), mode="edge")
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="bgr24")
        self._container.mux(self._stream.encode(frame))

    def __enter__(self) -> "VideoWriter":
        return self

    def __exit__(
        self, error: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if error is None:
                self._container.mux(self._stream.encode(None))
            self._container.close()
            if error is None:
                require_complete(self._beside, complete=_is_whole(self._beside))
        except BaseException as problem:
            self._whole.__exit__(type(problem), problem, problem.__traceback__)
            raise
        self._whole.__exit__(error, value, trace)


def _is_whole(path: Path) -> bool:
    """Return whether the boxes of an MP4 fill it exactly, and the index and the images are among them."""
    size, at, kinds = path.stat().st_size, 0, set()
    with path.open("rb") as file:
        while at + 8 <= size:
            file.seek(at)
            length, kind = struct.unpack(">I4s", file.read(8))
            if length == 1:  # The length follows as a number of 64 bits.
                (length,) = struct.unpack(">Q", file.read(8).ljust(8, b"\0"))
            if length < 8:
                return False
            kinds.add(kind)
            at += length
    return at == size and {b"moov", b"mdat"} <= kinds
