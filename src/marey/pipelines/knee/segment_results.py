"""The files of a segmented knee, with its report."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from marey.arrays import Image
from marey.io.mr import gadolinium
from marey.io.mr.meshes import write_mesh
from marey.io.mr.volumes import write_labels
from marey.knee.space.volume import Labels
from marey.pipelines.knee.cartilage import known_side, labels_with, write_cartilage
from marey.pipelines.knee.found_knee import FoundKnee
from marey.pipelines.progress import Progress
from marey.pipelines.run_details import RunDetails, page_head
from marey.pipelines.run_record import finished_together, write_record
from marey.view.pages.html import NO_HEAD, PageHead
from marey.view.pages.knee_segment_report import FILE, SegmentReport, write_segment_report
from marey.view.pages.problems import readable


def write_knee(found: FoundKnee, details: RunDetails, out: Path, progress: Progress) -> None:
    """Write all files at once: labels, surfaces, cartilage, markers, report and run.json.

    Args:
        found: The segmented knee.
        details: Settings and inputs of the run.
        out: The folder.
        progress: Progress reporter; its times and warnings are in the report.
    """
    labels = labels_with(found.bones, found.cartilage)
    with finished_together(out, inputs=details.inputs) as folder:
        write_labels(folder, labels, missing=found.missing)
        for name, surface in found.surfaces.items():
            write_mesh(folder / f"{name}.ply", surface)
        pictures = {}
        if found.cartilage is not None:
            pictures = write_cartilage(folder, found.cartilage, found.maps)
        if found.markers is not None:
            gadolinium.write_markers(folder / gadolinium.FILE, found.markers)
        head = page_head(details.command, details.verdict)
        write_page(folder, found, labels, progress, settings=details.settings, pictures=pictures, head=head)
        write_record(
            folder, command=details.command, settings=details.settings, inputs=details.inputs, root=details.root,
            progress=progress, verdict=details.verdict,
        )  # fmt: skip


def write_page(
    folder: Path, found: FoundKnee, labels: Labels, progress: Progress, *, settings: Mapping[str, object],
    pictures: Mapping[str, Image], head: PageHead = NO_HEAD,
) -> None:  # fmt: skip
    """Write report.html beside the other files.

    Args:
        folder: A folder with all files that the report names.
        found: The segmented knee.
        labels: Labels of bones and cartilage on the grid of the first image.
        progress: Progress reporter; its times and warnings are in the report.
        settings: Settings, as in run.json.
        pictures: Flat images by the name of the cartilage.
        head: What the head of the page states about the run.
    """
    sheets = {} if found.cartilage is None else found.cartilage.sheets
    sheets = {bone: sheet for bone, sheet in sheets.items() if (sheet.thickness_mm > 0).any()}
    notes = list(progress.warnings)
    if found.missing:
        notes.append(f"Not found: {', '.join(map(readable, found.missing))}.")
    if settings.get("template") is None:
        notes.append("No template was given: cartilage was not segmented.")
    diameter = np.full(0 if found.markers is None else len(found.markers.centres_mm), np.nan)
    if found.markers is not None and found.markers.diameter_mm is not None:
        diameter = found.markers.diameter_mm
    with progress.stage("Page"):
        report = SegmentReport(
            title=found.title, volume=found.volume, labels=labels, bones=found.surfaces, kinds=found.bones.kinds,
            left=known_side(found.surfaces, found.side), side_given=found.side is not None, sheets=sheets,
            parts=found.maps.parts, flat=pictures, marker_diameter_mm=diameter, notes=notes,
            timings=progress.timings, settings={name: _in_words(value) for name, value in settings.items()},
            files=[path.name for path in folder.iterdir()], head=head,
        )  # fmt: skip
        write_segment_report(folder / FILE, report)


def _in_words(value: object) -> object:
    """Write a mapping as one line for a cell of a table: `femur 1.0, 2.0, 3.0; tibia 4.0, 5.0, 6.0`."""
    if not isinstance(value, Mapping):
        return value or None if isinstance(value, list) else value
    return "; ".join(f"{name} {_line(each)}" for name, each in value.items()) or None


def _line(value: object) -> str:
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)
