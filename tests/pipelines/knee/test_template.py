"""Templates from labels and from outlines: files, notes, and errors."""

import json
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from tests.made_knees import made_grid, made_labels, signed_shapes
from tests.verdicts import agreed_verdict

from marey.errors import MareyError
from marey.io.mr.contours import write_contours
from marey.io.mr.meshes import read_mesh
from marey.io.mr.volumes import read_template, write_labels, write_volume
from marey.knee.outlines.contours import Contour, slice_count, slice_of
from marey.knee.space.volume import Volume, VoxelGrid
from marey.pipelines.knee.template import make_template

for needed in ("SimpleITK", "skimage", "fast_simplification"):
    if find_spec(needed) is None:
        pytest.skip(f"{needed} is not installed", allow_module_level=True)

SIZE = 1 / 3
"""Of the made knee, small so that its surfaces are made soon."""
GRID = VoxelGrid(
    shape=made_grid((3.0, 3.0, 3.0)).shape,
    lps_from_voxel=np.diag([SIZE] * 3 + [1.0]) @ made_grid((3.0, 3.0, 3.0)).lps_from_voxel,
)


def outlined(axis: str, every: int) -> list[Contour]:
    """Outlines of the made bones in some slices, by level curves of their distances."""
    from skimage.measure import find_contours

    contours = []
    for structure, distance in signed_shapes(GRID, size=SIZE).items():
        if structure == "limb":
            continue
        for index in range(0, slice_count(GRID, axis), every):
            part = np.pad(slice_of(distance, axis, index), 1, constant_values=-1)
            for curve in find_contours(part, 0.0):
                outline = curve[:-1, ::-1] - 1
                if len(outline) < 6:
                    continue
                contours.append(
                    Contour(structure=structure, axis=axis, index=index, anchors=outline[::20], outline=outline)
                )
    return contours


def test_labels_become_a_template_with_surfaces(tmp_path: Path):
    write_labels(tmp_path / "mine", made_labels(GRID, size=SIZE))
    made = make_template([tmp_path / "mine"])
    made.save(tmp_path / "out")
    notes = " ".join(made.details.warnings)
    assert tuple(made.template.surfaces) == ("femur", "tibia", "patella")
    assert made.template.side is None
    assert "femoral cartilage is missing" in notes
    assert "the side of the knee is unknown" in notes  # so small a patella lies but a millimetre off the middle
    assert np.array_equal(read_template(tmp_path / "out").labels, made_labels(GRID, size=SIZE).labels)
    assert read_mesh(tmp_path / "out" / "femur.ply").volume_mm3 > 0
    assert agreed_verdict(tmp_path / "out" / "run.json").level == "usable with limits"
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {"labels.nii.gz", "labels.json", "femur.ply", "tibia.ply", "patella.ply", "run.json"}


@pytest.mark.parametrize("axis", ["i", "j", "k"])
def test_outlines_become_a_template_like_the_knee_they_were_drawn_in(tmp_path: Path, axis: str):
    path = tmp_path / "contours.json"
    write_contours(path, outlined(axis, 2), GRID, "knee.nii.gz")
    found, whole = make_template([path]).template.labels, made_labels(GRID, size=SIZE)
    for bone in ("femur", "tibia", "patella"):
        here, there = found.mask(bone), whole.mask(bone)
        assert 2 * (here & there).sum() / (here.sum() + there.sum()) > 0.85


def test_outlines_of_another_volume_are_rejected(tmp_path: Path):
    path = tmp_path / "contours.json"
    write_contours(path, outlined("k", 6), GRID, "")
    shifted = GRID.lps_from_voxel.copy()
    shifted[0, 3] += 7.0
    other = VoxelGrid(shape=GRID.shape, lps_from_voxel=shifted)
    write_volume(tmp_path / "other.nii.gz", Volume(intensity=np.indices(GRID.shape)[0], grid=other))
    with pytest.raises(MareyError, match="is not the volume"):
        make_template([path, tmp_path / "other.nii.gz"])


def test_labels_that_cannot_be_a_template_are_an_error(tmp_path: Path):
    path = tmp_path / "contours.json"
    write_contours(path, [], GRID, "")
    with pytest.raises(MareyError, match="no outlines"):
        make_template([path])
    path.write_text(json.dumps({"contours": 3}), encoding="utf-8")
    with pytest.raises(MareyError, match=r"contours\.json"):
        make_template([path])
    with pytest.raises(MareyError, match="one volume of labels"):
        make_template([tmp_path / "a.nii", tmp_path / "b.nii"])


def test_a_template_without_a_long_bone_is_not_usable(tmp_path: Path):
    labels = made_labels(GRID, size=SIZE)
    write_labels(tmp_path / "mine", replace(labels, labels=np.where(labels.mask("tibia"), 0, labels.labels)))
    verdict = make_template([tmp_path / "mine"]).details.verdict
    assert verdict is not None
    assert not verdict.usable
    assert verdict.reasons[0].what.startswith("The tibia is missing")
