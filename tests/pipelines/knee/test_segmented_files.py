"""The files of a segmented knee, what is missing in them, and the errors for invalid input."""

import json
from importlib.util import find_spec

import numpy as np
import pytest
from tests.made_knees import (
    labels_with_cartilage,
    made_grid,
    made_labels,
    made_volume,
    patella_grid,
    signed_shapes,
    volume_with_cartilage,
)

from marey.errors import FileProblem
from marey.io.mr.meshes import read_mesh
from marey.io.mr.volumes import write_labels, write_volume
from marey.io.npz import read_arrays
from marey.knee.bones.bones import BoneSegmentation
from marey.knee.bones.refined_bones import Bone
from marey.knee.bones.template_fit import TemplateFit, TemplatePlacement
from marey.knee.cartilage.thickness import cartilage_thickness
from marey.knee.space.resampling import part_of
from marey.knee.space.structures import LABELS
from marey.knee.space.surfacing import surface_of_labels
from marey.knee.space.volume import Labels, Volume, VoxelGrid
from marey.pipelines.knee.segment import segment_knee
from marey.pipelines.knee.thickness import measure_thickness
from marey.pipelines.progress import RecordingProgress
from marey.pipelines.verdict import NotUsable

if find_spec("SimpleITK") is None:
    pytest.skip("SimpleITK is not installed", allow_module_level=True)


@pytest.mark.slow
def test_an_image_of_no_knee_ends_with_a_verdict_and_its_page(tmp_path, rng):
    grid = made_grid((4.0, 4.0, 5.0))
    write_volume(tmp_path / "noise.nii.gz", Volume(intensity=rng.uniform(5, 60, grid.shape), grid=grid))
    with pytest.raises(NotUsable, match="No femur above a tibia") as problem:
        segment_knee(tmp_path / "noise.nii.gz", side="left", out=tmp_path / "out", progress=RecordingProgress())
    [reason] = problem.value.verdict.reasons
    assert (reason.level, reason.cause) == ("not usable", "no knee")
    assert reason.what.startswith("noise.nii.gz: ")
    record = json.loads((tmp_path / "out" / "run.json").read_text(encoding="utf-8"))
    assert record["verdict"]["reasons"][0]["cause"] == "no knee"
    assert record["settings"] == {"side": "left"}
    assert problem.value.report == tmp_path / "out" / "report.html"
    assert "No femur above a tibia" in problem.value.report.read_text(encoding="utf-8")
    assert sorted(file.name for file in (tmp_path / "out").iterdir()) == ["report.html", "run.json"]
    with pytest.raises(FileProblem, match="does not exist"):
        segment_knee(tmp_path / "missing.nii.gz", out=tmp_path / "out")


def boxed_bone(distance_mm: np.ndarray, grid: VoxelGrid) -> Bone:
    """A bone on the part of a grid that it needs, as bones are found."""
    near = np.argwhere(distance_mm > -4)
    box = tuple(slice(int(a), int(b) + 1) for a, b in zip(near.min(0), near.max(0), strict=True))
    return Bone(distance_mm=distance_mm[box], grid=part_of(grid, box), seed_mm=np.array([0.0, 0, 30]))


def found_bones(volume: Volume, names: tuple[str, ...] = ("femur", "tibia")) -> BoneSegmentation:
    """Bones as if they had been found, without the patella unless it is named."""
    shapes = signed_shapes(volume.grid)
    bones = {name: boxed_bone(shapes[name], volume.grid) for name in names}
    placements = {name: TemplatePlacement(matrix=np.eye(3), shift=np.zeros(3)) for name in bones}
    labels = made_labels(volume.grid).labels
    labels = np.where(np.isin(labels, [LABELS[name] for name in names]), labels, 0)
    return BoneSegmentation(
        labels=Labels(labels=labels, grid=volume.grid), bones=bones, kinds=("dark",),
        template_fit=TemplateFit(placements=placements, mirrored=False, fit=0.9), notes=(),
    )  # fmt: skip


@pytest.mark.slow
def test_missing_structures_are_named_in_the_results(tmp_path, monkeypatch):
    volume = made_volume(made_grid((3.0, 3.0, 3.0)), "dark")
    write_volume(tmp_path / "knee.nii.gz", volume)
    labels = made_labels(volume.grid).labels.copy()
    # A speck that is called cartilage, far from any bone.
    labels[:3, :3, :3] = LABELS["femoral_cartilage"]
    write_labels(tmp_path / "template", Labels(labels=labels, grid=volume.grid))
    monkeypatch.setattr("marey.pipelines.knee.segment.segment_bones", lambda volumes, **_: found_bones(volumes[0]))
    out = tmp_path / "out"
    progress = RecordingProgress()
    knee = segment_knee(tmp_path / "knee.nii.gz", template=tmp_path / "template", out=out, progress=progress)
    missing = json.loads((out / "labels.json").read_text(encoding="utf-8"))["missing"]
    assert list(missing) == ["patella", "femoral_cartilage"]
    assert "does not lie on the bone" in missing["femoral_cartilage"]
    assert json.loads((out / "run.json").read_text(encoding="utf-8"))["settings"]["missing"] == missing
    assert dict(knee.missing) == missing
    assert sorted(file.name for file in out.iterdir()) == [
        "femur.ply", "labels.json", "labels.nii.gz", "report.html", "run.json", "tibia.ply",
    ]  # fmt: skip


@pytest.mark.slow
def test_cartilage_has_the_thickness_of_the_phantom_and_missing_parts_are_reported(tmp_path, monkeypatch):
    fine = patella_grid((0.5, 0.5, 0.7))
    write_volume(tmp_path / "knee.nii.gz", volume_with_cartilage(fine))
    # The template is bent, its cartilage a fifth thinner; that of the femur lies away from its bone.
    template = labels_with_cartilage(patella_grid((0.7, 0.7, 1.0)), thicker=0.8, bend_mm=1.0)
    labels = np.where(template.labels == LABELS["femoral_cartilage"], 0, template.labels)
    labels[-3:, :3, :3] = LABELS["femoral_cartilage"]
    write_labels(tmp_path / "template", Labels(labels=labels, grid=template.grid))
    bones = ("femur", "patella")
    monkeypatch.setattr(
        "marey.pipelines.knee.segment.segment_bones", lambda volumes, **_: found_bones(volumes[0], bones)
    )
    out = tmp_path / "out"
    segment_knee(
        tmp_path / "knee.nii.gz", template=tmp_path / "template", side="left", out=out, progress=RecordingProgress()
    )  # fmt: skip
    missing = json.loads((out / "labels.json").read_text(encoding="utf-8"))["missing"]
    assert list(missing) == ["tibia", "femoral_cartilage"]
    assert "does not lie on the bone" in missing["femoral_cartilage"]
    assert sorted(file.name for file in out.iterdir()) == [
        "cartilage.csv", "femur.ply", "labels.json", "labels.nii.gz", "patella.ply", "patella_thickness.glb",
        "patella_thickness.npz", "patella_thickness.ply", "patellar_cartilage.ply", "patellar_cartilage_flat.png",
        "report.html", "run.json",
    ]  # fmt: skip
    bone, found = read_mesh(out / "patella.ply"), read_arrays(out / "patella_thickness.npz")["thickness_mm"]
    truth = labels_with_cartilage(fine)
    made = cartilage_thickness(bone, [surface_of_labels(truth, "patellar_cartilage")])
    both = (made > 1) & (found > 0)
    assert both.sum() > 0.8 * (made > 1).sum()
    # A quarter of a voxel of 1 mm.
    assert abs((found - made)[both].mean()) < 0.25
    again = measure_thickness(out / "patella.ply", out / "patellar_cartilage.ply").thickness_mm
    both = (again > 0) & (found > 0)
    assert both.sum() > 0.8 * (found > 0).sum()
    assert np.median(np.abs(again - found)[both]) < 0.1


def test_a_folder_that_cannot_be_written_is_reported_before_the_work(tmp_path, monkeypatch):
    write_volume(tmp_path / "knee.nii.gz", made_volume(made_grid((4.0, 4.0, 5.0)), "dark"))
    (tmp_path / "file").write_text("in the way", encoding="utf-8")
    monkeypatch.setattr("marey.pipelines.knee.segment.segment_bones", lambda *_, **__: pytest.fail("it began to work"))
    with pytest.raises(FileProblem, match="cannot be created"):
        segment_knee(tmp_path / "knee.nii.gz", out=tmp_path / "file")


def test_an_interrupted_run_leaves_nothing_behind(tmp_path, monkeypatch):
    write_volume(tmp_path / "knee.nii.gz", made_volume(made_grid((4.0, 4.0, 5.0)), "dark"))

    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("marey.pipelines.knee.segment.segment_bones", interrupt)
    with pytest.raises(KeyboardInterrupt):
        segment_knee(tmp_path / "knee.nii.gz", out=tmp_path / "out")
    assert [file.name for file in tmp_path.iterdir()] == ["knee.nii.gz"]


@pytest.mark.slow
def test_a_problem_with_the_template_names_its_folder(tmp_path):
    grid = made_grid((4.0, 4.0, 5.0))
    write_volume(tmp_path / "knee.nii.gz", made_volume(grid, "dark"))
    labels = made_labels(grid).labels.copy()
    labels[labels == LABELS["tibia"]] = 0
    write_labels(tmp_path / "template", Labels(labels=labels, grid=grid))
    with pytest.raises(FileProblem, match="template: has no tibia"):
        segment_knee(tmp_path / "knee.nii.gz", template=tmp_path / "template", out=tmp_path / "out")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["knee.nii.gz", "template"]
