"""`marey knee template`: a folder that `segment --template` and `register` take, from labels or from own outlines."""

from collections.abc import Sequence
from pathlib import Path

from marey.errors import FileProblem, MareyError, SettingProblem
from marey.io.mr.contours import OutlinedVolume, read_contours, same_grid
from marey.io.mr.meshes import write_mesh
from marey.io.mr.volumes import read_labels, read_volume, write_labels
from marey.io.stages import file_fingerprint
from marey.knee.bones.template import CheckedTemplate, checked_template
from marey.knee.outlines.contours import labels_of_contours
from marey.knee.space.volume import Labels
from marey.pipelines.progress import Progress
from marey.pipelines.run_record import StageCache, finished_together, write_record


def make_template(sources: Sequence[Path], out: Path, progress: Progress) -> CheckedTemplate:
    """Read labels or outlines, check them and write the template, all at once.

    Args:
        sources: One volume of labels, or the folder it is in; or files of outlines of one volume, and if wanted that
            volume, to be sure that they belong to it.
        out: The folder to make.
        progress: Is told.

    Raises:
        MareyError: A source cannot be used, several do not belong together, or there is no bone.
    """
    with progress.stage("Reading"):
        labels = _read(sources)
    with progress.stage("Surfaces and checks"):
        try:
            template = checked_template(labels)
        except FileProblem:
            raise
        except MareyError as error:
            raise FileProblem(sources[0], f"cannot be a template ({str(error).rstrip('.')})") from error
    files = _files(sources)
    with StageCache(out, [file_fingerprint(path) for path in files]), finished_together(out) as folder:
        write_labels(folder, template.labels)
        for name, surface in template.surfaces.items():
            write_mesh(folder / f"{name}.ply", surface)
        write_record(
            folder, command="knee template", settings={"side": template.side}, inputs=files,
            root=sources[0].parent, progress=progress,
        )  # fmt: skip
    for note in (*template.faults, *template.notes):
        progress.warn(note)
    return template


def _read(sources: Sequence[Path]) -> Labels:
    outlines = [path for path in sources if path.suffix.lower() == ".json"]
    others = [path for path in sources if path not in outlines]
    if not outlines:
        if len(others) != 1:
            raise SettingProblem(f"A template is made of one volume of labels, not of {len(others)}.")
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
            raise FileProblem(path, f"is not the volume that {outlines[0].name} was outlined in")
    return _filled(outlines[0], [each for _, each in found])


def _filled(path: Path, found: Sequence[OutlinedVolume]) -> Labels:
    try:
        return labels_of_contours([contour for each in found for contour in each.contours], found[0].grid)
    except MareyError as error:
        text = str(error).rstrip(".")
        raise FileProblem(path, f"cannot be filled ({text[0].lower() + text[1:]})") from error


def _files(sources: Sequence[Path]) -> list[Path]:
    """Name the files that were read; a folder of labels or slices stands for what is in it."""
    within = [sorted(path.iterdir()) if path.is_dir() else [path] for path in sources]
    return [file for files in within for file in files if file.is_file()]
