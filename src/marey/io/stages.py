"""What a long work has found so far, kept on disk so that an interrupted run can go on from there."""

import hashlib
import io
import os
import struct
import threading
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from marey.errors import FileProblem
from marey.io.atomic import replacing

Arrays = dict[str, np.ndarray]

WHOLE_BYTES = 1 << 26
"""Larger files are fingerprinted by samples."""
_SAMPLES, _SAMPLE_BYTES = 16, 1 << 20
_HEADER = struct.Struct("<4sQI")
_MAGIC = b"MRY1"


def file_fingerprint(path: Path) -> str:
    """Tell files apart by their content: all of it, or for large files their size and samples all over them.

    Args:
        path: A file, or a folder, of which every file counts.

    Returns:
        32 hexadecimal digits.

    Raises:
        FileProblem: It cannot be read.
    """
    digest = hashlib.blake2b(digest_size=16)
    try:
        for file in sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]:
            if path.is_dir():
                digest.update(str(file.relative_to(path)).encode())
            _add_content(digest, file)
    except OSError as problem:
        raise FileProblem(path, f"cannot be read ({problem.strerror})", "Check the name and the rights.") from problem
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
    """Write arrays to a file that is either whole or not there: written beside, then renamed."""
    with replacing(path) as beside, beside.open("wb") as stream:
        np.savez(stream, allow_pickle=False, **arrays)


def load_arrays(path: Path) -> Arrays:
    """Read what `save_arrays` wrote."""
    with np.load(path, allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


class FrameLog:
    """Results of frames in their order, appended one by one; only those asked for are in memory.

    A run that is cut off leaves at most its last record incomplete; such a record is dropped when the log is opened.

    Args:
        path: The log's file; made when missing.
    """

    def __init__(self, path: Path):
        self._path = path
        self._file = path.open("r+b" if path.exists() else "w+b")
        self._lock = threading.Lock()
        """Several threads may read."""
        self._starts = self._find_records()

    def _find_records(self) -> list[int]:
        starts, end = [], 0
        size = os.fstat(self._file.fileno()).st_size
        while end + _HEADER.size <= size:
            self._file.seek(end)
            magic, length, checksum = _HEADER.unpack(self._file.read(_HEADER.size))
            if magic != _MAGIC or end + _HEADER.size + length > size:
                break
            # Appending is in order, so only the last record can be torn; earlier ones need no second reading.
            if end + _HEADER.size + length == size and zlib.crc32(self._file.read(length)) != checksum:
                break
            starts.append(end)
            end += _HEADER.size + length
        self._file.truncate(end)
        return starts

    def __len__(self) -> int:
        """Count the frames."""
        return len(self._starts)

    def __getitem__(self, frame: int) -> Arrays:
        with self._lock:
            self._file.seek(self._starts[frame])
            _, length, checksum = _HEADER.unpack(self._file.read(_HEADER.size))
            content = self._file.read(length)
        if zlib.crc32(content) != checksum:
            raise FileProblem(self._path, f"is damaged at frame {frame}", "Delete it and start the same command again.")
        with np.load(io.BytesIO(content), allow_pickle=False) as record:
            return {name: record[name] for name in record.files}

    def __iter__(self) -> Iterator[Arrays]:
        return (self[frame] for frame in range(len(self)))

    def append(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Add the next frame's results."""
        buffer = io.BytesIO()
        np.savez(buffer, allow_pickle=False, **arrays)
        content = buffer.getvalue()
        with self._lock:
            self._file.seek(0, os.SEEK_END)
            start = self._file.tell()
            self._file.write(_HEADER.pack(_MAGIC, len(content), zlib.crc32(content)) + content)
            self._file.flush()
            self._starts.append(start)

    def cut(self, frames: int) -> None:
        """Keep only the first frames."""
        if frames < len(self):
            self._file.truncate(self._starts[frames])
            del self._starts[frames:]

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> "FrameLog":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
