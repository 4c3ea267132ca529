"""Videos that open in every browser and player: H.264 in MP4, written beside and renamed when whole."""

import os
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

from marey.arrays import Image
from marey.errors import FileProblem


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
        self._path, self._size = path, size
        self._beside = path.with_name(f".{path.name}.part")
        try:
            self._container = av.open(str(self._beside), "w", format="mp4", options={"movflags": "faststart"})
        except OSError as problem:
            raise FileProblem(path, f"cannot be written ({problem.strerror})", "Check the folder's rights.") from problem
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

    def close(self) -> None:
        """Finish the file."""
        self._container.mux(self._stream.encode(None))
        self._container.close()
        os.replace(self._beside, self._path)

    def discard(self) -> None:
        """Leave nothing behind."""
        self._container.close()
        self._beside.unlink(missing_ok=True)

    def __enter__(self) -> "VideoWriter":
        return self

    def __exit__(self, error: type[BaseException] | None, *_: object) -> None:
        self.close() if error is None else self.discard()
