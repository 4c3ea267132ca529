"""Segmentation of the bones of a knee in MR images, and of their cartilage by a template."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.errors import FileProblem, MareyError, SettingProblem
from marey.io.mr.gadolinium import MarkersInScanner
from marey.io.mr.volumes import read_template, read_volume
from marey.knee.bones.bones import BoneSegmentation, segment_bones
from marey.knee.bones.seeds import NoPairFound
from marey.knee.bones.template_fit import TemplateProblem
from marey.knee.space.structures import BONES
from marey.knee.space.surface import TriangleSurface
from marey.knee.space.surfacing import surface_of_field
from marey.knee.space.volume import Labels, Volume
from marey.pipelines.consistency.unusable import UnusableRun, with_unusable_page
from marey.pipelines.knee.cartilage import CartilageMaps, cartilage_by_template, cartilage_maps
from marey.pipelines.knee.found_knee import FoundKnee, knee_verdict
from marey.pipelines.knee.knee import COMMAND, Knee
from marey.pipelines.knee.markers import earlier_markers, markers_in
from marey.pipelines.progress import Progress, RecordingProgress
from marey.pipelines.run_details import RunDetails, checkpoints
from marey.pipelines.values import PathLike, issue_warnings
from marey.pipelines.verdict import NotUsable, Verdict, VerdictReason

_UNINFORMATIVE = ("image", "images", "volume", "scan", "series", "dicom", "mr", "mri", "data", "input")
"""Names of files that do not identify a volume; the name of their folder is used instead."""
_ENDINGS = (".nii.gz", ".nii", ".nrrd", ".nhdr", ".mha", ".mhd", ".dcm")
"""Endings of the formats of volumes."""
_NOT_FOUND = "It was not found in the image."
"""Why a bone is missing, if nothing more is known."""
_SHOWN = "Check that the image shows a knee with femur and tibia; a point in the marrow of each bone helps (--seed)."
"""What to do where no knee is found."""
_NO_BONES = (
    "No bone was segmented: the verdict states why. With another image, template or other seeds, run the command again."
)
"""What the page of a run without a result explains."""

Places = Mapping[str, Sequence[float]] | Iterable[tuple[str, float, float, float]]
"""A place of three numbers for each bone, by its name."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SegmentSettings:
    """How a knee is segmented.

    Raises:
        SettingProblem: A value is impossible, a bone's name is unknown, or a bone has two seeds.
    """

    seeds: tuple[tuple[str, float, float, float], ...] = ()
    """Bone, and a place in its marrow, LPS [mm]."""
    seed_voxels: tuple[tuple[str, float, float, float], ...] = ()
    """Bone, and a voxel (i, j, k) of the first volume in its marrow."""
    side: str | None = None
    """`left` or `right`; None if the place of the patella decides."""

    def __post_init__(self) -> None:
        if self.side not in (None, "left", "right"):
            raise SettingProblem(f"side (--side) is '{self.side}'; it should be left or right.")
        names = [name for name, *_ in (*self.seeds, *self.seed_voxels)]
        for name in names:
            if name not in BONES:
                raise SettingProblem(f"A seed is for '{name}', which is not one of the bones {', '.join(BONES)}.")
            if names.count(name) > 1:
                raise SettingProblem(f"The {name} has two seeds: give one.")

    def seeds_mm(self, volume: Volume) -> dict[str, Floats]:
        """Return the seeds (3,) as LPS [mm], by bone.

        Args:
            volume: The first volume.

        Raises:
            SettingProblem: A seed lies outside the volume.
        """
        places = {name: np.array(place, dtype=float) for name, *place in self.seeds}
        voxels = {name: volume.grid.voxels(place) for name, place in places.items()}
        voxels |= {name: np.array(voxel, dtype=float) for name, *voxel in self.seed_voxels}
        counts = np.array(volume.grid.shape[::-1])
        for name, voxel in voxels.items():
            if not ((voxel >= -0.5) & (voxel < counts - 0.5)).all():
                option = "--seed" if name in places else "--seed-voxel"
                low, high = (", ".join(f"{at:.0f}" for at in volume.grid.lps(end)) for end in (0 * counts, counts - 1))
                raise SettingProblem(
                    f"The seed of the {name} ({option}) lies outside the image, which has "
                    f"{' x '.join(map(str, counts))} voxels and reaches from ({low}) to ({high}) mm."
                )
        return places | {name: volume.grid.lps(voxel) for name, voxel in voxels.items() if name not in places}


def segment_knee(
    volumes: PathLike | Volume | Sequence[PathLike | Volume],
    *,
    template: PathLike | Labels | None = None,
    seeds: Places = (),
    seed_voxels: Places = (),
    side: str | None = None,
    out: PathLike | None = None,
    progress: Progress | None = None,
) -> Knee:
    """Segment femur, tibia and patella in an MR volume, and their cartilage if a template is given.

    Args:
        volumes: One volume, or two of the same knee in the same place, with and without fat suppression; each is a
            file, a folder with a DICOM series, or a `Volume`.
        template: Labels of another knee, of either side: a folder, or `Labels`.
        seeds: A point in the marrow of each bone by the bone's name, LPS [mm]; missing seeds are found automatically.
        seed_voxels: The same points as voxel indices (i, j, k) of the first volume.
        side: `left` or `right`, for medial and lateral parts; by default the position of the patella decides.
        out: Folder for the results. If it is given, the files of `marey knee segment` are written there; otherwise
            nothing is written.
        progress: Progress reporter; by default nothing is shown, and the warnings of the run are issued as Python
            warnings of the category `marey.MareyWarning`.

    Returns:
        The knee; structures that were not found are in `missing`.

    Raises:
        FileProblem: A file cannot be used.
        SettingProblem: A seed or another value is impossible.
        NotUsable: No knee is found.

    Example:
        >>> import marey
        >>> knee = marey.segment_knee("knee.nii.gz", side="left")
        >>> knee.missing
        {}
    """
    settings = SegmentSettings(seeds=_places(seeds), seed_voxels=_places(seed_voxels), side=side)
    reporter = RecordingProgress() if progress is None else progress
    given = [volumes] if isinstance(volumes, str | Path | Volume) else list(volumes)
    folder = None if out is None else Path(out)
    with reporter.stage("Reading"):
        images = [each if isinstance(each, Volume) else read_volume(each) for each in given]
        labels = template if isinstance(template, Labels) or template is None else read_template(template)
        earlier = None if folder is None else earlier_markers(folder)
    sources = [Path(each) for each in (*given, template) if isinstance(each, str | Path)]
    title = " and ".join(title_of(Path(each)) for each in given if isinstance(each, str | Path)) or "knee"
    name, files = sources[0].name if sources else title, _files(sources)
    # Opened before the work, so that a folder that cannot be written to is an error at once.
    with checkpoints(folder, files, results=("report.html",)) as cache:
        try:
            described = partial(_unusable, settings, template, title, files)
            with with_unusable_page(folder, described, reporter), _expecting_knee(name):
                found = _found(images, labels, settings, title, earlier, reporter)
            knee = Knee.of(found, _details(settings, template, found, files, reporter))
            if folder is not None:
                knee.save(folder, progress=reporter)
        except KeyboardInterrupt:
            cache.clear()
            raise
        except TemplateProblem as problem:
            raise _of_template(template, problem) from problem
    if progress is None:
        issue_warnings(reporter)
    return knee


def _places(places: Places) -> tuple[tuple[str, float, float, float], ...]:
    listed = [(name, *place) for name, place in places.items()] if isinstance(places, Mapping) else list(places)
    return tuple((str(name), float(x), float(y), float(z)) for name, x, y, z in listed)


@contextmanager
def _expecting_knee(name: str) -> Iterator[None]:
    """End with a verdict if the images of a name show no knee.

    Raises:
        NotUsable: They show none.
    """
    try:
        yield
    except MareyError as problem:
        if not isinstance(problem, NoPairFound) and type(problem) is not MareyError:
            raise  # It is about a file or a setting, and not about what the images show.
        what = f"{name}: {str(problem).rstrip('.')}."
        raise NotUsable(Verdict.of([VerdictReason.failure(what, _SHOWN, cause="no knee")])) from problem


def _found(
    volumes: Sequence[Volume], template: Labels | None, settings: SegmentSettings, title: str,
    earlier: MarkersInScanner | None, progress: Progress,
) -> FoundKnee:  # fmt: skip
    bones = _segmented(volumes, template, settings.seeds_mm(volumes[0]), progress)
    for note in bones.notes:
        progress.warn(note)
    surfaces = _surfaces(bones, progress)
    cartilage, missing = cartilage_by_template(volumes, bones, surfaces, template, progress)
    if cartilage is not None:
        # The edge between bone and cartilage is seen better than the edge of a bone alone.
        surfaces |= {bone: sheet.bone for bone, sheet in cartilage.sheets.items()}
    lost = {bone: bones.missing.get(bone, _NOT_FOUND) for bone in BONES if bone not in bones.bones}
    markers = markers_in(volumes, surfaces, earlier, progress)
    maps = CartilageMaps()
    if cartilage is not None:
        maps = cartilage_maps(cartilage, surfaces, settings.side, progress)
    return FoundKnee(
        title=title, volume=volumes[0], bones=bones, surfaces=surfaces, cartilage=cartilage, maps=maps,
        markers=markers, missing=lost | missing, side=settings.side,
    )  # fmt: skip


def _segmented(
    volumes: Sequence[Volume], template: Labels | None, seeds: Mapping[str, Floats], progress: Progress
) -> BoneSegmentation:
    with progress.stage_of_steps("Bones") as begin:
        return segment_bones(volumes, template=template, seeds_mm=seeds, report=begin)


def _of_template(template: PathLike | Labels | None, problem: TemplateProblem) -> FileProblem:
    """Return the error of a template with the name of its folder."""
    path = template if isinstance(template, str | Path) else "template"
    wrong, _, remedy = str(problem).removeprefix("The template ").partition(". ")
    return FileProblem(path, wrong.rstrip("."), remedy)


def _unusable(
    settings: SegmentSettings, template: PathLike | Labels | None, title: str, files: Sequence[Path], verdict: Verdict
) -> UnusableRun:
    """Describe a run that found no knee."""
    about = {name: value for name, value in vars(settings).items() if value not in (None, ())}
    if template is not None:
        about["template"] = _name_of(template)
    return UnusableRun(
        command=COMMAND, kind="Bones and cartilage of a knee", title=title, page="report.html", happened=_NO_BONES,
        settings=about, inputs=files, root=files[0].parent if files else Path(), verdict=verdict,
    )  # fmt: skip


def _name_of(template: PathLike | Labels) -> str:
    return str(template) if isinstance(template, str | Path) else "given"


def _surfaces(bones: BoneSegmentation, progress: Progress) -> dict[str, TriangleSurface]:
    surfaces = {}
    with progress.stage("Surfaces", len(bones.bones)) as step:
        for name, bone in bones.bones.items():
            surfaces[name] = surface_of_field(bone.distance_mm, bone.grid)
            step()
    return surfaces


def _details(
    settings: SegmentSettings, template: PathLike | Labels | None, found: FoundKnee, files: Sequence[Path],
    progress: Progress,
) -> RunDetails:  # fmt: skip
    bones, fit = found.bones, found.bones.template_fit
    about: dict[str, object] = {
        "template": None if template is None else _name_of(template),
        "template_mirrored": None if fit is None else fit.mirrored,
        "template_edges_on_edges": None if fit is None else round(fit.fit, 3),
        "marrow": list(bones.kinds),
        "seeds_lps_mm": {name: np.round(bone.seed_mm, 2).tolist() for name, bone in bones.bones.items()},
        "missing": dict(found.missing),
        "seeds_given": [name for name, *_ in (*settings.seeds, *settings.seed_voxels)],
    }
    if settings.side is not None:
        about["side"] = settings.side
    root = files[0].parent if files else Path()
    return RunDetails.of(COMMAND, about, files, root, progress, verdict=knee_verdict(found))


def _files(paths: Sequence[Path]) -> list[Path]:
    """Return the files, and the files in the folders."""
    within = [sorted(file for file in path.iterdir() if file.is_file()) if path.is_dir() else [path] for path in paths]
    return [file for files in within for file in files]


def stem(path: Path) -> str:
    """Return the name of a volume without the ending of its format.

    Args:
        path: A file, or a folder with a DICOM series.
    """
    name = path.resolve().name
    for ending in _ENDINGS:
        if name.lower().endswith(ending):
            return name[: -len(ending)]
    return name


def title_of(path: Path) -> str:
    """Return the name by which a user knows a volume: that of its folder, if its own is uninformative ("image.nii.gz").

    Args:
        path: A file, or a folder with a DICOM series.
    """
    name = stem(path)
    return path.resolve().parent.name or name if name.lower() in _UNINFORMATIVE else name
