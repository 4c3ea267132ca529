"""The page of `marey knee segment`: what was found, gathered for the report."""

from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np

from marey.io.mr.gadolinium import MarkersInScanner
from marey.knee.bones.bones import BoneSegmentation
from marey.knee.cartilage.knee_cartilage import KneeCartilage
from marey.knee.space.surface import Surface
from marey.knee.space.volume import Labels, Volume
from marey.pipelines.knee.cartilage import CartilageMaps, known_side
from marey.pipelines.progress import Progress
from marey.view.pages.knee_segment_report import FILE, SegmentReport, write_segment_report
from marey.view.pages.problems import readable


def write_page(
    folder: Path, volume: Volume, labels: Labels, bones: BoneSegmentation, surfaces: Mapping[str, Surface],
    progress: Progress, *, title: str, settings: Mapping[str, object], side: str | None = None,
    cartilage: KneeCartilage | None = None, maps: CartilageMaps | None = None, markers: MarkersInScanner | None = None,
    missing: Collection[str] = (),
) -> None:  # fmt: skip
    """Write report.html beside the other results.

    Args:
        folder: Where all that it names stands already.
        volume: The first image.
        labels: On its grid.
        bones: As they were found.
        surfaces: Theirs.
        progress: Knows timings and warnings.
        title: Of the page.
        settings: As in run.json.
        side: "left" or "right" where it was told.
        cartilage: Where some was found.
        maps: What was measured and drawn of it.
        markers: Where there are some.
        missing: Structures that were looked for and not found.
    """
    maps = maps or CartilageMaps()
    sheets = {} if cartilage is None else cartilage.sheets
    sheets = {bone: sheet for bone, sheet in sheets.items() if (sheet.thickness_mm > 0).any()}
    notes = list(progress.warnings)
    if missing:
        notes.append(f"Not found: {', '.join(map(readable, missing))}.")
    if settings.get("template") is None:
        notes.append("No template was given: only bones were looked for, no cartilage.")
    diameter = np.full(0 if markers is None else len(markers.centres_mm), np.nan)
    if markers is not None and markers.diameter_mm is not None:
        diameter = markers.diameter_mm
    with progress.stage("Page"):
        report = SegmentReport(
            title=title, volume=volume, labels=labels, bones=surfaces, kinds=bones.kinds,
            left=known_side(surfaces, side), side_given=side is not None, sheets=sheets, parts=maps.parts,
            flat=maps.pictures, marker_diameter_mm=diameter, notes=notes, timings=progress.timings,
            settings={name: _in_words(value) for name, value in settings.items()},
            files=[path.name for path in folder.iterdir()],
        )  # fmt: skip
        write_segment_report(folder / FILE, report)


def _in_words(value: object) -> object:
    """Write what a table cannot hold in one cell as a line: `femur 1.0, 2.0, 3.0; tibia 4.0, 5.0, 6.0`."""
    if not isinstance(value, Mapping):
        return value or None if isinstance(value, list) else value
    return "; ".join(f"{name} {_line(each)}" for name, each in value.items()) or None


def _line(value: object) -> str:
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)
