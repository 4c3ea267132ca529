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
from marey.motion.motion import Motion


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


def write_motion(path: Path | str, motion: Motion) -> None:
    """Write `motion.npz`: the fields of the motion under their own names."""
    write_arrays(path, motion.arrays())


def read_motion(path: Path | str) -> Motion:
    """Read `motion.npz`.

    Args:
        path: The file.

    Raises:
        FileProblem: It lacks a key, or its arrays do not fit together.
    """
    names = tuple(field.name for field in fields(Motion))
    arrays = read_arrays(path, names)
    try:
        fitted: dict[str, Any] = {name: arrays[name] for name in names}
        return Motion(**fitted)
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
    unseen = (np.zeros(count, bool) for _ in range(frames))
    with replacing(path) as beside, zipfile.ZipFile(beside, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        _write_rows(archive, "vertices", vertices, np.dtype("<f4"), (frames, count, 3))
        _write_rows(archive, "faces", faces, np.dtype("<i8"), (len(faces), 3))
        _write_rows(archive, "seen", unseen if seen is None else seen, np.dtype(bool), (frames, count))


def _write_rows(
    archive: zipfile.ZipFile, name: str, rows: Iterable[np.ndarray], dtype: np.dtype, shape: tuple[int, ...]
) -> None:
    """Write one array of an NPZ row by row."""
    written = 0
    with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
        head = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(file, head)
        for row in rows:
            file.write(np.ascontiguousarray(np.broadcast_to(row, shape[1:]), dtype=dtype).tobytes())
            written += 1
    if written != shape[0]:
        raise ValueError(f"{name} came with {written} rows instead of {shape[0]}")
