"""Reading of manually selected seeds: one seed per row, with its position in each camera."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.cameras.rig import Rig
from marey.errors import FileProblem
from marey.io.documents import read_rows


def read_seeds(path: Path | str, rig: Rig) -> Floats:
    """Read a table of seeds.

    Args:
        path: CSV with x and y for each camera in each row, in the order of `cameras.toml`, empty where unknown. Empty
            rows and rows without numbers (a header) are ignored.
        rig: All cameras of `cameras.toml`.

    Returns:
        (n, C, 2) positions [px]; NaN where unknown.

    Raises:
        FileProblem: It cannot be read, a row has another length or a value that is not a number, or a seed is outside
            the image; the message names the row.
    """
    try:
        with Path(path).open(newline="", encoding="utf-8-sig") as file:
            text = file.read()
    except (OSError, UnicodeDecodeError) as error:
        raise FileProblem(path, f"cannot be read ({error})", "Give a CSV file as seeds (--seeds).") from error
    delimiter = "," if "," in text or ";" not in text else ";"
    rows = [
        (number, _numbers(path, number, [cell.strip() for cell in row], rig))
        for number, row in enumerate(read_rows(path, text.splitlines(), _layout(rig), delimiter=delimiter), start=1)
        if any(cell.strip() for cell in row) and not _is_head(row)
    ]
    if not rows:
        raise FileProblem(path, "has no seed", _layout(rig))
    return np.stack([seed for _, seed in rows])


def _is_head(row: Sequence[str]) -> bool:
    return row[0].lstrip().startswith("#") or not any(map(_is_number, row))


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _numbers(path: Path | str, number: int, row: Sequence[str], rig: Rig) -> Floats:
    if len(row) != 2 * len(rig):
        raise FileProblem(path, f"has {len(row)} columns in row {number}", _layout(rig))
    wrong = [cell for cell in row if cell and not _is_number(cell)]
    if wrong:
        raise FileProblem(path, f"has '{wrong[0]}' in row {number} instead of a number", _layout(rig))
    seed = np.array([float(cell) if cell else np.nan for cell in row]).reshape(-1, 2)
    for camera, pixel in zip(rig, seed, strict=True):
        if np.isfinite(pixel).any() and not camera.sees(pixel):
            x, y = pixel
            wrong_place = f"has a seed in row {number} at ({x:g}, {y:g}), outside the image of '{camera.name}'"
            size = f"x should be from 0 to {camera.width - 1}, and y from 0 to {camera.height - 1}."
            raise FileProblem(path, wrong_place, size)
    return seed


def _layout(rig: Rig) -> str:
    head = ", ".join(f"{name} x, {name} y" for name in rig.names)
    return f"Each row should have {2 * len(rig)} cells: {head}; empty where unknown."
