"""Bones from MR against the shared references: `python bench/knee_bones.py SHARED OUT [NAME ...] [--no-template]`.

Each NAME is segmented, its labels and surfaces go to OUT/NAME, and Dice, ASD and HD95 of the bones are printed as
../shared/score/knee.py counts them, with the time, the memory, and whether the surfaces are closed, in one piece and
without handles. Names: dess, phantom_a, phantom_spl, phantom_spl_t1, phantom_spl+phantom_spl_t1 (two volumes), mese (no
reference: volumes only), falling_off (made images like mese's: bright marrow and fat, sagittal slices of 4 mm, and a
coil whose sensitivity falls away), varied (made knees of other people, see made_knee_images.py), cut (images of one
long bone only), templates (each volume by every other person). Of the made ones `--seeds` says how many.
"""

import argparse
import json
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from made_knee_images import Make, made_knee
from scipy import sparse
from threadpoolctl import threadpool_limits

from marey.io.mr.meshes import write_mesh
from marey.io.mr.volumes import read_template, read_volume, simple_itk, write_labels, write_volume
from marey.knee.bones.bones import segment_bones
from marey.knee.bones.surfacing import surface_of_field
from marey.knee.space.resampling import part_of
from marey.knee.space.structures import LABELS
from marey.knee.space.surface import Surface
from marey.knee.space.volume import Volume

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
    told = {"marrow": found.kinds, "cm3": volumes_cm3, "seconds": seconds, "notes": found.notes}
    return told | {"surfaces": faults or "closed, one piece each, no handle, outward"}


def surface_fault(surface: Surface) -> str:
    """Say what is wrong with a surface, if anything."""
    edges = np.sort(surface.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    own, shared = np.unique(edges, axis=0, return_counts=True)
    count = len(surface.vertices_mm)
    links = sparse.coo_matrix((np.ones(len(own)), (own[:, 0], own[:, 1])), shape=(count, count))
    pieces = sparse.csgraph.connected_components(links, directed=False)[0]
    handles = pieces - (count - len(own) + len(surface.faces)) // 2
    faults = {"open": (shared != 2).any(), f"{pieces} pieces": pieces > 1, f"{handles} handles": handles > 0}
    faults["inward"] = surface.volume_mm3 <= 0
    return ", ".join(text for text, wrong in faults.items() if wrong)


def score(shared: Path, truth: Path, out: Path, rows: list[str]) -> dict[str, object]:
    script = [sys.executable, str(shared / "score" / "knee.py"), str(out / "labels.nii.gz"), str(truth), *rows]
    told = json.loads(subprocess.run(script, check=True, capture_output=True, text=True).stdout)
    values = {bone: told.get(bone, told.get(str(LABELS[bone]))) for bone in ("femur", "tibia", "patella")}
    return {bone: [*each.values()] if each else None for bone, each in values.items()}


def one(shared: Path, name: str, out: Path, template: Path | None) -> None:
    """Segment shared volumes and score them."""
    volumes = [read_volume(volume_path(shared, each)) for each in name.split("+")]
    told = segment(volumes, template, out)
    if name != "mese":
        first = shared / "data" / "knee" / name.split("+")[0]
        truth = first / ("reference_labels.nii.gz" if name == "dess" else "truth_labels.nii.gz")
        told |= score(shared, truth, out, ["--rows", "60", "400"] if name == "dess" else [])
    said(f"{name} by {template.name if template else 'no template'}", told)


def by_every_template(shared: Path, out: Path) -> None:
    """Segment each volume with the labels of every other person."""
    for template, own in PEOPLE.items():
        folder = shared / "data" / "knee" / template
        if template == "dess":
            folder = dess_template(folder, out / "template" / "dess")
        for name in SHARED:
            if name not in own:
                one(shared, name, out / f"{name}_by_{template}", folder)


def dess_template(dess: Path, folder: Path) -> Path:
    """Make a template of the reference of a real knee: bones, and cartilage where it is trusted."""
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copy(dess / "reference_labels.nii.gz", folder / "labels.nii.gz")
    labels = json.loads((dess / "reference_labels.json").read_text(encoding="utf-8"))["labels"]
    names = {value: name.split(" (")[0] for value, name in labels.items()}
    (folder / "labels.json").write_text(json.dumps({"labels": names}), encoding="utf-8")
    return folder


def cut(shared: Path, out: Path) -> None:
    """Segment what lies above the joint, and below it; print Dice of the long bone in view, and of the patella."""
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
            folder = out / f"{name}_{part}"
            told = segment([image], shared / "data" / "knee" / TEMPLATES.get(name, "template_a"), folder)
            mine = itk.GetArrayFromImage(itk.ReadImage(str(folder / "labels.nii.gz")))
            for bone in ("femur", "tibia", "patella"):
                a, b = mine == LABELS[bone], labels[box] == LABELS[bone]
                told[bone] = round(float(2 * (a & b).sum() / max(1, a.sum() + b.sum())), 3)
            said(f"{name} {part} the joint", told)


Plan = Callable[[int], dict[str, tuple[str, list[Make]]]]
"""By a seed: names, each with the template and what to make."""


def made(shared: Path, out: Path, seeds: int, plan: Plan) -> None:
    """Segment made knees of other people, each with the template of the source that it is not made of."""
    for seed in range(1, seeds + 1):
        for name, (template, makes) in plan(seed).items():
            images = [made_knee(shared, make) for make in makes]
            folder = out / f"{name}_{seed}"
            told = segment([volume for volume, _ in images], shared / "data" / "knee" / template, folder)
            write_volume(folder / "image.nii.gz", images[0][0])
            write_labels(folder / "truth", images[0][1])
            told |= score(shared, folder / "truth" / "labels.nii.gz", folder, [])
            said(f"{name} {seed}", told)


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


def said(name: str, told: dict[str, object]) -> None:
    told["peak_gb"] = round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6, 2)
    print(name, json.dumps(told), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("shared", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("names", nargs="*", default=NAMES)
    parser.add_argument("--no-template", action="store_true")
    parser.add_argument("--seeds", type=int, default=1)
    asked = parser.parse_args()
    for name in asked.names:
        with threadpool_limits(1):
            if name == "cut":
                cut(asked.shared, asked.out / "cut")
            elif name in ("varied", "falling_off"):
                made(asked.shared, asked.out / name, asked.seeds, variations if name == "varied" else falling_off)
            elif name == "templates":
                by_every_template(asked.shared, asked.out / "templates")
            else:
                template = asked.shared / "data" / "knee" / TEMPLATES.get(name, "template_a")
                out = asked.out / name.replace("+", "_and_")
                one(asked.shared, name, out, None if asked.no_template else template)


if __name__ == "__main__":
    main()
