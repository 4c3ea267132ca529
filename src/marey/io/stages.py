"""Intermediate results on disk, from which an interrupted run can be resumed."""

import hashlib
import io
import math
import os
import re
import struct
import sys
import threading
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import IO

import numpy as np
from numpy.lib import format as npy

from marey.errors import DamagedCheckpoint, FileProblem
from marey.io.atomic import naming_unwritten, replacing, synced_later

Arrays = dict[str, np.ndarray]
"""Arrays by name."""

WHOLE_BYTES = 1 << 26
"""Files up to this size [bytes] are hashed completely, larger ones by samples; chosen by hand."""
_SAMPLES, _SAMPLE_BYTES = 16, 1 << 20
"""Number of samples of a large file, evenly distributed, and the size of each [bytes]; chosen by hand."""
_HEADER = struct.Struct("<4sQI")
"""Header of a record of a frame log: `_MAGIC`, length of the content [bytes], CRC-32 of the content."""
_MAGIC = b"MRY1"
"""First four bytes of each record of a frame log, version 1."""


def file_fingerprint(path: Path) -> str:
    """Return a hash of the content of a file, or of its size and evenly distributed samples if it is large.

    Args:
        path: A file, or a folder, all files of which are included.

    Returns:
        32 hexadecimal digits.

    Raises:
        FileProblem: The file cannot be read.
    """
    digest = hashlib.blake2b(digest_size=16)
    try:
        for file in sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]:
            if path.is_dir():
                digest.update(str(file.relative_to(path)).encode())
            _add_content(digest, file)
    except OSError as problem:
        remedy = "Check the name and the access rights."
        raise FileProblem(path, f"cannot be read ({problem.strerror})", remedy) from problem
    return digest.hexdigest()


def _add_content(digest: "hashlib.blake2b", file: Path) -> None:
    size = file.stat().st_size
    digest.update(size.to_bytes(8, "little"))
    with file.open("rb") as stream:
        if size <= WHOLE_BYTES:
            digest.update(stream.read())
            return
        for i in range(_SAMPLES):
            stream.seek(i * (size - _SAMPLE_BYTES) // (_SAMPLES - 1))
            digest.update(stream.read(_SAMPLE_BYTES))


def save_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write arrays without compression to a file that is either complete or absent.

    The file is not flushed to the disk at once: `saved_arrays` notices a file that a power cut has damaged.
    """
    with synced_later(path.parent), replacing(path) as beside, beside.open("wb") as stream:
        np.savez(stream, allow_pickle=False, **arrays)


def load_arrays(path: Path) -> Arrays:
    """Read arrays that `save_arrays` wrote."""
    with path.open("rb") as file:
        return _loaded(file)


def _loaded(stream: IO[bytes]) -> Arrays:
    # NumPy leaves a damaged file open if it opens the file itself.
    with np.load(stream, allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


def saved_arrays(path: Path, compute: Callable[[], Mapping[str, np.ndarray]]) -> Arrays:
    """Read arrays that were saved, or compute and save them.

    Args:
        path: The file; if it is damaged, for example by a power cut, it is replaced.
        compute: Returns the arrays by name, none of them of Python objects.

    Returns:
        Arrays by name.
    """
    if path.exists():
        # The checksums of the archive cover all of its content.
        with suppress(zipfile.BadZipFile, zlib.error, EOFError, ValueError, OSError), path.open("rb") as file:
            return _loaded(file)
    save_arrays(path, compute())
    return load_arrays(path)


_LAYOUT = re.compile(
    rb"\{'descr': '(?P<type>[^']+)', 'fortran_order': False, 'shape': \((?P<shape>\d+(?:,|(?:, \d+)+))\), \} *\n"
)
"""Header of an array with at least one axis and a simple type, as NumPy writes it in version 1.0 of its format."""


def _array_of(content: memoryview) -> np.ndarray:
    """Return the array of a file in NumPy's format; usual headers are parsed here.

    NumPy parses each header as Python. For small arrays, this takes longer than all the rest, and until Python 3.12 it
    fails at times if several threads do it at once (python/cpython#106905).
    """
    start = len(npy.MAGIC_PREFIX) + 2
    end = start + 2 + int.from_bytes(content[start : start + 2], "little")
    layout = _LAYOUT.fullmatch(content[start + 2 : end]) if content[:start] == npy.magic(1, 0) else None
    if layout is not None and not (dtype := np.dtype(layout["type"].decode())).hasobject:
        shape = tuple(int(length) for length in layout["shape"].split(b",") if length)
        return np.frombuffer(content, dtype, count=math.prod(shape), offset=end).reshape(shape).copy()
    with _PARSING:
        return np.asarray(npy.read_array(io.BytesIO(content), allow_pickle=False))


_PARSING = threading.Lock()
"""Held while NumPy parses a header as Python."""
_NAME_LENGTH = 26
"""Offset of the length of the name in the header of a member of a ZIP archive; that of the extra field follows, and
then the name, the extra field, and the content [bytes]."""


def _stored(archive: bytes, member: zipfile.ZipInfo) -> tuple[int, int]:
    """Return begin and length of the content of an uncompressed member in an archive [bytes]."""
    name, extra = struct.unpack_from("<2H", archive, member.header_offset + _NAME_LENGTH)
    start = member.header_offset + _NAME_LENGTH + 4 + name + extra
    return start, member.file_size


class FrameLog:
    """Results per frame, appended in order on disk; a frame is read into memory only when it is accessed.

    A killed run leaves at most the last record incomplete, and a power cut may damage some of the last ones; they are
    dropped when the log is opened.

    Args:
        path: The file of the log; created if it does not exist.
    """

    def __init__(self, path: Path):
        self._path = path
        # Without a buffer, which would be written once more when the file of a full disk is closed.
        self._file = path.open("r+b" if path.exists() else "w+b", buffering=0)
        self._lock = threading.Lock()
        """Protects the file position, which threads share."""
        self._starts = self._find_records()
        self._members: dict[int, dict[str, tuple[int, int]]] = {}
        """Begin and length of the arrays in the file [bytes], by frame and name, of the frames that were read."""

    def _find_records(self) -> list[int]:
        starts, end = [], 0
        size = os.fstat(self._file.fileno()).st_size
        while (begin := end + _HEADER.size) <= size:
            magic, length, checksum = _HEADER.unpack(self._read(end, _HEADER.size))
            if magic != _MAGIC or begin + length > size or zlib.crc32(self._read(begin, length)) != checksum:
                break
            starts.append(end)
            end = begin + length
        self._file.truncate(end)
        return starts

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self._starts)

    def __getitem__(self, frame: int) -> Arrays:
        content, members = self._record(frame)
        return {name: _array_of(memoryview(content)[start : start + size]) for name, (start, size) in members.items()}

    def array(self, frame: int, name: str) -> np.ndarray:
        """Return one array of a frame; the record is checked, and read entirely, the first time only."""
        if frame not in self._members:
            before = self._starts[frame] + _HEADER.size
            members = self._record(frame)[1]
            self._members[frame] = {each: (before + start, size) for each, (start, size) in members.items()}
        start, size = self._members[frame][name]
        return _array_of(memoryview(self._read(start, size)))

    def _record(self, frame: int) -> tuple[bytes, dict[str, tuple[int, int]]]:
        """Return the content of a frame's record, and the begin and length of each array in it [bytes]."""
        start = self._starts[frame]
        _, length, checksum = _HEADER.unpack(self._read(start, _HEADER.size))
        content = self._read(start + _HEADER.size, length)
        if zlib.crc32(content) != checksum:
            raise DamagedCheckpoint(self._path, frame)
        with zipfile.ZipFile(io.BytesIO(content)) as record:
            return content, {each.filename.removesuffix(".npy"): _stored(content, each) for each in record.infolist()}

    def __iter__(self) -> Iterator[Arrays]:
        return (self[frame] for frame in range(len(self)))

    def _read(self, start: int, length: int) -> bytes:
        """Read bytes from a position of the file; the system may return fewer of them at a time."""
        parts: list[bytes] = []
        while length and (part := self._part(start, length)):
            parts.append(part)
            start, length = start + len(part), length - len(part)
        return b"".join(parts)

    def _part(self, start: int, length: int) -> bytes:
        """Read some bytes without a change of the file position, which copies of this process (forks) share."""
        if sys.platform != "win32":
            return os.pread(self._file.fileno(), length, start)
        with self._lock:
            self._file.seek(start)
            return self._file.read(length)

    def append(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Append the results of the next frame.

        Raises:
            NotWritten: The disk is full; the incomplete record is dropped when the log is opened again.
        """
        buffer = io.BytesIO()
        np.savez(buffer, allow_pickle=False, **arrays)
        content = buffer.getvalue()
        with self._lock:
            self._file.seek(0, os.SEEK_END)
            start = self._file.tell()
            record = memoryview(_HEADER.pack(_MAGIC, len(content), zlib.crc32(content)) + content)
            with naming_unwritten(self._path):
                while record:
                    record = record[self._file.write(record) or 0 :]
            self._starts.append(start)

    def cut(self, frames: int) -> None:
        """Keep only the first frames and delete the others from the file."""
        if frames < len(self):
            self._file.truncate(self._starts[frames])
            del self._starts[frames:]
            self._members = {frame: members for frame, members in self._members.items() if frame < frames}

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> "FrameLog":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
