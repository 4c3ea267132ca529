"""A session of pictures from disk to cameras.toml, calibration.json and the page."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.made_boards import BOARD, FLOOR, MadeSession, made_rig, made_session

import marey
from marey.calibration.boards.printed import own_view, render_board
from marey.cli.main import run
from marey.io.video.pictures import write_picture

DESCRIPTION = {
    "type": "ChArUco", "columns": 9, "rows": 6, "dictionary": "DICT_5X5_250", "square_m": 0.1, "marker_m": 0.075,
}  # fmt: skip


def write_session(folder: Path, session: MadeSession) -> None:
    """Write what the cameras of a made session see, as numbered pictures."""
    folder.mkdir(parents=True)
    (folder / "board.json").write_text(json.dumps(DESCRIPTION))
    rng = np.random.default_rng(1)
    views = set(zip(session.corners.picture.tolist(), session.corners.camera.tolist(), strict=True))
    for picture, pose in enumerate(session.world_from_board):
        for number, camera in enumerate(session.rig):
            if (picture, number) not in views:
                continue
            rendered = render_board(BOARD, own_view(camera), camera.camera_from_world @ pose)
            assert rendered is not None
            ground = np.full((camera.height, camera.width), 110.0)
            x, y = rendered.corner
            height, width = rendered.grey.shape
            ground[y : y + height, x : x + width] = np.where(rendered.on_board, 35 + 180 * rendered.grey, 110.0)
            ground = cv2.GaussianBlur(ground, (0, 0), 0.6) + rng.normal(0, 2, ground.shape)
            image = np.clip(np.round(ground), 0, 255).astype(np.uint8)
            write_picture(folder / f"{camera.name}_{picture:03d}.jpg", image)


@pytest.fixture(scope="module")
def session() -> MadeSession:
    rig = made_rig(3, np.random.default_rng(6), radius=2.6)
    made = made_session(rig=rig, pictures=46, seed=6, floor=1)
    assert made.world_from_board[-1] is FLOOR
    return made


@pytest.mark.slow
def test_a_session_of_pictures_is_calibrated(tmp_path: Path, session: MadeSession):
    write_session(tmp_path / "session", session)
    found = marey.calibrate(tmp_path / "session", out=tmp_path / "out", floor="last")
    assert found.usable
    assert found.report is not None
    page = found.report.read_text(encoding="utf-8")
    assert "http" not in page.replace("http://www.w3.org", "")
    for camera in session.rig:
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
    assert marey.read_cameras(saved).names == session.rig.names


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


@pytest.mark.parametrize("option", [
    ["--floor", "never"], ["--floor", "9:3"], ["--distance", "cam01=3"], ["--distance", "a:b=inf"], ["--rate", "-1"],
])  # fmt: skip
def test_impossible_options_are_refused(tmp_path: Path, option: list[str], capsys: pytest.CaptureFixture[str]):
    assert run(["calibrate", str(tmp_path), "--quiet", *option]) == 2
    assert option[0] in capsys.readouterr().err
