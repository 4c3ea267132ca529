"""Cartilage by another knee's template in the simulated volumes, on the true bones or on those that the program finds.

Cases: phantom_a (template: atlas), phantom_spl, phantom_spl_t1, or pair (both of them; template: template_a). Without
`--segmented` the inner surface is that of the true labels, so that only cartilage is evaluated; with it, `marey knee
segment` finds bones and cartilage. True thickness is that of surfaces of the fine true labels, at the vertices of the
true bone.
"""

import argparse
import json
import tempfile
import time
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

import marey
from bench.declaration import Bench
from bench.knee.bones import score
from bench.recording import Column, Run, Table
from marey.arrays import Floats
from marey.io.mr.meshes import read_mesh
from marey.io.mr.volumes import read_labels, read_volume
from marey.io.npz import read_arrays
from marey.knee.cartilage.knee_cartilage import find_knee_cartilage, knee_template, seen_share
from marey.knee.cartilage.labels import with_cartilage
from marey.knee.cartilage.thickness import cartilage_thickness
from marey.knee.space.structures import BONES, CARTILAGE_OF_BONE, LABELS
from marey.knee.space.surface import TriangleSurface
from marey.knee.space.surfacing import surface_of_labels
from marey.knee.space.volume import Labels

BENCH = Bench(
    measures="Cartilage and its thickness from magnetic resonance images, against true labels.",
    sources=("src/marey/knee/space", "src/marey/knee/bones", "src/marey/knee/cartilage", "src/marey/knee/registration"),
    minutes=6,
)
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


def surfaces_of(labels: Labels) -> dict[str, TriangleSurface]:
    held = [name for name in LABELS if labels.mask(name).any()]
    return {name: surface_of_labels(labels, name) for name in held}


def found_here(run: Run, table: Table, case: str, truth: Labels, bones: dict[str, TriangleSurface]):
    """Labels and the thickness at the true bones' vertices, with the true bones."""
    names, template = CASES[case]
    volumes = [read_volume(run.shared / "data" / "knee" / name / "image.nii.gz") for name in names]
    model = knee_template(surfaces_of(read_labels(run.shared / "data" / "knee" / template)), mirror=True)
    found = find_knee_cartilage(volumes, bones, model)
    labels = with_cartilage(truth, found.sheets)
    shares = ", ".join(f"{CARTILAGE_OF_BONE[bone]} {seen_share(sheet):.2f}" for bone, sheet in found.sheets.items())
    missing = f"; missing: {dict(found.missing)}" if found.missing else ""
    table.note += f" Share that the image determines more than the template, `{case}`: {shares}{missing}."
    return labels, {
        bone: (sheet.thickness_mm, sheet.thickness_sd_mm, sheet.confidence) for bone, sheet in found.sheets.items()
    }


def segmented(run: Run, case: str) -> Path:
    """Segment the knee of a case unless its results exist; the folder of the results."""
    names, template = CASES[case]
    knee, out = run.shared / "data" / "knee", run.out / "segmented" / case
    if not (out / "run.json").exists():
        images = [knee / name / "image.nii.gz" for name in names]
        with marey.tuned_process(parallel_cameras=False):
            marey.segment_knee(images, template=knee / template, out=out, progress=marey.RecordingProgress())
    return out


def found_before(folder: Path, bones: dict[str, TriangleSurface]):
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


def begin(run: Run, title: str) -> Table:
    """Begin a table of cartilages."""
    return run.table(
        title, ("case", "cartilage"), Column("Dice", "", 3), Column("mean", "mm", 2), Column("map", "mm", 2),
        Column("found", "", 2), Column("false", "", 2), Column("95 % intervals hold", "", 2), Column("time", "s", 0),
        note=(
            "*Mean*: mean thickness less the true one over the true cartilage (bare counts as 0). *Map*: mean absolute "
            "difference where both have cartilage. *Found*, *false*: shares of covered vertices found, and of "
            "bare ones falsely "
            "covered. *Hold*: of vertices found with a confidence above 0.5."
        ),
    )  # fmt: skip


def fill(
    table: Table, case: str, truth: Labels, true: dict[str, TriangleSurface], labels: Labels,
    answers: dict[str, tuple[Floats, Floats, Floats]], spent: float,
) -> None:  # fmt: skip
    """One row per bone; `answers` are thickness, its standard deviation and confidence at the true bones' vertices."""
    for bone, (ours, sd, confidence) in answers.items():
        cartilage = CARTILAGE_OF_BONE[bone]
        here, there = labels.mask(cartilage), truth.mask(cartilage)
        wanted = cartilage_thickness(true[bone], [true[cartilage]])
        covered, answered = wanted > 0.01, ours > 0.01
        both = covered & answered
        sure = both & (confidence > 0.5)
        table.row(
            (case, cartilage), 2 * (here & there).sum() / (here.sum() + there.sum()), (ours - wanted)[covered].mean(),
            np.abs(ours - wanted)[both].mean(), answered[covered].mean(), answered[~covered].mean(),
            (np.abs(ours - wanted)[sure] < 1.96 * sd[sure]).mean(), spent,
        )  # fmt: skip


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("cases", nargs="*", help=f"of {', '.join(CASES)}; all without any")
    parser.add_argument("--segmented", action="store_true", help="with the bones that `marey knee segment` finds")


def run(run: Run) -> None:
    """Find cartilage, and score it."""
    given = run.arguments
    table = begin(run, "Cartilage on the program's bones" if given.segmented else "Cartilage on the true bones")
    columns = [Column(f"{bone}: Dice / ASD [mm] / HD95 [mm]") for bone in BONES]
    bones_table = run.table("The bones of the same runs", "case", *columns) if given.segmented else None
    for case in given.cases or CASES:
        name = CASES[case][0][0]
        truth, fine = (true_labels(run.shared, name, kind) for kind in ("truth_labels", "truth_labels_fine"))
        true = surfaces_of(fine)
        bones = {bone: true[bone] for bone in BONES}
        began = time.perf_counter()
        found = (
            found_before(segmented(run, case), bones) if given.segmented else found_here(run, table, case, truth, bones)
        )
        fill(table, case, truth, true, *found, time.perf_counter() - began)
        if bones_table is not None:
            reference = run.shared / "data" / "knee" / name / "truth_labels.nii.gz"
            scores = score(run, reference, segmented(run, case))
            bones_table.row(case, *(scores[bone] for bone in BONES))
