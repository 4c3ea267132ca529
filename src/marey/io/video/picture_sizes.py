"""Sizes that the headers of pictures state, checked before memory is reserved for the pictures."""

import struct
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


def require_possible_picture(path: Path, content: bytes) -> None:
    """Check that a PNG is not larger than its file can be; other pictures are left to the reader.

    Args:
        path: The file, for errors.
        content: Its first bytes, or all.

    Raises:
        FileProblem: The picture has more pixels than the file can hold.
    """
    if content[:8] != _PNG or len(content) < 26:
        return
    width, height, depth, colours = struct.unpack_from(">IIBB", content, 16)
    needed = height * (1 + width * _SAMPLES.get(colours, 1) * depth // 8)
    available = path.stat().st_size
    if width * height > MOST_PIXELS or needed > _MOST_COMPRESSED * available:
        wrong = f"states {width} x {height} pixels, more than its {available} bytes can hold"
        raise FileProblem(path, wrong, "Copy the file again.")
