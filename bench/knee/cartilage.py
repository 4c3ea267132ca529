"""Cartilage by another knee's template in the simulated volumes, on the true bones or on those `segment` found.

    python bench/knee_cartilage.py SHARED [CASE] [--segmented DIR]

SHARED holds `data/knee`. CASE: phantom_a (template: atlas), phantom_spl, phantom_spl_t1, or pair (both of them;
template: template_a); without one, all. Without --segmented the inner surface is that of the true labels, so that
cartilage alone is judged; with it, DIR is what `marey knee segment` left of that case, bones and cartilage. Prints one
JSON line a bone: Dice of the cartilage's voxels, mean thickness less the true one over the true cartilage (bare counts
as 0), mean absolute difference of the maps where both have cartilage, shares of covered vertices found and of bare ones
falsely covered, and of those found with a confidence above 0.5 the share whose 95 % interval holds the truth. Without
--segmented first a line of the share of each cartilage over which the image tells more of it than the template. True
thickness is that of surfaces of the fine true labels, at the vertices of the true bone.
"""

import argparse
import json
import tempfile
import time
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree
from threadpoolctl import threadpool_limits

from marey.arrays import Floats
from marey.io.mr.meshes import read_mesh
from marey.io.mr.volumes import read_labels, read_volume
from marey.io.npz import read_arrays
from marey.knee.bones.surfacing import surface_of_labels
from marey.knee.cartilage.knee_cartilage import find_knee_cartilage, knee_template, seen_share
from marey.knee.cartilage.labels import with_cartilage
from marey.knee.cartilage.thickness import cartilage_thickness
from marey.knee.space.structures import BONES, CARTILAGE_OF_BONE, LABELS
from marey.knee.space.surface import Surface
from marey.knee.space.volume import Labels

CASES = {
    "phantom_a": (("phantom_a",), "atlas"),
    "phantom_spl": (("phantom_spl",), "template_a"),
    "phantom_spl_t1": (("phantom_spl_t1",), "template_a"),
    "pair": (("phantom_spl", "phantom_spl_t1"), "template_a"),
}


def true_labels(shared: Path, name: str, kind: str) -> Labels:
    """The truth's names stand in truth.json; `read_labels` wants them beside the volume."""
    folder = shared / "data" / "knee" / name
    names = json.loads((folder / "truth.json").read_text())["labels"]
    with tempfile.TemporaryDirectory() as beside:
        (Path(beside) / "labels.json").write_text(json.dumps({"labels": names}))
        (Path(beside) / "labels.nii.gz").symlink_to(folder / f"{kind}.nii.gz")
        return read_labels(beside)


def surfaces_of(labels: Labels) -> dict[str, Surface]:
    held = [name for name in LABELS if labels.mask(name).any()]
    return {name: surface_of_labels(labels, name) for name in held}


def found_here(shared: Path, case: str, truth: Labels, bones: dict[str, Surface]):
    """Labels and the thickness at the true bones' vertices, with the true bones."""
    names, template = CASES[case]
    volumes = [read_volume(shared / "data" / "knee" / name / "image.nii.gz") for name in names]
    model = knee_template(surfaces_of(read_labels(shared / "data" / "knee" / template)), mirror=True)
    found = find_knee_cartilage(volumes, bones, model)
    labels = with_cartilage(truth, found.sheets)
    shares = {CARTILAGE_OF_BONE[bone]: round(seen_share(sheet), 2) for bone, sheet in found.sheets.items()}
    print(json.dumps({"case": case, "told_by_image": shares, "missing": dict(found.missing)}), flush=True)
    return labels, {
        bone: (sheet.thickness_mm, sheet.thickness_sd_mm, sheet.confidence) for bone, sheet in found.sheets.items()
    }


def found_before(folder: Path, bones: dict[str, Surface]):
    """Labels and the thickness at the true bones' vertices, from what `marey knee segment` left."""
    thickness: dict[str, tuple[Floats, Floats, Floats]] = {}
    for bone, surface in bones.items():
        file = folder / f"{bone}_thickness.npz"
        if file.exists():
            near = cKDTree(read_mesh(folder / f"{bone}.ply").vertices_mm).query(surface.vertices_mm)[1]
            stored = read_arrays(file)
            thickness[bone] = (
                stored["thickness_mm"][near], stored["thickness_sd_mm"][near], stored["confidence"][near],
            )  # fmt: skip
    return read_labels(folder), thickness


def measure(shared: Path, case: str, segmented: Path | None) -> None:
    name = CASES[case][0][0]
    truth, fine = (true_labels(shared, name, kind) for kind in ("truth_labels", "truth_labels_fine"))
    true = surfaces_of(fine)
    bones = {bone: true[bone] for bone in BONES}
    began = time.process_time()
    labels, thickness = found_before(segmented, bones) if segmented else found_here(shared, case, truth, bones)
    spent = time.process_time() - began
    print_scores(case, truth, true, labels, thickness, spent)


def print_scores(
    case: str, truth: Labels, true: dict[str, Surface], labels: Labels,
    answers: dict[str, tuple[Floats, Floats, Floats]], spent: float,
) -> None:  # fmt: skip
    """One line a bone; `answers` are thickness, its standard deviation and confidence at the true bones' vertices."""
    for bone, (ours, sd, confidence) in answers.items():
        cartilage = CARTILAGE_OF_BONE[bone]
        here, there = labels.mask(cartilage), truth.mask(cartilage)
        wanted = cartilage_thickness(true[bone], [true[cartilage]])
        covered, answered = wanted > 0.01, ours > 0.01
        both = covered & answered
        sure = both & (confidence > 0.5)
        line = {
            "dice": 2 * (here & there).sum() / (here.sum() + there.sum()),
            "mean_mm": (ours - wanted)[covered].mean(), "map_mm": np.abs(ours - wanted)[both].mean(),
            "found": answered[covered].mean(), "false": answered[~covered].mean(),
            "within": (np.abs(ours - wanted)[sure] < 1.96 * sd[sure]).mean(), "seconds": spent,
        }  # fmt: skip
        print(
            json.dumps({"case": case, "cartilage": cartilage} | {k: round(float(v), 3) for k, v in line.items()}),
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("shared", type=Path)
    parser.add_argument("case", nargs="?", choices=tuple(CASES))
    parser.add_argument("--segmented", type=Path)
    given = parser.parse_args()
    with threadpool_limits(1):
        for case in [given.case] if given.case else CASES:
            measure(given.shared, case, given.segmented)


if __name__ == "__main__":
    main()
