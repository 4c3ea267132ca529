"""Pictures that are larger than their files can hold are refused before memory is reserved for them."""

import struct
import zlib

import cv2
import numpy as np
import pytest

from marey.errors import FileProblem
from marey.io.video.video import read_picture


def test_a_picture_that_its_file_cannot_hold_is_refused(tmp_path):
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), np.zeros((400, 500, 3), np.uint8))
    assert read_picture(path).shape == (400, 500, 3)
    content = bytearray(path.read_bytes())
    for width, height in ((60_000, 60_000), (20_000, 20_000)):
        struct.pack_into(">II", content, 16, width, height)
        struct.pack_into(">I", content, 29, zlib.crc32(content[12:29]))
        path.write_bytes(content)
        with pytest.raises(FileProblem, match=rf"states {width} x {height} pixels, more than its \d+ bytes can hold"):
            read_picture(path)
