"""Small result files of a knee: `cartilage.csv`, one row per region, and `rigid.json`, a bone's registration."""

import csv
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.errors import FileProblem
from marey.io.atomic import replacing
from marey.knee.cartilage.subregions import Subregion


def write_rigid(path: Path | str, subject_from_template: Floats, about: Mapping[str, object]) -> None:
    """Write a homogeneous matrix (4, 4) [mm] with further named values."""
    table = {"subject_from_template": np.asarray(subject_from_template).tolist(), **about}
    with replacing(path) as beside:
        beside.write_text(json.dumps(table, indent=1) + "\n", encoding="utf-8")


_HEAD = ("cartilage", "part", "area_mm2", "volume_mm3", "mean_mm", "thickest_mm", "covered_percent")
"""Columns of `cartilage.csv`, in their order."""


def write_parts(path: Path | str, parts: Mapping[str, Sequence[Subregion]]) -> None:
    """Write `cartilage.csv`, one row per region of each cartilage.

    Args:
        path: The file.
        parts: Regions by the name of the cartilage.
    """
    with replacing(path) as beside, beside.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(_HEAD)
        for cartilage, found in parts.items():
            for part in found:
                numbers = (part.area_mm2, part.volume_mm3, part.mean_mm, part.thickest_mm, 100 * part.covered)
                writer.writerow([cartilage, part.name, *(f"{number:.3f}" for number in numbers)])


def read_parts(path: Path | str) -> dict[str, list[Subregion]]:
    """Read `cartilage.csv` as written by `write_parts`.

    Args:
        path: The file.

    Returns:
        The regions by the name of the cartilage.

    Raises:
        FileProblem: The file is missing or damaged.
    """
    parts: dict[str, list[Subregion]] = {}
    try:
        with Path(path).open(newline="", encoding="utf-8") as file:
            for row in csv.DictReader(file):
                area, volume, mean, thickest, covered = (float(row[name]) for name in _HEAD[2:])
                parts.setdefault(row["cartilage"], []).append(
                    Subregion(
                        name=row["part"], area_mm2=area, volume_mm3=volume, mean_mm=mean, thickest_mm=thickest,
                        covered=covered / 100,
                    )
                )  # fmt: skip
    except (OSError, KeyError, TypeError, ValueError, csv.Error) as error:
        raise FileProblem(path, f"cannot be read ({error})", "Run `marey knee segment` again.") from error
    return parts
