"""The files of a segmented knee."""

from pathlib import Path

from marey.io.mr import gadolinium
from marey.io.mr.meshes import write_mesh
from marey.io.mr.volumes import write_labels
from marey.pipelines.knee.cartilage import labels_with, write_cartilage
from marey.pipelines.knee.found_knee import FoundKnee
from marey.pipelines.knee.report import write_page
from marey.pipelines.progress import Progress
from marey.pipelines.run_details import RunDetails
from marey.pipelines.run_record import finished_together, write_record


def write_knee(found: FoundKnee, details: RunDetails, out: Path, progress: Progress) -> None:
    """Write all files at once: labels, surfaces, cartilage, markers, report and run.json.

    Args:
        found: The segmented knee.
        details: Settings and inputs of the run.
        out: The folder.
        progress: Progress reporter; its times and warnings are in the report.
    """
    labels = labels_with(found.bones, found.cartilage)
    with finished_together(out) as folder:
        write_labels(folder, labels, missing=found.missing)
        for name, surface in found.surfaces.items():
            write_mesh(folder / f"{name}.ply", surface)
        pictures = {}
        if found.cartilage is not None:
            pictures = write_cartilage(folder, found.cartilage, found.maps)
        if found.markers is not None:
            gadolinium.write_markers(folder / gadolinium.FILE, found.markers)
        write_page(folder, found, labels, progress, settings=details.settings, pictures=pictures)
        write_record(
            folder, command=details.command, settings=details.settings, inputs=details.inputs, root=details.root,
            progress=progress,
        )  # fmt: skip
