"""A session of pictures from disk to cameras.toml, calibration.json and the page."""

import json
from pathlib import Path

import numpy as np
import pytest
from tests.pipelines.calibrate.board_pictures import DESCRIPTION, CalibratedSession
from tests.verdicts import agreed_verdict

import marey
from marey.cli.main import run
from marey.io.video.pictures import write_picture


@pytest.mark.slow
def test_a_session_of_pictures_is_calibrated(tmp_path: Path, calibrated_session: CalibratedSession):
    found = calibrated_session.found
    assert found.usable
    assert agreed_verdict(calibrated_session.out / "run.json", page=found.report) == found.verdict
    assert found.report is not None
    page = found.report.read_text(encoding="utf-8")
    assert "http" not in page.replace("http://www.w3.org", "")
    for camera in calibrated_session.made.rig:
        own = found.cameras[camera.name]
        assert own.matrix[0, 0] == pytest.approx(camera.matrix[0, 0], rel=2e-3)
        np.testing.assert_allclose(own.centre, camera.centre, atol=0.01)
    data = found.data
    assert data["world"] == "floor"
    assert len(data["covariance"]["parameters"]) == 45
    assert found.covariance.shape == (45, 45)
    assert np.linalg.eigvalsh(found.covariance).min() > -1e-9
    saved = found.save(tmp_path / "copy")
    assert {path.name for path in saved.iterdir()} == {
        "cameras.toml",
        "calibration.json",
        "calibration.html",
        "run.json",
    }
    assert marey.read_cameras(saved).names == calibrated_session.made.rig.names


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({}, "has neither videos nor numbered pictures"),
        ({"type": "wood"}, "unknown type"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], change: dict[str, str], text: str
):
    folder = tmp_path / "session"
    folder.mkdir()
    (folder / "board.json").write_text(json.dumps(DESCRIPTION | change))
    if change:
        write_picture(folder / "cam01_1.png", np.zeros((60, 80, 3), np.uint8))
    assert run(["calibrate", str(folder), "--quiet"]) == 2
    error = capsys.readouterr().err
    assert text in error
    assert error.count("\n") == 1
    assert not (folder / "marey").exists()


def test_pictures_without_the_board_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    folder = tmp_path / "session"
    folder.mkdir()
    (folder / "board.json").write_text(json.dumps(DESCRIPTION))
    for name in ("cam01_1.png", "cam02_1.png"):
        write_picture(folder / name, np.full((120, 160, 3), 90, np.uint8))
    assert run(["calibrate", str(folder), "--quiet"]) == 2
    assert "shows no ChArUco board of 9 x 6 squares of 100 mm" in capsys.readouterr().err


def test_a_file_of_the_user_is_reported_before_the_work(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    folder, own = tmp_path / "session", tmp_path / "out" / "calibration.json"
    folder.mkdir()
    own.parent.mkdir()
    own.write_text("my own", encoding="utf-8")
    (folder / "board.json").write_text(json.dumps(DESCRIPTION))
    for name in ("cam01_1.png", "cam02_1.png"):
        write_picture(folder / name, np.full((120, 160, 3), 90, np.uint8))
    assert run(["calibrate", str(folder), "--quiet", "--out", str(own.parent)]) == 2
    assert "calibration.json: cannot be written (marey did not write what has this name)" in capsys.readouterr().err
    assert own.read_text(encoding="utf-8") == "my own"


@pytest.mark.parametrize("option", [
    ["--floor", "never"], ["--floor", "9:3"], ["--distance", "cam01=3"], ["--distance", "a:b=inf"], ["--rate", "-1"],
])  # fmt: skip
def test_impossible_options_are_refused(tmp_path: Path, option: list[str], capsys: pytest.CaptureFixture[str]):
    assert run(["calibrate", str(tmp_path), "--quiet", *option]) == 2
    assert option[0] in capsys.readouterr().err
