"""`marey init` and `marey cameras`: what they print, write and refuse."""

import cv2
import pytest
from tests.clips import calibration_text, make_trial, write_video
from tests.rig_files import made_rig, write_xcp

from marey.cli.cameras import _FORMATS
from marey.cli.main import WRONG_INPUT, run
from marey.io.calibration.readers import read_rig
from marey.io.calibration.writers import FORMATS


def test_the_help_names_the_formats_that_are_written():
    assert tuple(FORMATS) == _FORMATS


def test_init_prints_and_writes_the_pairs(tmp_path, capsys):
    folder = make_trial(tmp_path)
    (folder / "cam01.mp4").rename(folder / "GX010017.MP4")
    (folder / "cam02.mp4").rename(folder / "GX010042.MP4")
    picture = tmp_path / "check.png"
    assert run(["init", str(folder), "--print", "--picture", str(picture)]) == 0
    printed = capsys.readouterr().out
    assert f"Picture: {picture}" in printed
    assert cv2.imread(str(picture)).shape == (320, 960, 3)
    assert "cam02   GX010042.MP4  64 x 48  25  12      the order: check it" in printed
    assert "Check the videos that were paired by size or order" in printed
    assert not (folder / "trial.toml").exists()
    assert run(["init", str(folder)]) == 0
    assert f"Written: {folder / 'trial.toml'}" in capsys.readouterr().out
    assert run(["init", str(folder)]) == WRONG_INPUT
    assert "trial.toml: has videos already" in capsys.readouterr().err


def test_cameras_are_listed_and_converted(tmp_path, capsys):
    write_xcp(tmp_path / "lab.xcp", made_rig(lens=()))
    assert run(["cameras", str(tmp_path)]) == 0
    assert "cam01   1280 x 720  1001.0" in capsys.readouterr().out
    out = tmp_path / "new" / "cameras.toml"
    assert run(["cameras", str(tmp_path / "lab.xcp"), "--to", "pose2sim", "--out", str(out), "--scale", "0.5"]) == 0
    assert f"Written: {out}" in capsys.readouterr().out
    once, half = read_rig(tmp_path / "lab.xcp"), read_rig(out)
    assert abs(half["cam01"].centre * 2 - once["cam01"].centre).max() < 1e-9


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--to", "theia", "--out", "{}/a"], "There is no format 'theia'"),
        (["--to", "pose2sim"], "there is no path (--out)"),
        (["--out", "{}/a.toml"], "there is no format (--to): one of pose2sim"),
        (["--scale", "0"], "The scale (--scale) is 0.0"),
        (["--scale", "nan"], "The scale (--scale) is nan"),
        (["--scale", "1e300"], "The scale (--scale) is 1e+300; it should be from 1e-09 to 1e+09"),
        (["--to", "pose2sim", "--out", "{}/cameras.toml"], "cameras.toml: already exists"),
    ],
)
def test_a_wrong_conversion_is_one_line_and_writes_nothing(tmp_path, capsys, options, message):
    (tmp_path / "cameras.toml").write_text(calibration_text(("cam01", "cam02")))
    before = sorted(tmp_path.iterdir())
    code = run(["cameras", str(tmp_path), *(option.format(tmp_path) for option in options)])
    error = capsys.readouterr().err
    assert code == WRONG_INPUT
    assert message in error
    assert error.count("\n") == 1
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize("command", ["init", "cameras", "capture", "sync", "calibrate"])
@pytest.mark.parametrize("given", ["nowhere", "x" * 300, "file", "empty"])
def test_a_wrong_folder_is_one_line(tmp_path, capsys, command, given):
    (tmp_path / "file").write_text("")
    (tmp_path / "empty").mkdir()
    assert run([command, str(tmp_path / given)]) == WRONG_INPUT
    error = capsys.readouterr().err
    assert error.startswith("marey: ")
    assert error.count("\n") == 1
    assert {path.name for path in tmp_path.iterdir()} == {"file", "empty"}
    assert not list((tmp_path / "empty").iterdir())


def test_videos_that_cannot_be_read_are_named(tmp_path, capsys):
    folder = make_trial(tmp_path)
    (folder / "cam02.mp4").write_bytes(b"no video")
    assert run(["init", str(folder)]) == WRONG_INPUT
    assert "cam02.mp4: cannot be opened as a video" in capsys.readouterr().err
    write_video(folder / "cam02.mp4", 3)
    (folder / "trial.toml").write_text("[videos]\ncam01 = 'nowhere.mp4'\n")
    assert run(["capture", str(folder)]) == WRONG_INPUT
    assert "nowhere.mp4: does not exist, but is the video of 'cam01'" in capsys.readouterr().err
