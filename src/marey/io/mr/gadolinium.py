"""`markers.json`: positions of the gadolinium markers in the scanner, with names and bones added by hand."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from marey.arrays import Floats, freeze_fields
from marey.errors import FileProblem
from marey.io.atomic import replacing
from marey.io.documents import numbers, read_json_table
from marey.knee.markers.gadolinium import Gadolinium
from marey.knee.space.structures import BONES

FILE = "markers.json"
"""Name of the file in the folder of a segmented knee."""
_SAME_MM = 2.0
"""Names are kept for a marker that moved less than this distance between two runs [mm]. Chosen by hand."""
_ADDED = {"marker_names": "names", "marker_segment": "bones"}
"""Keys that a user adds by hand, with the fields of `MarkersInScanner`."""


@dataclass(frozen=True, eq=False, kw_only=True)
class MarkersInScanner:
    """The M markers of `markers.json`."""

    centres_mm: Floats
    """(M, 3) centres in LPS [mm]."""
    sd_mm: Floats
    """(M, 3) standard deviations of the centres [mm]."""
    diameter_mm: Floats | None = None
    """(M,) diameters [mm]; None where the file has none."""
    names: tuple[str | None, ...] = ()
    """(M,) label of each marker in the laboratory, None where unknown; empty where all are unknown."""
    bones: tuple[str | None, ...] = ()
    """(M,) bone that carries each marker (femur, tibia or patella), None where unknown; empty where all are unknown."""

    def __post_init__(self) -> None:
        freeze_fields(self, "centres_mm", "sd_mm")

    @staticmethod
    def of(found: Gadolinium) -> "MarkersInScanner":
        """Return the markers detected in a volume, without names."""
        return MarkersInScanner(
            centres_mm=found.centres_mm, sd_mm=found.centres_sd_mm, diameter_mm=found.diameter_mm
        )  # fmt: skip

    def named_as(self, earlier: "MarkersInScanner") -> "MarkersInScanner":
        """Return these markers with the names and bones of earlier markers within 2 mm."""
        apart = np.linalg.norm(self.centres_mm[:, None] - earlier.centres_mm[None], axis=2)
        nearest = [int(row.argmin()) if row.size and row.min() < _SAME_MM else None for row in apart]

        def kept(values: tuple[str | None, ...]) -> tuple[str | None, ...]:
            return tuple(None if n is None else values[n] for n in nearest) if values else ()

        return replace(self, names=kept(earlier.names), bones=kept(earlier.bones))


def write_markers(path: Path | str, markers: MarkersInScanner) -> None:
    """Write the markers; names and bones only if there are any."""
    table: dict[str, object] = {
        "unit": "mm",
        "marker_centres_lps_mm": np.round(markers.centres_mm, 4).tolist(),
        "marker_centres_sd_mm": np.round(markers.sd_mm, 4).tolist(),
    }
    if markers.diameter_mm is not None:
        table["marker_diameter_mm"] = np.round(markers.diameter_mm, 3).tolist()
    table |= {key: list(getattr(markers, field)) for key, field in _ADDED.items() if getattr(markers, field)}
    with replacing(path) as beside:
        beside.write_text(json.dumps(table, indent=1) + "\n", encoding="utf-8")


def read_markers(path: Path | str) -> MarkersInScanner:
    """Read the markers with the names and bones added by hand.

    Raises:
        FileProblem: The file is missing or damaged, or its lists are not of one length.
    """
    table = read_json_table(path, "`marey knee segment` writes it where it finds markers.")
    centres, sds = (_points(path, table, key) for key in ("marker_centres_lps_mm", "marker_centres_sd_mm"))
    diameters = numbers(table["marker_diameter_mm"], (len(centres),)) if "marker_diameter_mm" in table else None
    if "marker_diameter_mm" in table and diameters is None:
        wrong = f"has no list of {len(centres)} numbers, one for each marker, as marker_diameter_mm"
        raise FileProblem(path, wrong, "Correct or remove it.")
    if sds.shape != centres.shape or not np.isfinite(centres).all() or not (sds > 0).all():
        raise FileProblem(
            path, "has a marker without three coordinates and three standard deviations above 0",
            "Correct marker_centres_lps_mm and marker_centres_sd_mm.",
        )  # fmt: skip
    return MarkersInScanner(
        centres_mm=centres,
        sd_mm=sds,
        diameter_mm=diameters,
        names=_added(path, table, "marker_names", len(centres)),
        bones=_added(path, table, "marker_segment", len(centres)),
    )


def _points(path: Path | str, table: dict[str, Any], key: str) -> Floats:
    """Return a list of points (n, 3) of the table."""
    given = table.get(key)
    found = np.zeros((0, 3)) if given == [] else numbers(given, (-1, 3))
    if found is None:
        wrong = f"has no {key}, a list of points of three numbers each"
        raise FileProblem(path, wrong, "Correct it, or run `marey knee segment` again.")
    return found


def _added(path: Path | str, table: dict[str, Any], key: str, count: int) -> tuple[str | None, ...]:
    values = table.get(key) or []
    if not isinstance(values, list) or len(values) not in (0, count):
        raise FileProblem(
            path, f"does not have one entry of {key} for each of the {count} markers",
            "Write null for a marker that has none.",
        )  # fmt: skip
    if not all(value is None or isinstance(value, str) for value in values):
        raise FileProblem(path, f"has entries of {key} that are not texts", 'Write them as "name", or null.')
    strange = sorted({value for value in values if value is not None} - set(BONES))
    if key == "marker_segment" and strange:
        raise FileProblem(
            path, f"has a marker on an unknown bone ({', '.join(strange)})", f"The bones are {', '.join(BONES)}."
        )
    return tuple(values)
