"""Videos that open in every browser and player: H.264 in MP4, written beside and renamed when whole."""

from contextlib import ExitStack
from fractions import Fraction
from pathlib import Path
from types import TracebackType

import av
import numpy as np

from marey.arrays import Image
from marey.io.atomic import replacing


class VideoWriter:
    """Writes pictures to a video one by one; the file appears when the last is written.

    Used as a context; a block that ends with an error leaves no file.

    Args:
        path: The MP4 file.
        size: Width and height of the pictures [px]; odd ones get one more column or row, as H.264 asks.
        rate: Pictures a second [Hz].

    Raises:
        FileProblem: The file cannot be written.
    """

    def __init__(self, path: Path, size: tuple[int, int], *, rate: float):
        self._size = size
        self._whole = ExitStack()
        beside = self._whole.enter_context(replacing(path))
        self._container = av.open(str(beside), "w", format="mp4", options={"movflags": "faststart"})
        frequency = Fraction(rate).limit_denominator(1001)
        stream = self._container.add_stream("libx264", rate=frequency, options={"preset": "veryfast", "crf": "23"})
        stream.width, stream.height = size[0] + size[0] % 2, size[1] + size[1] % 2
        stream.pix_fmt = "yuv420p"
        # One thread leaves the other cores to the work that makes the pictures.
        stream.codec_context.thread_count = 1
        self._stream = stream

    def add(self, image: Image) -> None:
        """Add a picture (height, width, 3) in blue, green, red."""
        if image.shape != (self._size[1], self._size[0], 3):
            raise ValueError(f"the picture is {image.shape}, the video {self._size}")
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
        except BaseException as problem:
            self._whole.__exit__(type(problem), problem, problem.__traceback__)
            raise
        self._whole.__exit__(error, value, trace)
