import json
from importlib.util import find_spec

import numpy as np
import pytest
from tests.made_knees import made_grid, made_labels, made_volume, signed_shapes

from marey.cli.knee import INCOMPLETE, with_seeds_joined
from marey.cli.knee_segment import SegmentOptions, given_seeds, parse_seed
from marey.cli.main import run
from marey.errors import SettingProblem
from marey.io.volumes import write_labels, write_volume
from marey.knee.bones import Bone, BoneSegmentation
from marey.knee.structures import LABELS
from marey.knee.template_fit import Placement, TemplateFit
from marey.knee.volume import Labels, Volume

if find_spec("SimpleITK") is None:
    pytest.skip("SimpleITK is not installed", allow_module_level=True)


def volume() -> Volume:
    grid = made_grid((4.0, 4.0, 5.0), flip=True)
    return Volume(intensity=np.zeros(grid.shape), grid=grid)


def test_four_words_of_a_seed_become_one_and_negative_numbers_stay():
    typed = [
        "knee",
        "segment",
        "a.nii",
        "--seed",
        "femur",
        "-3.5",
        "2",
        "-1",
        "--seed-voxel",
        "tibia",
        "1",
        "2",
        "3",
        "-q",
    ]
    joined = ["knee", "segment", "a.nii", "--seed", "femur -3.5 2 -1", "--seed-voxel", "tibia 1 2 3", "-q"]
    assert with_seeds_joined(typed) == joined
    assert with_seeds_joined(joined) == joined
    assert with_seeds_joined(["capture", "--seed", "a", "b"]) == ["capture", "--seed", "a", "b"]


def test_seeds_are_places_or_voxels():
    options = SegmentOptions(
        out=None, template=None, seeds=(("femur", 1.0, 2.0, 3.0),), seed_voxels=(("tibia", 4.0, 5.0, 6.0),)
    )
    seeds = given_seeds(options, volume())
    np.testing.assert_allclose(seeds["femur"], [1, 2, 3])
    np.testing.assert_allclose(seeds["tibia"], volume().grid.lps(np.array([4.0, 5, 6])))


def test_wrong_seeds_say_what_would_be_right():
    with pytest.raises(SettingProblem, match="no bone and three numbers"):
        parse_seed("femur 1 2", "--seed")
    for seeds, wrong in (((("fibula", 1.0, 2.0, 3.0),), "no bone"), ((("femur", 1.0, 2.0, 3.0),) * 2, "two seeds")):
        with pytest.raises(SettingProblem, match=wrong):
            given_seeds(SegmentOptions(out=None, template=None, seeds=seeds, seed_voxels=()), volume())


def test_an_image_of_no_knee_leaves_nothing_behind(tmp_path, capsys, rng):
    grid = made_grid((4.0, 4.0, 5.0))
    write_volume(tmp_path / "noise.nii.gz", Volume(intensity=rng.uniform(5, 60, grid.shape), grid=grid))
    assert run(["knee", "segment", str(tmp_path / "noise.nii.gz"), "-q"]) == 2
    assert "No femur above a tibia" in capsys.readouterr().err
    assert [file.name for file in tmp_path.iterdir()] == ["noise.nii.gz"]
    assert run(["knee", "segment", str(tmp_path / "missing.nii.gz"), "-q"]) == 2
    assert "is not there" in capsys.readouterr().err


def found_bones(volume: Volume) -> BoneSegmentation:
    """Bones as if they had been found, without the patella."""
    shapes = {bone: signed_shapes(volume.grid)[bone] for bone in ("femur", "tibia")}
    bones = {
        name: Bone(distance_mm=each, grid=volume.grid, seed_mm=np.array([0.0, 0, 30])) for name, each in shapes.items()
    }
    placements = {name: Placement(matrix=np.eye(3), shift=np.zeros(3)) for name in bones}
    labels = made_labels(volume.grid).labels * (made_labels(volume.grid).labels < LABELS["patella"])
    return BoneSegmentation(
        labels=Labels(labels=labels, grid=volume.grid), bones=bones, kinds=("dark",),
        template_fit=TemplateFit(placements=placements, mirrored=False, fit=0.9), notes=(),
    )  # fmt: skip


def test_what_is_not_found_is_said_in_the_results_and_by_the_exit_code(tmp_path, capsys, monkeypatch):
    volume = made_volume(made_grid((2.0, 2.0, 2.5)), "dark")
    write_volume(tmp_path / "knee.nii.gz", volume)
    labels = made_labels(volume.grid).labels.copy()
    # A speck that is called cartilage, far from any bone.
    labels[:3, :3, :3] = LABELS["femoral_cartilage"]
    write_labels(tmp_path / "template", Labels(labels=labels, grid=volume.grid))
    monkeypatch.setattr("marey.cli.knee_segment.segment_bones", lambda volumes, **_: found_bones(volumes[0]))
    out = tmp_path / "out"
    typed = ["knee", "segment", str(tmp_path / "knee.nii.gz"), "--template", str(tmp_path / "template")]
    assert run([*typed, "--out", str(out), "-q"]) == INCOMPLETE
    missing = json.loads((out / "labels.json").read_text(encoding="utf-8"))["missing"]
    assert list(missing) == ["patella", "femoral_cartilage"]
    assert "does not lie on the bone" in missing["femoral_cartilage"]
    assert json.loads((out / "run.json").read_text(encoding="utf-8"))["settings"]["missing"] == missing
    assert "Not found: patella, femoral_cartilage" in capsys.readouterr().err
    assert sorted(file.name for file in out.iterdir()) == [
        "femur.ply", "labels.json", "labels.nii.gz", "report.html", "run.json", "tibia.ply",
    ]  # fmt: skip


def test_a_folder_that_cannot_be_written_is_told_before_the_work(tmp_path, capsys, monkeypatch):
    write_volume(tmp_path / "knee.nii.gz", made_volume(made_grid((4.0, 4.0, 5.0)), "dark"))
    (tmp_path / "file").write_text("in the way", encoding="utf-8")
    monkeypatch.setattr("marey.cli.knee_segment.segment_bones", lambda *_, **__: pytest.fail("it began to work"))
    assert run(["knee", "segment", str(tmp_path / "knee.nii.gz"), "--out", str(tmp_path / "file"), "-q"]) == 2
    assert "cannot be made" in capsys.readouterr().err


def test_an_interrupted_run_leaves_nothing_behind(tmp_path, monkeypatch):
    write_volume(tmp_path / "knee.nii.gz", made_volume(made_grid((4.0, 4.0, 5.0)), "dark"))

    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("marey.cli.knee_segment.segment_bones", interrupt)
    assert run(["knee", "segment", str(tmp_path / "knee.nii.gz"), "-q"]) == 130
    assert [file.name for file in tmp_path.iterdir()] == ["knee.nii.gz"]
