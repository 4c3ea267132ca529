import json
from pathlib import Path

import numpy as np
import pytest

from marey.errors import FileProblem
from marey.io.mr.contours import read_contours, same_grid, write_contours
from marey.knee.outlines.contours import Contour
from marey.knee.space.volume import VoxelGrid

GRID = VoxelGrid(shape=(6, 20, 30), lps_from_voxel=np.diag([-0.5, 0.5, 2.0, 1.0]))


def made_contour(index: int = 3) -> Contour:
    outline = np.array([[2.25, 3.5], [9.0, 4.125], [7.5, 12.0]])
    return Contour(structure="femur", axis="k", index=index, anchors=outline[:2], outline=outline)


def written(folder: Path) -> tuple[Path, dict]:
    path = folder / "contours.json"
    write_contours(path, [made_contour(), made_contour(5)], GRID, "image.nii.gz")
    return path, json.loads(path.read_text(encoding="utf-8"))


def test_written_outlines_are_read(tmp_path: Path):
    path, _ = written(tmp_path)
    found = read_contours(path)
    assert found.volume == "image.nii.gz"
    assert same_grid(found.grid, GRID)
    assert [contour.index for contour in found.contours] == [3, 5]
    first = found.contours[0]
    assert (first.structure, first.axis) == ("femur", "k")
    np.testing.assert_array_equal(first.outline, made_contour().outline)
    np.testing.assert_array_equal(first.anchors, made_contour().anchors)
    assert [file.name for file in tmp_path.iterdir()] == ["contours.json"]


def test_a_file_without_outlines_is_a_beginning(tmp_path: Path):
    write_contours(tmp_path / "contours.json", [], GRID, "")
    assert read_contours(tmp_path / "contours.json").contours == ()


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("structure", "fibula", "unknown"),
        ("axis", "x", "does not exist in the volume"),
        ("slice", 6, "does not exist in the volume"),
        ("slice", "five", "number 2"),
        ("outline", [[1, 2]], "1 points"),
        ("outline", [[1, 2], [3, None], [4, 5]], "number 2"),
        ("anchors", [1, 2, 3], "number 2"),
    ],
)
def test_an_invalid_outline_is_named(tmp_path: Path, key: str, value: object, message: str):
    path, table = written(tmp_path)
    table["contours"][1][key] = value
    path.write_text(json.dumps(table), encoding="utf-8")
    with pytest.raises(FileProblem, match=message):
        read_contours(path)


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ("", "is not JSON"), ("[]", "is not a table"), ("{}", "cannot be read as outlines"),
        ('{"shape": [1, 2], "lps_from_voxel": [], "contours": []}', "cannot be read as outlines"),
        ("\x00\x01", "is not JSON"),
    ],
)  # fmt: skip
def test_a_file_without_outlines_is_rejected(tmp_path: Path, text: str, wrong: str):
    path = tmp_path / "contours.json"
    with pytest.raises(FileProblem, match="does not exist"):
        read_contours(path)
    path.write_text(text, encoding="utf-8")
    with pytest.raises(FileProblem, match=wrong):
        read_contours(path)


def test_grids_are_the_same_where_all_their_corners_are():
    moved = GRID.lps_from_voxel.copy()
    moved[0, 3] += 0.5
    assert not same_grid(GRID, VoxelGrid(shape=GRID.shape, lps_from_voxel=moved))
    assert not same_grid(GRID, VoxelGrid(shape=(6, 20, 31), lps_from_voxel=GRID.lps_from_voxel))
    assert same_grid(GRID, VoxelGrid(shape=GRID.shape, lps_from_voxel=GRID.lps_from_voxel + 1e-6))
