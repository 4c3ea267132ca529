"""Images that are larger than their files can hold are refused before memory is reserved for them."""

import gzip
import struct
import tracemalloc
from importlib.util import find_spec

import numpy as np
import pytest

from marey.errors import FileProblem
from marey.io.mr.image_sizes import MOST_VOXELS
from marey.io.mr.volumes import read_volume, simple_itk, write_volume
from marey.knee.space.volume import Volume, VoxelGrid

if find_spec("SimpleITK") is None:
    pytest.skip("SimpleITK is not installed", allow_module_level=True)

META = "ObjectType = Image\nNDims = 3\nDimSize = {}\nElementType = MET_FLOAT\nElementDataFile = {}\n"
NRRD = "NRRD0004\ntype: uchar\ndimension: 3\nsizes: {}\nencoding: raw\n\n"


@pytest.mark.parametrize(
    ("name", "text", "wrong"),
    [
        ("a.mha", META.format("90000 90000 90000", "LOCAL"), f"At most {MOST_VOXELS} can be read"),
        ("a.mha", META.format("600 600 600", "LOCAL"), r"more than its \d+ bytes can hold"),
        (
            "a.mha",
            META.replace("NDims = 3", "NDims = 1e30").format("9 9 9", "LOCAL"),
            "states NDims = 1e30, which is imp",
        ),
        ("a.mha", META.format("9 -9 9", "LOCAL"), "states DimSize = 9 -9 9, which is impossible"),
        ("a.mhd", META.format("9 9 9", "b.raw"), "has its voxels in b.raw, which does not exist"),
        ("a.nrrd", NRRD.format("700 700 700"), "states 700 x 700 x 700 voxels"),
        ("a.nrrd", NRRD.format("-4 5 6"), "a.nrrd"),
    ],
)
def test_sizes_that_a_file_cannot_have_are_refused(tmp_path, name, text, wrong):
    (tmp_path / name).write_text(text)
    with pytest.raises(FileProblem, match=wrong):
        read_volume(tmp_path / name)


@pytest.mark.parametrize(
    ("at", "value", "wrong"), [(40, 9, "states 9 dimensions"), (42, -3, "states -3 x"), (42, 32767, "voxels")]
)
def test_the_header_of_a_nifti_is_checked(tmp_path, rng, capfd, at, value, wrong):
    grid = VoxelGrid(shape=(5, 6, 7), lps_from_voxel=np.eye(4))
    write_volume(tmp_path / "a.nii", Volume(intensity=rng.uniform(1, 9, grid.shape), grid=grid))
    content = bytearray((tmp_path / "a.nii").read_bytes())
    struct.pack_into("<h", content, at, value)
    for name, written in (("a.nii", bytes(content)), ("a.nii.gz", gzip.compress(content))):
        (tmp_path / name).write_bytes(written)
        with pytest.raises(FileProblem, match=wrong):
            read_volume(tmp_path / name)
    struct.pack_into("<h", content, at, 7)
    struct.pack_into("<h", content, 70, 9999)  # ITK's library writes to the terminal that there is no such type
    (tmp_path / "a.nii").write_bytes(content)
    with pytest.raises(FileProblem, match=r"a\.nii"):
        read_volume(tmp_path / "a.nii")
    assert not capfd.readouterr().err


def test_the_rest_of_a_compressed_file_is_not_kept(tmp_path, rng):
    grid = VoxelGrid(shape=(5, 6, 7), lps_from_voxel=np.eye(4))
    write_volume(tmp_path / "a.nii", Volume(intensity=rng.uniform(1, 9, grid.shape), grid=grid))
    whole = (tmp_path / "a.nii").read_bytes()
    (tmp_path / "a.nii.gz").write_bytes(gzip.compress(whole + bytes(10**7)))
    assert read_volume(tmp_path / "a.nii.gz").intensity.shape == grid.shape
    assert simple_itk().ReadImage(str(tmp_path / "a.nii.gz")).GetSize() == grid.shape[::-1]


def test_an_image_that_begins_behind_the_end_of_the_file_reserves_no_memory(tmp_path, rng):
    grid = VoxelGrid(shape=(5, 6, 7), lps_from_voxel=np.eye(4))
    write_volume(tmp_path / "a.nii", Volume(intensity=rng.uniform(1, 9, grid.shape), grid=grid))
    content = bytearray((tmp_path / "a.nii").read_bytes())
    struct.pack_into("<f", content, 108, 1e10)
    (tmp_path / "a.nii").write_bytes(content)
    tracemalloc.start()
    try:
        with pytest.raises(FileProblem, match=r"a\.nii"):
            read_volume(tmp_path / "a.nii")
        assert tracemalloc.get_traced_memory()[1] < 10**8
    finally:
        tracemalloc.stop()
