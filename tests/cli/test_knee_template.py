import json
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from tests.made_knees import made_grid, made_labels, signed_shapes

from marey.cli.main import run
from marey.io.mr.contours import write_contours
from marey.io.mr.meshes import read_mesh
from marey.io.mr.volumes import read_template, write_labels, write_volume
from marey.knee.outlines.contours import Contour, slice_count, slice_of
from marey.knee.space.volume import Volume, VoxelGrid

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


def test_labels_become_a_template_with_surfaces(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    write_labels(tmp_path / "mine", made_labels(GRID, size=SIZE))
    assert run(["knee", "template", str(tmp_path / "mine"), "--out", str(tmp_path / "out"), "-q"]) == 0
    printed = capsys.readouterr()
    assert "A knee with femur, tibia, patella" in printed.out
    assert "femoral cartilage is missing" in printed.err
    assert "the side of the knee is unknown" in printed.err  # so small a patella lies but a millimetre off the middle
    assert np.array_equal(read_template(tmp_path / "out").labels, made_labels(GRID, size=SIZE).labels)
    assert read_mesh(tmp_path / "out" / "femur.ply").volume_mm3 > 0
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {"labels.nii.gz", "labels.json", "femur.ply", "tibia.ply", "patella.ply", "run.json"}


@pytest.mark.parametrize("axis", ["i", "j", "k"])
def test_outlines_become_a_template_like_the_knee_they_were_drawn_in(tmp_path: Path, axis: str):
    path = tmp_path / "contours.json"
    write_contours(path, outlined(axis, 2), GRID, "knee.nii.gz")
    assert run(["knee", "template", str(path), "--out", str(tmp_path / "out"), "-q"]) == 0
    found, whole = read_template(tmp_path / "out"), made_labels(GRID, size=SIZE)
    for bone in ("femur", "tibia", "patella"):
        here, there = found.mask(bone), whole.mask(bone)
        assert 2 * (here & there).sum() / (here.sum() + there.sum()) > 0.85


def test_outlines_of_another_volume_are_rejected(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = tmp_path / "contours.json"
    write_contours(path, outlined("k", 6), GRID, "")
    shifted = GRID.lps_from_voxel.copy()
    shifted[0, 3] += 7.0
    other = VoxelGrid(shape=GRID.shape, lps_from_voxel=shifted)
    write_volume(tmp_path / "other.nii.gz", Volume(intensity=np.indices(GRID.shape)[0], grid=other))
    assert run(["knee", "template", str(path), str(tmp_path / "other.nii.gz"), "--out", str(tmp_path / "out")]) == 2
    assert "is not the volume" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_labels_that_cannot_be_a_template_leave_no_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = tmp_path / "contours.json"
    write_contours(path, [], GRID, "")
    assert run(["knee", "template", str(path), "--out", str(tmp_path / "out")]) == 2
    assert "no outlines" in capsys.readouterr().err
    path.write_text(json.dumps({"contours": 3}), encoding="utf-8")
    assert run(["knee", "template", str(path), "--out", str(tmp_path / "out")]) == 2
    assert (
        run(["knee", "template", str(tmp_path / "a.nii"), str(tmp_path / "b.nii"), "--out", str(tmp_path / "out")]) == 2
    )
    assert "one volume of labels" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
