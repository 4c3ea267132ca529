"""NPZ: everything, array by array under plain names, without pickle."""

import zipfile
from collections.abc import Iterable, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.errors import FileProblem, MareyError
from marey.io.atomic import replacing
from marey.motion.motion import BodyMotion


def write_arrays(path: Path | str, arrays: Mapping[str, object]) -> None:
    """Write arrays under their names.

    Args:
        path: The file.
        arrays: Numbers, flags or names.
    """
    plain = {name: np.asarray(value) for name, value in arrays.items()}
    bad = [name for name, value in plain.items() if value.dtype.kind not in "fiubU"]
    if bad:
        raise TypeError(f"neither numbers nor flags nor names: {', '.join(bad)}")
    with replacing(path) as beside, beside.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **plain)  # type: ignore[arg-type]


def read_arrays(path: Path | str, wanted: tuple[str, ...] = ()) -> dict[str, np.ndarray]:
    """Read all arrays of a file.

    Args:
        path: The file.
        wanted: Names that must be there.

    Raises:
        FileProblem: It is missing, no NPZ, damaged, or lacks a name.
    """
    try:
        with Path(path).open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except FileNotFoundError as error:
        raise FileProblem(path, "is not there") from error
    except (OSError, ValueError, EOFError, AttributeError, TypeError, zipfile.BadZipFile) as error:
        raise FileProblem(path, f"cannot be read as NPZ ({error})", "Write it again.") from error
    missing = [name for name in wanted if name not in arrays]
    if missing:
        raise FileProblem(path, f"lacks {', '.join(missing)}", f"It has {', '.join(arrays) or 'nothing'}.")
    return arrays


def write_motion(path: Path | str, motion: BodyMotion) -> None:
    """Write `motion.npz`: the fields of the motion under their own names."""
    write_arrays(path, motion.arrays())


def read_motion(path: Path | str) -> BodyMotion:
    """Read `motion.npz`.

    Args:
        path: The file.

    Raises:
        FileProblem: It lacks a key, or its arrays do not fit together.
    """
    names = tuple(field.name for field in fields(BodyMotion))
    arrays = read_arrays(path, names)
    try:
        fitted: dict[str, Any] = {name: arrays[name] for name in names}
        return BodyMotion(**fitted)
    except MareyError as error:
        raise FileProblem(path, str(error).rstrip(".")) from error


def write_skin(
    path: Path | str,
    vertices: Iterable[Floats],
    faces: Integers,
    seen: Iterable[Mask] | None = None,
    *,
    frames: int,
    count: int,
) -> None:
    """Write `skin.npz`, the posed skin, frame by frame: a long motion never stands in memory as a whole.

    Args:
        path: The file.
        vertices: For each frame (V, 3) in the world [m], NaN without an answer; written in single precision, whose
            step is a micrometre at ten metres.
        faces: (T, 3).
        seen: For each frame (V,) what was measured by some observation; nothing when None.
        frames: F, how many frames come.
        count: V.

    Raises:
        ValueError: Another number of frames came.
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
"""An array in pieces: its name, the pieces (some rows each), and the type and shape of the whole."""


def write_rows(path: Path | str, arrays: Iterable[ArrayRows]) -> None:
    """Write arrays that come in pieces, so that none of them ever stands in memory as a whole.

    Args:
        path: The file.
        arrays: One after the other.

    Raises:
        ValueError: The pieces have other rows than the whole shall have.
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
                raise ValueError(f"{name} came with rows of shape {np.shape(piece)[1:]} instead of {shape[1:]}")
            file.write(np.ascontiguousarray(piece, dtype=dtype).tobytes())
            written += len(np.atleast_1d(piece))
    wanted = shape[0] if shape else 1
    if written != wanted:
        raise ValueError(f"{name} came with {written} rows instead of {wanted}")
