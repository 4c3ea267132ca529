"""Templates of a knee for segmentation and registration, from labels or from outlines."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from marey.errors import FileProblem, MareyError, SettingProblem
from marey.io.mr.contours import OutlinedVolume, read_contours, same_grid
from marey.io.mr.meshes import write_mesh
from marey.io.mr.volumes import read_labels, read_volume, write_labels
from marey.knee.bones.template import CheckedTemplate, checked_template
from marey.knee.outlines.contours import labels_of_contours
from marey.knee.space.volume import Labels
from marey.pipelines.labelled import Described, Summary
from marey.pipelines.progress import Progress, RecordingProgress
from marey.pipelines.run_details import RunDetails
from marey.pipelines.run_record import finished_together, write_record
from marey.pipelines.values import PathLike, path_tuple
from marey.pipelines.verdict import Verdict, VerdictReason

COMMAND = "knee template"
"""The command that writes the same files."""
TEMPLATE_RESULTS = ("labels.nii.gz", "labels.json")
"""Files that every run writes, whose names are checked before the work."""


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class MadeTemplate(Described):
    """A template that was made from labels or outlines."""

    template: CheckedTemplate
    """Labels, surfaces and side of the knee."""
    details: RunDetails
    """Inputs, warnings and times of the run."""

    def summary(self) -> Summary:
        """Return the side of the knee and its structures."""
        return Summary(
            "Template of a knee",
            {"side": self.template.side or "unknown", "structures": ", ".join(self.template.surfaces)},
        )

    def save(self, folder: Path | str, *, progress: Progress | None = None) -> Path:
        """Write labels, surfaces and run.json all at once.

        Args:
            folder: Folder for the files; it is created if it does not exist.
            progress: Progress reporter.

        Returns:
            The folder.
        """
        details, out = self.details, Path(folder)
        with finished_together(out, inputs=details.inputs) as staging:
            write_labels(staging, self.template.labels)
            for name, surface in self.template.surfaces.items():
                write_mesh(staging / f"{name}.ply", surface)
            write_record(
                staging, command=COMMAND, settings=details.settings, inputs=details.inputs, root=details.root,
                progress=progress or details.resumed_progress(), verdict=details.verdict,
            )  # fmt: skip
        return out


def make_template(sources: Sequence[PathLike], *, progress: Progress | None = None) -> MadeTemplate:
    """Read labels or outlines of a knee, and check whether they can be a template.

    Args:
        sources: One volume of labels, or the folder with it; or files of outlines of one volume, optionally with that
            volume, which is then compared with the outlines.
        progress: Progress reporter.

    Raises:
        MareyError: A source cannot be used, several do not fit each other, or there is no bone.
    """
    progress, paths = progress or RecordingProgress(), path_tuple(sources)
    with progress.stage("Reading"):
        labels = _read(paths)
    with progress.stage("Surfaces and checks"):
        try:
            template = checked_template(labels)
        except FileProblem:
            raise
        except MareyError as error:
            wrong = f"cannot be a template ({str(error).rstrip('.')})"
            raise FileProblem(paths[0], wrong, "Correct its labels or outlines.") from error
    files, root = _files(paths), paths[0].parent
    reasons = [*map(VerdictReason.failure, template.faults), *map(VerdictReason.limit, template.notes)]
    details = RunDetails.of(
        COMMAND, {"side": template.side}, files, root, progress, verdict=Verdict.of(reasons)
    )  # fmt: skip
    for note in (*template.faults, *template.notes):
        progress.warn(note)
    return MadeTemplate(template=template, details=replace(details, warnings=tuple(progress.warnings)))


def _read(sources: Sequence[Path]) -> Labels:
    outlines = [path for path in sources if path.suffix.lower() == ".json"]
    others = [path for path in sources if path not in outlines]
    if not outlines:
        if len(others) != 1:
            raise SettingProblem(f"A template needs one volume of labels; {len(others)} were given.")
        return read_labels(others[0])
    found = [(path, read_contours(path)) for path in outlines]
    grid = found[0][1].grid
    for path, each in found[1:]:
        if not same_grid(each.grid, grid):
            raise FileProblem(
                path, f"belongs to another volume than {outlines[0].name}", "Give outlines of one volume."
            )
    for path in others:
        if not same_grid(read_volume(path).grid, grid):
            wrong = f"is not the volume of the outlines {outlines[0].name}"
            raise FileProblem(path, wrong, "Give the volume that was outlined.")
    return _filled(outlines[0], [each for _, each in found])


def _filled(path: Path, found: Sequence[OutlinedVolume]) -> Labels:
    try:
        return labels_of_contours([contour for each in found for contour in each.contours], found[0].grid)
    except MareyError as error:
        text = str(error).rstrip(".")
        raise FileProblem(path, f"cannot be filled ({text[0].lower() + text[1:]})") from error


def _files(sources: Sequence[Path]) -> list[Path]:
    """Return the files that were read, and the files in the folders."""
    within = [sorted(path.iterdir()) if path.is_dir() else [path] for path in sources]
    return [file for files in within for file in files if file.is_file()]
