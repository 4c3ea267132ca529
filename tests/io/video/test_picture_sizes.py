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


def test_a_chunk_that_is_longer_than_its_file_is_refused_before_memory_is_reserved(tmp_path, rng):
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), rng.integers(0, 255, (9, 12, 3)).astype(np.uint8))
    content = bytearray(path.read_bytes())
    assert content[37:41] == b"IDAT"
    struct.pack_into(">I", content, 33, 2**32 - 9)
    path.write_bytes(content)
    with pytest.raises(FileProblem, match="a part of it is longer than the file"):
        read_picture(path)


def test_a_bigtiff_that_begins_beyond_every_file_is_not_readable(tmp_path):
    path = tmp_path / "a.tif"
    path.write_bytes(b"II+\0\x08\0\0\0" + b"\xff" * 8 + bytes(40))
    with pytest.raises(FileProblem, match="not a readable image"):
        read_picture(path)


def of_jpeg(content: bytearray, width: int, height: int) -> None:
    struct.pack_into(">HH", content, content.index(b"\xff\xc0") + 5, height, width)


def of_tiff(content: bytearray, width: int, height: int) -> None:
    (start,) = struct.unpack_from("<I", content, 4)
    (count,) = struct.unpack_from("<H", content, start)
    for at in range(start + 2, start + 2 + 12 * count, 12):
        tag = struct.unpack_from("<H", content, at)[0]
        if tag in (256, 257):
            struct.pack_into("<HHII", content, at, tag, 4, 1, width if tag == 256 else height)


def of_webp(content: bytearray, width: int, height: int) -> None:
    assert content[12:16] == b"VP8L"
    (bits,) = struct.unpack_from("<I", content, 21)
    struct.pack_into("<I", content, 21, bits & 0xF0000000 | (height - 1) << 14 | (width - 1))


@pytest.mark.parametrize(("ending", "resize"), [("jpg", of_jpeg), ("tif", of_tiff), ("webp", of_webp)])
def test_other_formats_are_bounded_by_their_files_too(tmp_path, rng, ending, resize):
    path = tmp_path / f"a.{ending}"
    cv2.imwrite(str(path), rng.integers(0, 255, (40, 50, 3), dtype=np.uint8), [cv2.IMWRITE_WEBP_QUALITY, 101])
    assert read_picture(path).shape == (40, 50, 3)
    content = bytearray(path.read_bytes())
    resize(content, 16_000, 15_000)
    path.write_bytes(content)
    with pytest.raises(FileProblem, match=r"states 16000 x 15000 pixels, more than its \d+ bytes can hold"):
        read_picture(path)


@pytest.mark.parametrize("ending", ["jpg", "tif", "webp", "png"])
def test_an_empty_mask_of_a_large_camera_is_possible(tmp_path, ending):
    path = tmp_path / f"a.{ending}"
    cv2.imwrite(str(path), np.zeros((3000, 4000), np.uint8), [cv2.IMWRITE_WEBP_QUALITY, 101])
    assert read_picture(path).shape == (3000, 4000, 3)


@pytest.mark.parametrize("ending", ["jpg", "tif", "webp", "png"])
def test_a_picture_that_ends_within_its_header_is_damaged(tmp_path, ending):
    path = tmp_path / f"a.{ending}"
    cv2.imwrite(str(path), np.zeros((30, 40, 3), np.uint8))
    content = path.read_bytes()
    for length in (3, 9, 17, 25):
        path.write_bytes(content[:length])
        with pytest.raises(FileProblem, match="not a readable image"):
            read_picture(path)
