"""Bones from MR against the references of the recordings.

Names: dess, phantom_a, phantom_spl, phantom_spl_t1, phantom_spl+phantom_spl_t1 (two volumes), mese (no reference:
volumes only), falling_off (made images like mese's: bright marrow and fat, sagittal slices of 4 mm, and a coil whose
sensitivity falls off), varied (made knees of other people, see made_images.py), cut (images of one long bone only),
templates (each volume by every other person). `--seeds` is the number of the made ones. Dice, ASD and HD95 are those
of score/knee.py; dess in rows 60 to 400.
"""

import argparse
import json
import resource
import shutil
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy import sparse

from bench.common import program
from bench.declaration import Bench
from bench.knee.made_images import Make, made_knee
from bench.recording import Column, Run, Table
from marey.io.mr.meshes import write_mesh
from marey.io.mr.volumes import read_template, read_volume, simple_itk, write_labels, write_volume
from marey.knee.bones.bones import segment_bones
from marey.knee.space.resampling import part_of
from marey.knee.space.structures import LABELS
from marey.knee.space.surface import TriangleSurface
from marey.knee.space.surfacing import surface_of_field
from marey.knee.space.volume import Volume

BENCH = Bench(
    measures="Dice, ASD and HD95 of bones from magnetic resonance images, against references.",
    sources=("src/marey/knee/space", "src/marey/knee/bones", "src/marey/knee/registration"),
    minutes=6,
)
SHARED = ("dess", "phantom_a", "phantom_spl", "phantom_spl_t1")
NAMES = (*SHARED, "phantom_spl+phantom_spl_t1", "mese", "falling_off", "varied", "cut", "templates")
TEMPLATES = {"dess": "atlas", "phantom_a": "atlas", "mese": "atlas"}
PEOPLE = {"atlas": ("phantom_spl", "phantom_spl_t1"), "template_a": ("phantom_a",), "dess": ("dess",)}
"""Template to the volumes of the person whose labels it has."""


def volume_path(shared: Path, name: str) -> Path:
    folder = shared / "data" / "knee" / name
    return folder if name == "mese" else folder / "image.nii.gz"


def segment(volumes: list[Volume], template: Path | None, out: Path) -> dict[str, object]:
    started = time.perf_counter()
    found = segment_bones(volumes, template=None if template is None else read_template(template))
    write_labels(out, found.labels)
    volumes_cm3: dict[str, float] = {}
    faults: dict[str, str] = {}
    for bone, each in found.bones.items():
        surface = surface_of_field(each.distance_mm, each.grid)
        write_mesh(out / f"{bone}.ply", surface)
        volumes_cm3[bone] = round(surface.volume_mm3 / 1000, 1)
        if fault := surface_fault(surface):
            faults[bone] = fault
    seconds = round(time.perf_counter() - started, 1)
    cm3 = ", ".join(f"{bone} {volume:g}" for bone, volume in volumes_cm3.items())
    wrong = "; ".join(f"{bone}: {fault}" for bone, fault in faults.items())
    return {"cm3": cm3, "seconds": seconds, "faults": wrong or "none", "notes": " ".join(found.notes) or "none"}


def surface_fault(surface: TriangleSurface) -> str:
    """What is wrong with a surface, if anything."""
    edges = np.sort(surface.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    own, shared = np.unique(edges, axis=0, return_counts=True)
    count = len(surface.vertices_mm)
    links = sparse.coo_matrix((np.ones(len(own)), (own[:, 0], own[:, 1])), shape=(count, count))
    pieces = sparse.csgraph.connected_components(links, directed=False)[0]
    handles = pieces - (count - len(own) + len(surface.faces)) // 2
    faults = {"open": (shared != 2).any(), f"{pieces} pieces": pieces > 1, f"{handles} handles": handles > 0}
    faults["inward"] = surface.volume_mm3 <= 0
    return ", ".join(text for text, wrong in faults.items() if wrong)


def score(run: Run, truth: Path, out: Path, rows: tuple[str, ...] = ()) -> dict[str, str | None]:
    """Dice / ASD / HD95 of each bone."""
    scores = program.score(run, "knee.py", out / "labels.nii.gz", truth, *rows)
    values = {bone: scores.get(bone, scores.get(str(LABELS[bone]))) for bone in ("femur", "tibia", "patella")}
    return {bone: overlap(each) if each else None for bone, each in values.items()}


def overlap(values: dict[str, float]) -> str:
    """Three figures in one cell."""
    dice, asd, hd95 = values.values()
    return f"{dice:.3f} / {asd:.2f} / {hd95:.1f}"


def begin(run: Run, title: str) -> Table:
    """Begin a table of bones."""
    columns = [Column(f"{bone}: Dice / ASD [mm] / HD95 [mm]") for bone in ("femur", "tibia", "patella")]
    return run.table(
        title, ("volume", "template"), *columns, Column("volumes", "cm3"), Column("faults of the surfaces"),
        Column("notes of the program"), Column("time", "s", 0), Column("peak memory of the process", "GB", 1),
    )  # fmt: skip


def fill(table: Table, labels: tuple[str, str], figures: dict[str, object]) -> None:
    """Append a row."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    names = ("femur", "tibia", "patella", "cm3", "faults", "notes", "seconds")
    table.row(labels, *(figures.get(name) for name in names), peak)


def one(run: Run, table: Table, name: str, out: Path, template: Path | None) -> None:
    """Segment volumes of the recordings, and score them."""
    volumes = [read_volume(volume_path(run.shared, each)) for each in name.split("+")]
    figures = segment(volumes, template, out)
    if name != "mese":
        first = run.shared / "data" / "knee" / name.split("+")[0]
        truth = first / ("reference_labels.nii.gz" if name == "dess" else "truth_labels.nii.gz")
        figures |= score(run, truth, out, ("--rows", "60", "400") if name == "dess" else ())
    fill(table, (name, template.name if template else "none"), figures)


def by_every_template(run: Run) -> None:
    """Segment each volume with the labels of every other person."""
    table, out = begin(run, "Other people's labels as template"), run.out / "templates"
    for template, own in PEOPLE.items():
        folder = run.shared / "data" / "knee" / template
        if template == "dess":
            folder = dess_template(folder, out / "template" / "dess")
        for name in SHARED:
            if name not in own:
                one(run, table, name, out / f"{name}_by_{template}", folder)


def dess_template(dess: Path, folder: Path) -> Path:
    """Make a template of the reference of a real knee: bones, and cartilage where it is reliable."""
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copy(dess / "reference_labels.nii.gz", folder / "labels.nii.gz")
    labels = json.loads((dess / "reference_labels.json").read_text(encoding="utf-8"))["labels"]
    names = {value: name.split(" (")[0] for value, name in labels.items()}
    (folder / "labels.json").write_text(json.dumps({"labels": names}), encoding="utf-8")
    return folder


def cut(run: Run) -> None:
    """Segment what lies above the joint, and below it; Dice of the long bone in view, and of the patella."""
    shared, table = run.shared, begin(run, "Images of one long bone (Dice alone)")
    for name in ("phantom_spl", "dess"):
        truth = (
            shared / "data" / "knee" / name / ("reference_labels.nii.gz" if name == "dess" else "truth_labels.nii.gz")
        )
        itk = simple_itk()
        labels = itk.GetArrayFromImage(itk.ReadImage(str(truth)))
        volume = read_volume(volume_path(shared, name))
        k, j, i = np.meshgrid(*[np.arange(n) for n in volume.grid.shape], indexing="ij")
        height = volume.grid.lps(np.stack([i, j, k], axis=-1).astype(float))[..., 2]
        ends = np.percentile(height[labels == 1], 1), np.percentile(height[labels == 3], 99)
        for part, seen in (("above", height >= np.mean(ends) + 4), ("below", height <= np.mean(ends) - 2)):
            reach = [np.flatnonzero(seen.any(axis=axes)) for axes in ((1, 2), (0, 2), (0, 1))]
            box = tuple(slice(int(each[0]), int(each[-1]) + 1) for each in reach)
            image = Volume(intensity=volume.intensity[box], grid=part_of(volume.grid, box))
            folder = run.out / f"{name}_{part}"
            template = TEMPLATES.get(name, "template_a")
            figures = segment([image], shared / "data" / "knee" / template, folder)
            mine = itk.GetArrayFromImage(itk.ReadImage(str(folder / "labels.nii.gz")))
            for bone in ("femur", "tibia", "patella"):
                a, b = mine == LABELS[bone], labels[box] == LABELS[bone]
                figures[bone] = f"{2 * (a & b).sum() / max(1, a.sum() + b.sum()):.3f}"
            fill(table, (f"{name} {part} the joint", template), figures)


Plan = Callable[[int], dict[str, tuple[str, list[Make]]]]
"""By a seed: names, each with the template and what to make."""


def made(run: Run, title: str, seeds: int, plan: Plan) -> None:
    """Segment made knees of other people, each with the template of the source that it is not made of."""
    table = begin(run, title)
    for seed in range(1, seeds + 1):
        for name, (template, makes) in plan(seed).items():
            images = [made_knee(run.shared, make) for make in makes]
            folder = run.out / f"{title.replace(' ', '_')}_{name}_{seed}"
            figures = segment([volume for volume, _ in images], run.shared / "data" / "knee" / template, folder)
            write_volume(folder / "image.nii.gz", images[0][0])
            write_labels(folder / "truth", images[0][1])
            figures |= score(run, folder / "truth" / "labels.nii.gz", folder)
            fill(table, (f"{name}, seed {seed}", template), figures)


def variations(seed: int) -> dict[str, tuple[str, list[Make]]]:
    """What varies with the seed: the person, the side, the slices' direction, noise, bias, what is cut."""
    directions = ("sagittal", "axial", "coronal")
    fine = {"orientation": directions[seed % 3], "spacing_mm": (0.4, 0.4, 1.4), "mirror": seed % 2 == 0}
    person = Make(seed=seed, source="phantom_a", noise=1 + (seed == 2), bias=0.3 + 0.2 * (seed > 2), **fine)
    plain = Make(seed=seed, mirror=seed % 2 == 1, noise=1 + (seed == 2), cut_mm=(4.0 + 8 * (seed == 1), 4.0))
    bright = replace(plain, kind="bright")
    return {
        "a": ("atlas", [person]),
        "spl": ("template_a", [plain]),
        "spl_t1": ("template_a", [bright]),
        "spl+spl_t1": ("template_a", [plain, bright]),
    }


def falling_off(seed: int) -> dict[str, tuple[str, list[Make]]]:
    """Thick slices, bright marrow and a coil that sees half as much 70 mm from its middle."""
    slices = {"orientation": "sagittal", "spacing_mm": (0.625, 0.625, 4.0), "cut_mm": (12.0, 12.0)}
    return {"spl": ("template_a", [Make(kind="bright", seed=seed, mirror=seed % 2 == 1, fall_off=0.5, **slices)])}


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("names", nargs="*", help=f"of {', '.join(NAMES)}; the first six without any")
    parser.add_argument("--no-template", action="store_true", help="segment without a template")
    parser.add_argument("--seeds", type=int, default=1, help="number of made knees")


def run(run: Run) -> None:
    """Segment, and score."""
    given = run.arguments
    names = given.names or NAMES[:6]
    table = begin(run, "Bones") if set(names) & set(NAMES[:6]) else None
    for name in names:
        if name == "cut":
            cut(run)
        elif name in ("varied", "falling_off"):
            made(run, f"made knees, {name}", given.seeds, variations if name == "varied" else falling_off)
        elif name == "templates":
            by_every_template(run)
        elif table is not None:
            template = run.shared / "data" / "knee" / TEMPLATES.get(name, "template_a")
            out = run.out / "bones" / name.replace("+", "_and_")
            one(run, table, name, out, None if given.no_template else template)
