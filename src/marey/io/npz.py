"""NPZ archives of named arrays, without pickle."""

import math
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import MISSING, fields
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy

from marey.arrays import Floats, Integers, Mask
from marey.errors import FileProblem, MareyError
from marey.io.atomic import replacing
from marey.motion.motion import BodyMotion
from marey.wording import listed


def write_arrays(path: Path | str, arrays: Mapping[str, object]) -> None:
    """Write arrays under their names.

    Args:
        path: The file.
        arrays: Maps a name to numbers, Boolean values or strings.

    Raises:
        TypeError: An array holds values of another type.
    """
    plain = {name: np.asarray(value) for name, value in arrays.items()}
    bad = [name for name, value in plain.items() if value.dtype.kind not in "fiubU"]
    if bad:
        raise TypeError(f"These arrays hold neither numbers, Boolean values nor strings: {', '.join(bad)}.")
    with replacing(path) as beside, beside.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **plain)


def read_arrays(
    path: Path | str, wanted: tuple[str, ...] = (), *, texts: tuple[str, ...] | None = None
) -> dict[str, np.ndarray]:
    """Read all arrays of a file.

    Args:
        path: The file.
        wanted: Names of the arrays that the file must contain.
        texts: Names of those among the wanted arrays that hold texts; all others must hold numbers or Boolean values.
            None if the types of the arrays are not checked.

    Returns:
        The arrays by name.

    Raises:
        FileProblem: The file does not exist, is not an NPZ, is damaged, states arrays that are larger than the file can
            hold, lacks one of the wanted arrays, or has one of another type.
    """
    try:
        if Path(path).is_file() and not zipfile.is_zipfile(path):
            raise FileProblem(path, "is not an NPZ file, or it is damaged", "Give an NPZ as NumPy's `savez` writes it.")
        with zipfile.ZipFile(path) as archive:
            require_possible_sizes(path, archive)
        with Path(path).open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except FileNotFoundError as error:
        raise FileProblem(path, "does not exist", "Give an NPZ file.") from error
    except DAMAGED_ARCHIVE as error:
        raise FileProblem(path, f"cannot be read as NPZ ({error})", "Write the file again.") from error
    missing = [name for name in wanted if name not in arrays]
    if missing:
        raise FileProblem(path, f"lacks {listed(missing)}", f"It contains {listed(arrays, none='no arrays')}.")
    if texts is not None:
        _require_types(path, {name: arrays[name] for name in wanted}, texts)
    return arrays


DAMAGED_ARCHIVE: tuple[type[Exception], ...] = (
    *(OSError, ValueError, EOFError, AttributeError, TypeError, KeyError, IndexError, SyntaxError, RecursionError),
    *(OverflowError, MemoryError, NotImplementedError, RuntimeError, zipfile.BadZipFile, zlib.error, struct.error),
    tokenize.TokenError,
)
"""Errors that NumPy, zipfile and zlib raise on files that are damaged, encrypted, or packed in an unknown way."""
DEFLATE_RATIO = 1032
"""Largest ratio of the size of unpacked data to that of packed data: the limit of the method deflate."""
SMALLEST_LIMIT = 2**16
"""Size of an unpacked array below which its ratio is not checked [bytes]. Chosen by hand."""


def require_possible_sizes(path: Path | str, archive: zipfile.ZipFile) -> None:
    """Require that the arrays of an archive are not larger than its packed data can hold.

    A reader therefore never needs more memory than `DEFLATE_RATIO` times the size of the file.

    Args:
        path: The file, for the error message.
        archive: The archive.

    Raises:
        FileProblem: An array is larger.
    """
    held = Path(path).stat().st_size
    for entry in archive.infolist():
        with archive.open(entry) as stream:
            shape, dtype = array_header(stream)
        stated = math.prod(shape) * dtype.itemsize
        most = max(DEFLATE_RATIO * min(entry.compress_size, held), SMALLEST_LIMIT)
        if max(stated, entry.file_size) > most or stated > entry.file_size:
            wrong = f"states a size of {stated} bytes for the array {entry.filename[:40]!r}, which it cannot hold"
            raise FileProblem(path, wrong, "Write the file again.")


def array_header(stream: IO[bytes]) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Read the header of an array in NumPy's format, and return shape and type; the stream is at its data then.

    Raises:
        ValueError: It is no array.
    """
    version = npy.read_magic(stream)
    read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
    shape, _, dtype = read(stream)
    return tuple(int(n) for n in shape), dtype


def _require_types(path: Path | str, arrays: Mapping[str, np.ndarray], texts: tuple[str, ...]) -> None:
    for name, values in arrays.items():
        kinds, what = ("U", "texts") if name in texts else ("fiub", "numbers")
        if values.dtype.kind not in kinds:
            wrong = f"has an array {name} of the type {values.dtype}, which holds no {what}"
            raise FileProblem(path, wrong, "Write the file again.")


@contextmanager
def consistent_arrays(path: Path | str, remedy: str) -> Iterator[None]:
    """Report arrays whose shapes or values contradict each other as a problem of their file.

    Args:
        path: The file.
        remedy: What the user can do, as a sentence.

    Yields:
        Nothing; what is built from the arrays is built within this context.

    Raises:
        FileProblem: An error occurred in it that unsuitable arrays cause.
    """
    try:
        yield
    except FileProblem:
        raise
    except KeyError as error:
        raise FileProblem(path, f"lacks {error.args[0]}", remedy) from error
    except MareyError as error:
        raise FileProblem(path, f"cannot be used: {str(error).rstrip('.')}", remedy) from error
    except (ValueError, TypeError, IndexError, ArithmeticError, MemoryError) as error:
        reason = str(error).strip().splitlines() or [type(error).__name__]
        raise FileProblem(path, f"has inconsistent arrays ({reason[0].rstrip('.')})", remedy) from error


def write_motion(path: Path | str, motion: BodyMotion) -> None:
    """Write `motion.npz`: the fields of the motion under their own names.

    Args:
        path: The file.
        motion: The motion to write.
    """
    write_arrays(path, motion.arrays())


def read_motion(path: Path | str) -> BodyMotion:
    """Read `motion.npz`.

    Args:
        path: The file.

    Raises:
        FileProblem: The file lacks a key, or its arrays are inconsistent.
    """
    needed = tuple(field.name for field in fields(BodyMotion) if field.default is MISSING)
    arrays = read_arrays(path, needed, texts=tuple(name for name in needed if name.endswith("_names")))
    with consistent_arrays(path, "Give a motion.npz as `marey capture` or `marey shape` writes it."):
        fitted: dict[str, Any] = {
            field.name: arrays[field.name] for field in fields(BodyMotion) if field.name in arrays
        }
        return BodyMotion(**fitted)


def write_skin(
    path: Path | str,
    vertices: Iterable[Floats],
    faces: Integers,
    seen: Iterable[Mask] | None = None,
    *,
    frames: int,
    count: int,
) -> None:
    """Write `skin.npz`, the posed skin, frame by frame, so that a long motion is never entirely in memory.

    Args:
        path: The file.
        vertices: One array (V, 3) per frame, in the world [m], NaN in frames without a pose; written in single
            precision, whose resolution is one micrometre at ten metres.
        faces: (T, 3) indices of vertices.
        seen: One array (V,) per frame, true for vertices that were measured by an observation; None if none were.
        frames: Number of frames F.
        count: Number of vertices V.

    Raises:
        ValueError: `vertices` or `seen` has another number of frames.
    """
    flags = (False for _ in range(frames)) if seen is None else seen
    posed = (np.broadcast_to(row, (1, count, 3)) for row in vertices)
    measured = (np.broadcast_to(row, (1, count)) for row in flags)
    arrays: list[ArrayRows] = [
        ("vertices", posed, np.dtype("<f4"), (frames, count, 3)),
        ("faces", [faces], np.dtype("<i8"), (len(faces), 3)),
        ("seen", measured, np.dtype(bool), (frames, count)),
    ]
    write_rows(path, arrays)


ArrayRows = tuple[str, Iterable[np.ndarray], np.dtype, tuple[int, ...]]
"""An array in pieces: its name, the pieces (one or more rows each), and the type and shape of the entire array."""


def write_rows(path: Path | str, arrays: Iterable[ArrayRows]) -> None:
    """Write arrays that are given in pieces, so that none of them is ever entirely in memory.

    Args:
        path: The file.
        arrays: The arrays, written one after the other.

    Raises:
        ValueError: The pieces of an array do not add up to its shape.
    """
    with replacing(path) as beside, zipfile.ZipFile(beside, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, pieces, dtype, shape in arrays:
            _write_rows(archive, name, pieces, dtype, shape)


def _write_rows(
    archive: zipfile.ZipFile, name: str, pieces: Iterable[np.ndarray], dtype: np.dtype, shape: tuple[int, ...]
) -> None:
    """Write one array of an NPZ piece by piece."""
    written = 0
    with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
        head = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(file, head)
        for piece in pieces:
            if np.shape(piece)[1:] != shape[1:]:
                raise ValueError(f"{name} has rows of shape {np.shape(piece)[1:]} instead of {shape[1:]}.")
            file.write(np.ascontiguousarray(piece, dtype=dtype).tobytes())
            written += len(np.atleast_1d(piece))
    wanted = shape[0] if shape else 1
    if written != wanted:
        raise ValueError(f"{name} has {written} rows instead of {wanted}.")
