"""`marey knee segment`: an MR volume's bones, and by a template their cartilage, as labels and surfaces."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from marey.arrays import Floats
from marey.errors import FileProblem, SettingProblem
from marey.io.mr import gadolinium
from marey.io.mr.gadolinium import MarkersInScanner
from marey.io.mr.meshes import write_mesh
from marey.io.mr.volumes import read_template, read_volume, write_labels
from marey.io.stages import file_fingerprint
from marey.knee.bones.bones import BoneSegmentation, segment_bones
from marey.knee.bones.template_fit import TemplateProblem
from marey.knee.cartilage.knee_cartilage import KneeCartilage
from marey.knee.space.structures import BONES
from marey.knee.space.surface import Surface
from marey.knee.space.surfacing import surface_of_field
from marey.knee.space.volume import Labels, Volume
from marey.pipelines.knee.cartilage import CartilageMaps, cartilage_by_template, labels_with, write_cartilage
from marey.pipelines.knee.markers import earlier_markers, markers_in
from marey.pipelines.knee.report import write_page
from marey.pipelines.progress import Progress
from marey.pipelines.run_record import StageCache, finished_together, write_record

_SAYS_NOTHING = ("image", "images", "volume", "scan", "series", "dicom", "mr", "mri", "data", "input")


@dataclass(frozen=True, eq=False, kw_only=True)
class SegmentOptions:
    """What `marey knee segment` is asked for."""

    out: Path | None
    template: Path | None
    seeds: tuple[tuple[str, float, float, float], ...]
    """Bone, and LPS [mm]."""
    seed_voxels: tuple[tuple[str, float, float, float], ...]
    """Bone, and the voxel i, j, k of the first volume."""
    side: str | None = None
    """"left" or "right"; None where the patella shall tell."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Segmented:
    """What `marey knee segment` left."""

    folder: Path
    missing: Mapping[str, str]
    """Structure that was asked for and not found, to the reason."""


def segment(paths: Sequence[Path], options: SegmentOptions, progress: Progress) -> Segmented:
    """Segment a knee and write what was found, all at once.

    Args:
        paths: One volume or two of the same knee.
        options: What is asked for.
        progress: Is told.

    Returns:
        The folder with the results, and what could not be found.

    Raises:
        MareyError: A file, setting or seed cannot be used, the results cannot be written, or no knee is found.
    """
    if options.side not in (None, "left", "right"):
        raise SettingProblem(f"--side is left or right, not '{options.side}'.")
    out = options.out or paths[0].with_name(f"{stem(paths[0])}_marey")
    with progress.stage("Reading"):
        volumes = [read_volume(path) for path in paths]
        template = None if options.template is None else read_template(options.template)
        earlier = earlier_markers(out)
    seeds = given_seeds(options, volumes[0])
    files = _files([*paths, *([options.template] if options.template else [])])
    # Made before the work: a folder that cannot be written to is told at once.
    cache = StageCache(out, [file_fingerprint(path) for path in files])
    try:
        with cache, threadpool_limits(1):
            found = _found(volumes, template, seeds, earlier, progress)
            with finished_together(out) as folder:
                settings, title = _settings(options, found), " and ".join(title_of(path) for path in paths)
                labels = labels_with(found.bones, found.cartilage)
                maps = _write(folder, found, labels, options, progress)
                write_page(
                    folder, volumes[0], labels, found.bones, found.surfaces, progress, title=title, settings=settings,
                    side=options.side, cartilage=found.cartilage, maps=maps, markers=found.markers,
                    missing=found.missing,
                )  # fmt: skip
                write_record(
                    folder, command="knee segment", settings=settings, inputs=files, root=paths[0].parent,
                    progress=progress,
                )  # fmt: skip
    except KeyboardInterrupt:
        cache.clear()
        raise
    except TemplateProblem as problem:
        raise _of_template(options.template or out, problem) from problem
    for name, surface in found.surfaces.items():
        progress.report(f"{name}: {surface.volume_mm3 / 1000:.1f} cm3, {surface.area_mm2 / 100:.0f} cm2")
    return Segmented(folder=out, missing=found.missing)


@dataclass(frozen=True, eq=False, kw_only=True)
class _Found:
    bones: BoneSegmentation
    surfaces: Mapping[str, Surface]
    cartilage: KneeCartilage | None
    markers: MarkersInScanner | None
    missing: Mapping[str, str]


def _found(
    volumes: Sequence[Volume], template: Labels | None, seeds: Mapping[str, Floats],
    earlier: MarkersInScanner | None, progress: Progress,
) -> _Found:  # fmt: skip
    bones = _segmented(volumes, template, seeds, progress)
    for note in bones.notes:
        progress.warn(note)
    surfaces = _surfaces(bones, progress)
    cartilage, missing = cartilage_by_template(volumes, bones, surfaces, template, progress)
    if cartilage is not None:
        # Where cartilage begins is seen better than where a bone alone ends.
        surfaces |= {bone: sheet.bone for bone, sheet in cartilage.sheets.items()}
    unfound = "It was not found in the image."
    lost = {bone: bones.missing.get(bone, unfound) for bone in BONES if bone not in bones.bones}
    markers = markers_in(volumes, surfaces, earlier, progress)
    return _Found(bones=bones, surfaces=surfaces, cartilage=cartilage, markers=markers, missing=lost | missing)


def _write(folder: Path, found: _Found, labels: Labels, options: SegmentOptions, progress: Progress) -> CartilageMaps:
    maps = CartilageMaps()
    write_labels(folder, labels, missing=found.missing)
    for name, surface in found.surfaces.items():
        write_mesh(folder / f"{name}.ply", surface)
    if found.cartilage is not None:
        maps = write_cartilage(folder, found.cartilage, found.surfaces, options.side, progress)
    if found.markers is not None:
        gadolinium.write_markers(folder / gadolinium.FILE, found.markers)
    return maps


def given_seeds(options: SegmentOptions, volume: Volume) -> dict[str, Floats]:
    """Bone to (3,) LPS [mm] of the seeds that were typed.

    Raises:
        SettingProblem: A bone's name is unknown, or it has two seeds.
    """
    places = [(name, np.array(place, dtype=float)) for name, *place in options.seeds]
    places += [(name, volume.grid.lps(np.array(voxel, dtype=float))) for name, *voxel in options.seed_voxels]
    seeds: dict[str, Floats] = {}
    for name, place in places:
        if name not in BONES:
            raise SettingProblem(f"'{name}' is no bone that can have a seed: they are {', '.join(BONES)}.")
        if name in seeds:
            raise SettingProblem(f"The {name} has two seeds: give one.")
        seeds[name] = place
    return seeds


def _segmented(
    volumes: Sequence[Volume], template: Labels | None, seeds: Mapping[str, Floats], progress: Progress
) -> BoneSegmentation:
    with progress.stage_of_steps("Bones") as begin:
        return segment_bones(volumes, template=template, seeds_mm=seeds, report=begin)


def _of_template(path: Path, problem: TemplateProblem) -> FileProblem:
    """Say of which folder a problem with the template is."""
    wrong, _, remedy = str(problem).removeprefix("The template ").partition(". ")
    return FileProblem(path, wrong.rstrip("."), remedy)


def _surfaces(bones: BoneSegmentation, progress: Progress) -> dict[str, Surface]:
    surfaces = {}
    with progress.stage("Surfaces", len(bones.bones)) as step:
        for name, bone in bones.bones.items():
            surfaces[name] = surface_of_field(bone.distance_mm, bone.grid)
            step()
    return surfaces


def _settings(options: SegmentOptions, found: _Found) -> dict[str, object]:
    bones, fit = found.bones, found.bones.template_fit
    return {
        "template": None if options.template is None else str(options.template),
        "template_mirrored": None if fit is None else fit.mirrored,
        "template_edges_on_edges": None if fit is None else round(fit.fit, 3),
        "marrow": list(bones.kinds),
        "seeds_lps_mm": {name: np.round(bone.seed_mm, 2).tolist() for name, bone in bones.bones.items()},
        "missing": dict(found.missing),
        "seeds_given": [name for name, *_ in (*options.seeds, *options.seed_voxels)],
    }


def _files(paths: Sequence[Path]) -> list[Path]:
    return [file for path in paths for file in (sorted(_within(path)) if path.is_dir() else [path])]


def _within(folder: Path) -> list[Path]:
    return [file for file in folder.iterdir() if file.is_file()]


def stem(path: Path) -> str:
    """Give a volume's name without the endings of its format."""
    name = path.resolve().name
    for ending in (".nii.gz", ".nii", ".nrrd", ".nhdr", ".mha", ".mhd", ".dcm"):
        if name.lower().endswith(ending):
            return name[: -len(ending)]
    return name


def title_of(path: Path) -> str:
    """Give the name by which a user knows a volume: its folder's, where its own says nothing ("image.nii.gz")."""
    name = stem(path)
    return path.resolve().parent.name or name if name.lower() in _SAYS_NOTHING else name


def parse_seed(text: str, option: str) -> tuple[str, float, float, float]:
    """Read a bone and three numbers: "femur 10 -3.5 20".

    Raises:
        SettingProblem: It is something else.
    """
    words = text.replace(",", " ").split()
    try:
        name, x, y, z = words
        return name, float(x), float(y), float(z)
    except ValueError as error:
        raise SettingProblem(
            f"{option} {text} is no bone and three numbers: {option} femur 10 -3.5 20, for one."
        ) from error
