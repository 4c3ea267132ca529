import json
import locale
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from marey.errors import FileProblem
from marey.io.mr.volumes import read_labels, read_template, read_volume, simple_itk, write_labels, write_volume
from marey.knee.space.volume import Labels, Volume, VoxelGrid

if find_spec("SimpleITK") is None:
    pytest.skip("SimpleITK is not installed", allow_module_level=True)
sitk = simple_itk()


def turned(spacing: tuple[float, float, float], *, flip: bool = False) -> np.ndarray:
    """A grid that is turned about all axes; its determinant is negative when flipped."""
    angles = 0.3, -0.5, 0.8
    matrix = np.eye(3)
    for axis, angle in enumerate(angles):
        step = np.eye(3)
        first, second = (axis + 1) % 3, (axis + 2) % 3
        step[[first, second], [first, second]] = np.cos(angle)
        step[first, second], step[second, first] = -np.sin(angle), np.sin(angle)
        matrix = matrix @ step
    matrix = matrix * np.array([1, -1, 1] if flip else [1, 1, 1]) * spacing
    return np.block([[matrix, np.array([[10.0], [-20.0], [30.0]])], [np.zeros((1, 3)), np.ones((1, 1))]])


def volume(rng: np.random.Generator, *, flip: bool = False) -> Volume:
    grid = VoxelGrid(shape=(5, 6, 7), lps_from_voxel=turned((0.3, 0.4, 1.5), flip=flip))
    return Volume(intensity=rng.uniform(0, 400, grid.shape), grid=grid)


@pytest.mark.parametrize("flip", [False, True])
@pytest.mark.parametrize("ending", ["nii.gz", "nii", "nrrd", "mha", "mhd"])
def test_volumes_keep_values_and_place_in_every_format(tmp_path, rng, ending, flip):
    made = volume(rng, flip=flip)
    write_volume(tmp_path / f"image.{ending}", made)
    read = read_volume(tmp_path / f"image.{ending}")
    np.testing.assert_array_equal(read.intensity, made.intensity)
    # NIfTI keeps its matrix in single precision.
    np.testing.assert_allclose(read.grid.lps_from_voxel, made.grid.lps_from_voxel, atol=1e-4)
    assert np.sign(np.linalg.det(read.grid.lps_from_voxel)) == (-1 if flip else 1)


def write_series(
    folder: Path, numbers: list[int], *, uid: str = "1.2.3", modality: str = "MR", echo: str = "1", rows: int = 6
) -> None:
    """Slices of a made series, 2 mm apart, named against their order."""
    folder.mkdir(exist_ok=True)
    spoken = locale.setlocale(locale.LC_ALL)
    for number in numbers:
        image = sitk.GetImageFromArray(np.full((rows, 7), 10 * number, dtype=np.int16))
        image.SetSpacing((0.5, 0.6))
        tags = {
            "0008|0060": modality, "0020|000e": uid, "0020|000d": "1.2", "0008|0016": "1.2.840.10008.5.1.4.1.1.4",
            "0008|0018": f"{uid}.{echo}.{number + 1}", "0020|0013": str(number), "0020|0032": f"{-2 * number}\\5\\9",
            "0020|0037": "0\\1\\0\\0\\0\\-1", "0018|0050": "2", "0028|0030": "0.6\\0.5",
        }  # fmt: skip
        for tag, value in tags.items():
            image.SetMetaData(tag, value)
        writer = sitk.ImageFileWriter()
        writer.KeepOriginalImageUIDOn()
        writer.SetFileName(str(folder / f"{uid}_{echo}_{99 - number}.dcm"))
        writer.Execute(image)
    locale.setlocale(locale.LC_ALL, spoken)  # the writer leaves it at C


def test_slices_of_a_series_are_in_the_order_of_their_positions(tmp_path):
    write_series(tmp_path / "series", list(range(6)))
    read = read_volume(tmp_path / "series")
    values = read.intensity[:, 0, 0]
    places = read.grid.lps(np.array([[0, 0, k] for k in range(6)]))
    np.testing.assert_allclose(values, -5 * places[:, 0])
    np.testing.assert_allclose(read.grid.spacing_mm, [0.5, 0.6, 2.0])


def test_a_slice_with_an_impossible_number_of_colours_is_named(tmp_path):
    write_series(tmp_path / "series", list(range(5)))
    path = tmp_path / "series" / "1.2.3_1_97.dcm"
    # Samples per pixel, a tag without a type: group, element, length, value.
    samples = b"\x28\x00\x02\x00\x02\x00\x00\x00"
    content = path.read_bytes()
    assert content.count(samples + b"\x01\x00") == 1
    path.write_bytes(content.replace(samples + b"\x01\x00", samples + b"\x10\x00"))
    with pytest.raises(FileProblem, match=r"_97\.dcm: cannot be read as a slice of a series .*SamplesPerPixel"):
        read_volume(tmp_path / "series")


def test_a_missing_slice_of_a_series_is_located(tmp_path):
    write_series(tmp_path / "series", [0, 1, 2, 4, 5, 6])
    with pytest.raises(FileProblem, match=r"has missing slices: slices 3 and 4 are 4\.00 mm apart, the others 2\.00"):
        read_volume(tmp_path / "series")


def test_several_series_in_a_folder_are_an_error(tmp_path):
    write_series(tmp_path / "series", list(range(5)))
    write_series(tmp_path / "series", list(range(5)), uid="1.2.4")
    with pytest.raises(FileProblem, match=r"2 DICOM series: without a name \(\d files, .*dcm the first\); without"):
        read_volume(tmp_path / "series")


def test_two_echoes_in_one_series_are_an_error(tmp_path):
    write_series(tmp_path / "series", list(range(5)))
    write_series(tmp_path / "series", list(range(5)), echo="2")
    with pytest.raises(FileProblem, match=r"several images of one slice, for example \S+dcm and \S+dcm"):
        read_volume(tmp_path / "series")


def test_a_slice_of_another_size_is_named(tmp_path):
    write_series(tmp_path / "series", [0, 1, 3, 4])
    write_series(tmp_path / "series", [2], rows=8)
    with pytest.raises(FileProblem, match=r"several sizes: 1\.2\.3_1_97\.dcm of 7 x 8, most of 7 x 6"):
        read_volume(tmp_path / "series")


def test_a_slice_that_cannot_be_read_is_named_with_the_gap_it_leaves(tmp_path):
    write_series(tmp_path / "series", [0, 1, 2, 3, 4])
    (tmp_path / "series" / "1.2.3_1_97.dcm").write_bytes(b"cut off")
    with pytest.raises(FileProblem, match=r"has missing slices: .* 1\.2\.3_1_97\.dcm there cannot be read"):
        read_volume(tmp_path / "series")


def test_an_empty_file_and_one_that_was_cut_off_are_named(tmp_path, rng):
    (tmp_path / "empty.nii.gz").touch()
    with pytest.raises(FileProblem, match="is empty"):
        read_volume(tmp_path / "empty.nii.gz")
    grid = VoxelGrid(shape=(20, 40, 40), lps_from_voxel=np.eye(4))
    write_volume(tmp_path / "cut.nii.gz", Volume(intensity=rng.uniform(0, 400, grid.shape), grid=grid))
    content = (tmp_path / "cut.nii.gz").read_bytes()
    (tmp_path / "cut.nii.gz").write_bytes(content[: len(content) // 2])
    with pytest.raises(FileProblem, match=r"truncated or damaged|cannot be read"):
        read_volume(tmp_path / "cut.nii.gz")


def test_an_image_instead_of_labels_is_rejected(tmp_path, rng):
    write_volume(tmp_path / "labels.nii.gz", Volume(intensity=rng.uniform(0, 9, (9, 9, 9)), grid=volume(rng).grid))
    (tmp_path / "names.json").write_text('{"1": "femur"}', encoding="utf-8")
    with pytest.raises(FileProblem, match="values without a name: it seems to be an image"):
        read_template(tmp_path)


def test_a_single_slice_is_an_error(tmp_path):
    write_series(tmp_path / "series", [0])
    with pytest.raises(FileProblem, match="single DICOM slice"):
        read_volume(tmp_path / "series")


def test_another_modality_is_an_error(tmp_path):
    write_series(tmp_path / "series", list(range(5)), modality="CT")
    with pytest.raises(FileProblem, match="modality CT"):
        read_volume(tmp_path / "series")


def test_colours_and_four_dimensions_are_errors(tmp_path):
    colour = sitk.GetImageFromArray(np.zeros((5, 5, 5, 3), np.uint8), isVector=True)
    sitk.WriteImage(colour, str(tmp_path / "colour.mha"))
    with pytest.raises(FileProblem, match="colours"):
        read_volume(tmp_path / "colour.mha")
    sitk.WriteImage(
        sitk.GetImageFromArray(np.zeros((3, 5, 5, 5), np.uint8), isVector=False), str(tmp_path / "four.nii")
    )
    with pytest.raises(FileProblem, match="4 dimensions"):
        read_volume(tmp_path / "four.nii")


def test_unknown_missing_and_damaged_files_are_named(tmp_path):
    (tmp_path / "image.stl").write_bytes(b"")
    with pytest.raises(FileProblem, match="unknown format"):
        read_volume(tmp_path / "image.stl")
    with pytest.raises(FileProblem, match="does not exist"):
        read_volume(tmp_path / "image.nii.gz")
    (tmp_path / "image.nii.gz").write_bytes(b"no NIfTI")
    with pytest.raises(FileProblem, match="not have the format of its file name extension"):
        read_volume(tmp_path / "image.nii.gz")
    with pytest.raises(FileProblem, match="no DICOM series"):
        read_volume(tmp_path)


def test_written_labels_are_read_by_name_with_their_grid(tmp_path, rng):
    grid = volume(rng, flip=True).grid
    made = Labels(labels=rng.integers(0, 7, grid.shape), grid=grid)
    write_labels(tmp_path / "knee", made)
    read = read_labels(tmp_path / "knee")
    np.testing.assert_array_equal(read.labels, made.labels)
    np.testing.assert_allclose(read.grid.lps_from_voxel, grid.lps_from_voxel, atol=1e-4)
    assert sorted(file.name for file in (tmp_path / "knee").iterdir()) == ["labels.json", "labels.nii.gz"]


def test_a_template_is_read_by_names_and_both_tibial_cartilages_are_one(tmp_path, rng):
    grid = volume(rng).grid
    values = rng.integers(80, 99, grid.shape).astype(np.int16)
    names = {"84": "lateral tibial cartilage", "85": "medial tibial cartilage", "95": "femur", "81": "lateral meniscus"}
    write_labels(tmp_path, Labels(labels=np.zeros(grid.shape), grid=grid))
    image = sitk.ReadImage(str(tmp_path / "labels.nii.gz"))
    numbered = sitk.GetImageFromArray(values)
    numbered.CopyInformation(image)
    sitk.WriteImage(numbered, str(tmp_path / "labels.nii.gz"))
    (tmp_path / "labels.json").unlink()
    with pytest.raises(FileProblem, match="no file with the names"):
        read_template(tmp_path)
    (tmp_path / "names.json").write_text(json.dumps(names))
    read = read_template(tmp_path)
    np.testing.assert_array_equal(read.mask("tibial_cartilage"), (values == 84) | (values == 85))
    np.testing.assert_array_equal(read.mask("femur"), values == 95)
    assert set(np.unique(read.labels)) == {0, 1, 4}


def test_a_table_of_foreign_or_broken_names_is_an_error(tmp_path, rng):
    write_labels(tmp_path, Labels(labels=rng.integers(0, 7, (5, 6, 7)), grid=volume(rng).grid))
    (tmp_path / "labels.json").write_text('{"1": "liver"}')
    with pytest.raises(FileProblem, match="no voxel of a bone"):
        read_template(tmp_path)
    (tmp_path / "labels.json").write_text('{"femur": "1"}')
    with pytest.raises(FileProblem, match="not a table"):
        read_template(tmp_path)
    with pytest.raises(FileProblem, match="is not a folder"):
        read_template(tmp_path / "labels.nii.gz")


def test_the_real_series_reads_with_its_place(shared):
    read = read_volume(shared / "data" / "knee" / "mese")
    assert read.intensity.shape == (24, 256, 256)
    np.testing.assert_allclose(read.grid.spacing_mm, [0.625, 0.625, 4.0], atol=1e-3)
    np.testing.assert_allclose(np.linalg.det(read.grid.lps_from_voxel[:3, :3] / read.grid.spacing_mm), 1, atol=1e-3)


@pytest.mark.slow
def test_markers_can_be_written_after_a_volume_was_read(tmp_path):
    code = f"""
import numpy as np
from marey.io.mr.volumes import write_labels
from marey.knee.space.volume import VoxelGrid, Labels
grid = VoxelGrid(shape=(4, 4, 4), lps_from_voxel=np.eye(4))
write_labels({str(tmp_path)!r}, Labels(labels=np.zeros((4, 4, 4)), grid=grid))
from marey.io.markers.c3d import write_c3d
from marey.io.opensim.trc import PointPaths
paths = PointPaths(names=("a",), rate=100.0, time=np.arange(3) / 100, points=np.zeros((3, 1, 3)))
for _ in range(100):
    write_c3d({str(tmp_path)!r} + "/points.c3d", paths)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_the_locale_stays_what_it_was_when_a_series_is_read(tmp_path):
    before = locale.setlocale(locale.LC_ALL)
    write_series(tmp_path / "series", list(range(6)))
    assert locale.setlocale(locale.LC_ALL) == before
    read_volume(tmp_path / "series")
    assert locale.setlocale(locale.LC_ALL) == before


@pytest.mark.parametrize("level", [0.0, 7.0])
def test_a_constant_image_is_rejected(tmp_path, level):
    grid = VoxelGrid(shape=(5, 6, 7), lps_from_voxel=np.eye(4))
    write_volume(tmp_path / "even.nii.gz", Volume(intensity=np.full(grid.shape, level), grid=grid))
    with pytest.raises(FileProblem, match=f"the same value {level:g} in all voxels"):
        read_volume(tmp_path / "even.nii.gz")


def test_an_image_far_below_zero_is_rejected(tmp_path, rng):
    grid = VoxelGrid(shape=(6, 7, 8), lps_from_voxel=np.eye(4))
    write_volume(tmp_path / "ct.nii.gz", Volume(intensity=rng.uniform(-1000, 1200, grid.shape), grid=grid))
    with pytest.raises(FileProblem, match="as in CT"):
        read_volume(tmp_path / "ct.nii.gz")
    write_volume(tmp_path / "mr.nii.gz", Volume(intensity=rng.uniform(-2, 1200, grid.shape), grid=grid))
    assert read_volume(tmp_path / "mr.nii.gz").intensity.min() < 0


@pytest.mark.parametrize("ending", ["nii", "nii.gz", "nrrd"])
@pytest.mark.parametrize("lost", [np.nan, np.inf])
def test_values_that_are_not_finite_are_counted(tmp_path, rng, lost, ending):
    grid = volume(rng).grid
    intensity = rng.uniform(0, 100, grid.shape)
    intensity[3, 4, 3:6] = lost
    write_volume(tmp_path / f"holes.{ending}", Volume(intensity=intensity, grid=grid))
    with pytest.raises(FileProblem, match=rf"3 of {intensity.size} voxels .* not finite"):
        read_volume(tmp_path / f"holes.{ending}")


def test_an_nrrd_with_a_line_of_impossible_length_is_refused(tmp_path, rng):
    path = tmp_path / "image.nrrd"
    write_volume(path, volume(rng))
    content = path.read_bytes()
    path.write_bytes(content.replace(b"space directions: ", b"space directions: " + b"[" * 3000))
    with pytest.raises(FileProblem, match="has a line of more than 1000 characters in its header"):
        read_volume(path)
