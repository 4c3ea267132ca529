"""Segmenting a knee from Python: settings, labels, round trip, and what is not written."""

from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from tests.made_knees import made_grid, made_volume
from tests.segmented_once import segment_bones_once

from marey.errors import FileProblem, SettingProblem
from marey.io.mr.volumes import read_volume, write_volume
from marey.knee.space.structures import LABELS
from marey.knee.space.volume import Volume
from marey.pipelines.knee.knee import load_knee
from marey.pipelines.knee.segment import SegmentSettings, segment_knee, title_of

if find_spec("SimpleITK") is None:
    pytest.skip("SimpleITK is not installed", allow_module_level=True)


def volume() -> Volume:
    grid = made_grid((4.0, 4.0, 5.0), flip=True)
    return Volume(intensity=np.zeros(grid.shape), grid=grid)


def test_seeds_are_places_or_voxels():
    settings = SegmentSettings(seeds=(("femur", 1.0, 2.0, 3.0),), seed_voxels=(("tibia", 4.0, 5.0, 6.0),))
    seeds = settings.seeds_mm(volume())
    np.testing.assert_allclose(seeds["femur"], [1, 2, 3])
    np.testing.assert_allclose(seeds["tibia"], volume().grid.lps(np.array([4.0, 5, 6])))


def test_seeds_reach_the_segmentation_of_bones(monkeypatch):
    def given(volumes, *, seeds_mm, **_):
        np.testing.assert_array_equal(seeds_mm.pop("femur"), [1, 2, 3])
        np.testing.assert_allclose(seeds_mm.pop("tibia"), volumes[0].grid.lps(np.array([4.0, 5, 6])))
        assert seeds_mm == {}
        raise SettingProblem("as far as this")

    monkeypatch.setattr("marey.pipelines.knee.segment.segment_bones", given)
    with pytest.raises(SettingProblem, match="as far as this"):
        segment_knee(volume(), seeds={"femur": (1, 2, 3)}, seed_voxels={"tibia": (4, 5, 6)})


def test_wrong_seeds_are_named():
    femur, fibula = ("femur", 1.0, 2.0, 3.0), ("fibula", 1.0, 2.0, 3.0)
    for seeds, wrong in (((fibula,), "not one of the bones"), ((femur, femur), "two seeds")):
        with pytest.raises(SettingProblem, match=wrong):
            SegmentSettings(seeds=seeds)


@pytest.mark.parametrize(
    ("settings", "option"),
    [
        ({"seeds": (("femur", np.nan, 0.0, 0.0),)}, "--seed"), ({"seeds": (("femur", 1e9, 0.0, 0.0),)}, "--seed"),
        ({"seed_voxels": (("tibia", 0.0, -1.0, 0.0),)}, "--seed-voxel"),
    ],
)  # fmt: skip
def test_a_seed_outside_of_the_image_is_named(settings, option):
    with pytest.raises(SettingProblem, match=rf"\({option}\) lies outside the image, which has"):
        SegmentSettings(**settings).seeds_mm(volume())


def test_the_title_of_a_page_is_the_name_of_the_volume(tmp_path):
    assert title_of(tmp_path / "anna" / "image.nii.gz") == "anna"
    assert title_of(tmp_path / "anna" / "series") == "anna"
    assert title_of(tmp_path / "anna" / "dess.nii.gz") == "dess"


@pytest.fixture(scope="module")
def image() -> Volume:
    return made_volume(made_grid((2.0, 2.0, 2.5)), "dark")


@pytest.fixture(scope="module")
def path(image, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("file")
    write_volume(folder / "knee.nii.gz", image)
    return folder / "knee.nii.gz"


@pytest.fixture(scope="module")
def knee(path, tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        segment_bones_once(patch, tmp_path_factory)
        return segment_knee(path, side="left")


@pytest.mark.slow
def test_a_knee_lists_its_structures(knee):
    assert knee.bones == ("femur", "tibia", "patella")
    assert knee.side == "left"
    assert knee.thickness == {}
    for name in knee.bones:
        voxels = (knee.labels.labels == LABELS[name]).sum() * knee.labels.grid.voxel_mm3
        assert knee.surfaces[name].volume_mm3 == pytest.approx(voxels, rel=0.2)
    assert "Knee, left side" in repr(knee)
    assert "femur" in knee._repr_html_()
    assert len(knee.to_pandas()) == 0


@pytest.mark.slow
def test_what_is_saved_can_be_read_and_copied(knee, tmp_path):
    out = knee.save(tmp_path / "out")
    names = sorted(path.name for path in out.iterdir())
    assert names == ["femur.ply", "labels.json", "labels.nii.gz", "patella.ply", "report.html", "run.json", "tibia.ply"]
    read = load_knee(out)
    np.testing.assert_array_equal(read.labels.labels, knee.labels.labels)
    np.testing.assert_allclose(read.labels.grid.lps_from_voxel, knee.labels.grid.lps_from_voxel, atol=1e-4)
    np.testing.assert_allclose(read.surfaces["femur"].vertices_mm, knee.surfaces["femur"].vertices_mm, atol=1e-3)
    assert read.side == "left"
    assert str(read.summary()) == str(knee.summary())
    assert sorted(path.name for path in read.save(tmp_path / "copy").iterdir()) == names
    with pytest.raises(FileProblem, match=r"no labels\.nii\.gz"):
        load_knee(tmp_path)


@pytest.mark.slow
def test_a_file_is_segmented_without_writing_anything(image, path, knee):
    np.testing.assert_allclose(read_volume(path).intensity, image.intensity, rtol=1e-6)
    assert knee.labels.grid.shape == image.grid.shape
    assert [each.name for each in path.parent.iterdir()] == ["knee.nii.gz"]
