"""`cartilage.csv`: the parts of each cartilage as a table."""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path

from marey.io.atomic import replacing
from marey.knee.subregions import Subregion

_HEAD = ("cartilage", "part", "area_mm2", "volume_mm3", "mean_mm", "thickest_mm", "covered_percent")


def write_parts(path: Path | str, parts: Mapping[str, Sequence[Subregion]]) -> None:
    """Write a row for each part of each cartilage.

    Args:
        path: The file.
        parts: By the cartilage's name.
    """
    with replacing(path) as beside, beside.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(_HEAD)
        for cartilage, found in parts.items():
            for part in found:
                numbers = (part.area_mm2, part.volume_mm3, part.mean_mm, part.thickest_mm, 100 * part.covered)
                writer.writerow([cartilage, part.name, *(f"{number:.3f}" for number in numbers)])
