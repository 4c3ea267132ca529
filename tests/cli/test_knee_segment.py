from importlib.util import find_spec

import numpy as np
import pytest
from tests.made_knees import made_grid

from marey.cli.knee import with_seeds_joined
from marey.cli.knee_segment import SegmentOptions, given_seeds, parse_seed
from marey.cli.main import run
from marey.errors import SettingProblem
from marey.io.volumes import write_volume
from marey.knee.volume import Volume

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
