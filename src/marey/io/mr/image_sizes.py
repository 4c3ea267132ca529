"""Sizes that the headers of images state, checked before memory is reserved for the images."""

import gzip
import re
import zlib
from collections.abc import Iterable
from io import BufferedIOBase
from pathlib import Path
from typing import Any

import numpy as np

from marey.errors import FileProblem

MOST_VOXELS = 2**29
"""Largest number of voxels of an image: 1024 x 1024 x 512, of which the largest scans of knees have a fourth."""
_MOST_COMPRESSED = 1032
"""Largest ratio by which deflate compresses (zlib's technical details); images in DICOM are compressed less."""
_COPY = "Copy or export it again."
"""Remedy for headers that the file contradicts."""
_GZIP = b"\x1f\x8b"
"""First two bytes of a gzip file (RFC 1952)."""
_NIFTI_2 = 540
"""Length of the header of a NIfTI-2 file [bytes]; NIfTI-1 has 348."""
_NIFTI_FLOATS = {16: "f4", 64: "f8"}
"""Data types of NIfTI that can hold NaN, with their NumPy codes."""
_MOST_META_DIMENSIONS = 10
"""Largest number of dimensions of a MetaImage, by the format."""
_CHUNK = 1 << 20
"""Bytes that are decompressed at once."""


def require_possible_size(path: Path, reader: Any, files: Iterable[Path] | None = None) -> None:
    """Check that an image is not larger than its file can be.

    Args:
        path: The file, for errors.
        reader: SimpleITK's reader of the file, which has read its header.
        files: The files that may hold the voxels; by default those of the image's name.

    Raises:
        FileProblem: The image has impossible sizes, or more voxels than the file can hold.
    """
    sizes = [int(size) for size in reader.GetSize()]
    shown = " x ".join(map(str, sizes))
    kind = str(type_of_voxels(reader))
    bits = int(found[0]) if (found := re.findall(r"\d+", kind)) else 8
    voxels = int(np.prod(sizes, dtype=object)) * max(int(reader.GetNumberOfComponents()), 1)
    if min(sizes) < 1 or voxels > MOST_VOXELS:
        raise FileProblem(path, f"states {shown} voxels", f"At most {MOST_VOXELS} can be read. {_COPY}")
    own = [path] if files is None else list(files)
    if path.suffix.lower() in (".mhd", ".nhdr"):
        own = [each for each in path.parent.iterdir() if each.is_file()]
    available = sum(each.stat().st_size for each in own)
    if voxels * bits > 8 * available * _MOST_COMPRESSED:
        raise FileProblem(path, f"states {shown} voxels, more than its {available} bytes can hold", _COPY)


def type_of_voxels(reader: Any) -> str:
    """Return SimpleITK's name of the type of an image's voxels, such as `32-bit float`.

    Args:
        reader: SimpleITK's reader, which has read the header of the image.
    """
    import SimpleITK

    itk: Any = SimpleITK
    return str(itk.GetPixelIDValueAsString(reader.GetPixelIDValue()))


def require_header(path: Path) -> None:
    """Check what ITK does not check in the header of a file, or reports on the terminal.

    Args:
        path: A NIfTI or a MetaImage header; other files are not read.

    Raises:
        FileProblem: A number of dimensions is impossible, or the file of the voxels does not exist.
    """
    name = path.name.lower()
    if name.endswith((".nii", ".nii.gz")):
        _require_dimensions(path)
    if name.endswith((".mha", ".mhd")):
        _require_meta_header(path)
    if name.endswith(".mhd"):
        found = re.search(rb"^\s*ElementDataFile\s*=\s*(.+?)\s*$", path.read_bytes()[:_CHUNK], re.MULTILINE)
        data = found[1].decode("utf-8", "replace") if found else "LOCAL"
        if not (data.startswith(("LOCAL", "LIST")) or "%" in data or (path.parent / data).is_file()):
            raise FileProblem(path, f"has its voxels in {data[:100]}, which does not exist", "Copy both files.")


def _require_meta_header(path: Path) -> None:
    """Check the numbers of dimensions and voxels in the header of a MetaImage; ITK ends the program with wrong ones."""
    with path.open("rb") as file:
        head = file.read(_CHUNK).partition(b"ElementDataFile")[0]
    for key, most in (("NDims", _MOST_META_DIMENSIONS), ("DimSize", MOST_VOXELS)):
        for values in re.findall(rf"^\s*{key}\s*=([^\r\n]*)".encode(), head, re.MULTILINE):
            words = values.split()
            if not words or not all(word.isdigit() and 1 <= int(word[:20]) <= most for word in words):
                shown = values.decode("ascii", "replace").strip()[:60]
                raise FileProblem(path, f"states {key} = {shown}, which is impossible", _COPY)


def _require_dimensions(path: Path) -> None:
    """Check the numbers of dimensions and voxels along them in the header of a NIfTI."""
    head = nifti_content(path, _NIFTI_2)
    if len(head) < 348:  # ITK recognises that it is no NIfTI
        return
    order, second = _form(head)
    sizes = np.frombuffer(head, f"{order}{'i8' if second else 'i2'}", 8, 16 if second else 40).tolist()
    if not 1 <= sizes[0] <= 7:
        raise FileProblem(path, f"states {sizes[0]} dimensions", f"A NIfTI has 1 to 7. {_COPY}")
    if min(sizes[1 : 1 + sizes[0]]) < 1:
        raise FileProblem(path, f"states {' x '.join(map(str, sizes[1 : 1 + sizes[0]]))} voxels", _COPY)


def _form(head: bytes) -> tuple[str, bool]:
    """Return the order of the bytes of a NIfTI, and whether it is a NIfTI-2."""
    order = "<" if head[:2] in (b"\x5c\x01", b"\x1c\x02") else ">"
    return order, int(np.frombuffer(head, f"{order}i4", 1)[0]) == _NIFTI_2


def nifti_content(path: Path, length: int | None = None) -> bytes:
    """Return the uncompressed content of a file up to a length; a compressed file is read to its end.

    ITK pads a truncated file with 0 and reports nothing.

    Args:
        path: The file.
        length: Number of bytes at most; None for those of the voxels that the header states.

    Returns:
        The first bytes.

    Raises:
        FileProblem: It is compressed, and truncated or damaged.
    """
    with path.open("rb") as file:
        compressed = file.read(2) == _GZIP
    try:
        with gzip.open(path) if compressed else path.open("rb") as source:
            head = source.read(_NIFTI_2)
            if length is not None:
                return head[:length]
            content = _read_up_to(source, _stated_bytes(head), head)
            while compressed and source.read(_CHUNK):
                pass
            return content
    except (EOFError, OSError, zlib.error) as error:
        wrong = "is truncated or damaged: it cannot be decompressed to its end" if compressed else "cannot be read"
        raise FileProblem(path, wrong, "Copy it again.") from error


def _read_up_to(source: BufferedIOBase, length: int, head: bytes) -> bytes:
    """Return the content up to a length, of which the head was read; memory is used for what is there only."""
    parts, missing = [head], length - len(head)
    while missing > 0 and (part := source.read(min(missing, _CHUNK))):
        parts.append(part)
        missing -= len(part)
    return b"".join(parts)


def _stated_bytes(head: bytes) -> int:
    """Return the number of bytes up to the last voxel that the header of a NIfTI states."""
    order, second = _form(head)
    sizes = np.frombuffer(head, f"{order}{'i8' if second else 'i2'}", 8, 16 if second else 40).tolist()
    bits = int(np.frombuffer(head, f"{order}i2", 1, 14 if second else 72)[0])
    start = float(np.frombuffer(head, f"{order}{'i8' if second else 'f4'}", 1, 168 if second else 108)[0])
    voxels = int(np.prod(sizes[1 : 1 + sizes[0]], dtype=object))
    if not (0 <= start < 2**40 and 0 < voxels <= MOST_VOXELS and 0 < bits <= 256):
        raise ValueError("its voxels cannot lie where it states")
    return int(start) + (voxels * bits + 7) // 8


def non_finite_values(path: Path) -> int:
    """Count the values of a NIfTI file that are not finite: ITK silently replaces them by 0.

    Args:
        path: The file.

    Raises:
        FileProblem: It is damaged.
    """
    try:
        content = nifti_content(path)
        order, second = _form(content)
        kind = int(np.frombuffer(content, f"{order}i2", 1, 12 if second else 70)[0])
        if kind not in _NIFTI_FLOATS:
            return 0
        start = int(np.frombuffer(content, f"{order}{'i8' if second else 'f4'}", 1, 168 if second else 108)[0])
        item = np.dtype(f"{order}{_NIFTI_FLOATS[kind]}")
        count = (_stated_bytes(content) - start) // item.itemsize
        return int((~np.isfinite(np.frombuffer(content, item, count, start))).sum())
    except (ValueError, OverflowError) as error:
        raise FileProblem(path, f"has a damaged header ({error})", _COPY) from error
