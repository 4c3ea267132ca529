"""Sizes that the headers of pictures state, checked before memory is reserved for the pictures."""

import struct
from collections.abc import Iterator
from pathlib import Path

from marey.errors import FileProblem

MOST_PIXELS = 2**29
"""Largest number of pixels of a picture: five times that of the largest cameras. Chosen by hand."""
_MOST_COMPRESSED = 1032
"""Largest ratio by which deflate compresses (zlib's technical details); a PNG contains nothing else."""
_PNG = b"\x89PNG\r\n\x1a\n"
"""First bytes of a PNG (ISO/IEC 15948)."""
_SAMPLES = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
"""Samples of a pixel by the colour type of a PNG (ISO/IEC 15948, table 11.1)."""
_ALWAYS_POSSIBLE = 2**25
"""Pixels that a JPEG, TIFF or WebP of any length may have: an empty mask of a camera with 33 million pixels, which a
lossless WebP holds in 50 bytes. Decoded, these are 100 MB."""
_MOST_PIXELS_A_BYTE = {"JPEG": 512, "TIFF": 2560, "WebP": 2560}
"""Most pixels of a byte of a larger picture, by its format. JPEG: 64 pixels take one bit at least (ITU-T T.81, F.1.2).
TIFF: the longest strings of its LZW have 3837 bytes for 12 bits. WebP has no such limit; 2560 is the ratio of TIFF, of
which photographs have less than 1 %."""
_FRAMES_OF_JPEG = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}
"""Markers of a JPEG that are followed by its size (ITU-T T.81, table B.1)."""
_WIDTH_TAG, _HEIGHT_TAG, _MOST_TAGS = 256, 257, 4096
"""Tags of a TIFF for its width and height (TIFF 6.0, section 8), and the most tags that are searched."""


def require_possible_picture(path: Path, content: bytes) -> None:
    """Check that a PNG, JPEG, TIFF or WebP is not larger than its file can be; others are left to the reader.

    Args:
        path: The file, for errors.
        content: Its content.

    Raises:
        FileProblem: The picture has more pixels than the file can hold.
    """
    available = path.stat().st_size
    try:
        if content[:8] == _PNG:
            _require_chunks(path, content)
            width, height, depth, colours = struct.unpack_from(">IIBB", content, 16)
            needed = height * (1 + width * _SAMPLES.get(colours, 1) * depth // 8)
            _require(path, width, height, possible=needed <= _MOST_COMPRESSED * available)
            return
        for kind, sizes in (("JPEG", _jpeg_sizes), ("TIFF", _tiff_sizes), ("WebP", _webp_sizes)):
            for width, height in sizes(content):
                most = max(_ALWAYS_POSSIBLE, _MOST_PIXELS_A_BYTE[kind] * available)
                _require(path, width, height, possible=width * height <= most)
    except (struct.error, OverflowError):
        # The file ends within its header, or before a place that it states: the reader reports that.
        return


def _require(path: Path, width: int, height: int, *, possible: bool) -> None:
    if width * height > MOST_PIXELS or not possible:
        wrong = f"states {width} x {height} pixels, more than its {path.stat().st_size} bytes can hold"
        raise FileProblem(path, wrong, "Copy the file again.")


def _require_chunks(path: Path, content: bytes) -> None:
    """Check that no chunk of a PNG is longer than the rest of the file; the reader reserves what a chunk states."""
    at = len(_PNG)
    while at + 8 <= len(content):
        (length,) = struct.unpack_from(">I", content, at)
        if at + 12 + length > len(content):
            raise FileProblem(path, "is not a readable image: a part of it is longer than the file", "Copy it again.")
        if content[at + 4 : at + 8] == b"IEND":
            return
        at += 12 + length


def _jpeg_sizes(content: bytes) -> Iterator[tuple[int, int]]:
    """Yield the width and height of each frame of a JPEG before its first scan."""
    if content[:2] != b"\xff\xd8":
        return
    at = 2
    while at + 4 <= len(content) and content[at] == 0xFF and content[at + 1] != 0xDA:
        marker = content[at + 1]
        if marker == 0xFF or marker == 0x01 or 0xD0 <= marker <= 0xD8:  # fill bytes, and markers without a length
            at += 1 if marker == 0xFF else 2
            continue
        if marker in _FRAMES_OF_JPEG:
            height, width = struct.unpack_from(">HH", content, at + 5)
            yield width, height
        at += 2 + int(struct.unpack_from(">H", content, at + 2)[0])


def _tiff_sizes(content: bytes) -> Iterator[tuple[int, int]]:
    """Yield the width and height of the first picture of a TIFF or BigTIFF."""
    if content[:4] not in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
        return
    order, big = "<" if content[:2] == b"II" else ">", b"+" in content[2:4]
    start = int(struct.unpack_from(f"{order}{'Q' if big else 'I'}", content, 8 if big else 4)[0])
    count = int(struct.unpack_from(f"{order}{'Q' if big else 'H'}", content, start)[0])
    found = {}
    for k in range(min(count, _MOST_TAGS)):
        at = start + (8 + 20 * k if big else 2 + 12 * k)
        tag, kind = struct.unpack_from(f"{order}HH", content, at)
        if tag in (_WIDTH_TAG, _HEIGHT_TAG):
            letter = {3: "H", 4: "I", 16: "Q"}.get(kind, "I")
            found[tag] = int(struct.unpack_from(f"{order}{letter}", content, at + (12 if big else 8))[0])
    if len(found) == 2:
        yield found[_WIDTH_TAG], found[_HEIGHT_TAG]


def _webp_sizes(content: bytes) -> Iterator[tuple[int, int]]:
    """Yield the width and height that the first chunk of a WebP states (RFC 9649)."""
    if content[:4] != b"RIFF" or content[8:12] != b"WEBP":
        return
    kind = content[12:16]
    if kind == b"VP8X":
        low = struct.unpack_from("<HBHB", content, 24)
        yield 1 + low[0] + (low[1] << 16), 1 + low[2] + (low[3] << 16)
    elif kind == b"VP8L":
        bits = int(struct.unpack_from("<I", content, 21)[0])
        yield 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    elif kind == b"VP8 ":
        width, height = struct.unpack_from("<HH", content, 26)
        yield width & 0x3FFF, height & 0x3FFF
