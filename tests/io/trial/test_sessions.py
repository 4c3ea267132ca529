"""Recordings of a board, and its description, in the folders of other programs."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.clips import numbered_picture, write_video

from marey.calibration.boards.board import CalibrationBoard
from marey.errors import FileProblem
from marey.io.trial.sessions import open_calibration_session, session_target


def session_board(folder: Path) -> tuple[Path, CalibrationBoard]:
    path, target = session_target(folder, None, lambda file, up: {})
    assert isinstance(target.moved, CalibrationBoard)
    assert target.landmarks == ()
    return path, target.moved


def write_each(folder, names, suffix=".mp4"):
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        write_video(folder / f"{name}{suffix}", 3)


def write_pictures(folder, count):
    folder.mkdir(parents=True)
    for number in range(count):
        cv2.imwrite(str(folder / f"cam_{number}_int.png"), numbered_picture(number))


def test_the_videos_that_trial_toml_names_are_the_session(tmp_path):
    write_each(tmp_path, ("GX010042", "GX010017"), suffix=".mp4")
    (tmp_path / "trial.toml").write_text('[videos]\nleft = "GX010042.mp4"\nright = "GX010017.mp4"\n')
    session = open_calibration_session(tmp_path)
    assert session.names == ("left", "right")
    (tmp_path / "trial.toml").write_text('[videos]\n"../left" = "GX010042.mp4"\n')
    with pytest.raises(FileProblem, match="a camera that has a name that is a path"):
        open_calibration_session(tmp_path)
    (tmp_path / "trial.toml").write_text('[videos]\nleft = "GX.mp4"\n')
    with pytest.raises(FileProblem, match=r"GX.mp4: does not exist"):
        open_calibration_session(tmp_path)


def test_a_project_of_caliscope_has_its_session_and_board(tmp_path):
    write_each(tmp_path / "calibration" / "extrinsic", ("cam_0", "cam_1"))
    write_each(tmp_path / "recordings" / "walk", ("cam_0", "cam_1"))
    board = tmp_path / "calibration" / "targets" / "extrinsic_charuco.toml"
    board.parent.mkdir()
    text = 'columns = 4\nrows = 5\nboard_height = 10\nboard_width = 8\nunits = "inch"\naruco_scale = 0.75\n'
    board.write_text(text + 'dictionary = "DICT_4X4_50"\ninverted = true\nlegacy_pattern = false\nthickness_cm = 0.3\n')
    assert open_calibration_session(tmp_path).names == ("cam_0", "cam_1")
    path, found = session_board(tmp_path)
    assert path == board
    assert (found.kind, found.columns, found.rows) == ("charuco", 4, 5)
    assert np.allclose([found.square, found.marker, found.thickness], [0.0508, 0.0381, 0.003])
    assert found.two_sided
    assert found.inverted
    board.write_text(text + 'dictionary = "DICT_4X4_50"\nsquare_size_override_cm = 5.4\n')
    assert np.isclose(session_board(tmp_path)[1].square, 0.054)


POSE2SIM = """
[calibration.calculate.intrinsics]
intrinsics_corners_nb = [4, 7]
intrinsics_square_size = 60
"""


@pytest.mark.parametrize("part", ["intrinsics", "extrinsics"])
def test_a_project_of_pose2sim_has_its_session_and_board(tmp_path, part):
    for number in (1, 2):
        write_pictures(tmp_path / "calibration" / part / f"{part[:3]}_cam{number:02d}_img", 4)
    write_each(tmp_path / "videos", ("cam01", "cam02"))
    (tmp_path / "Config.toml").write_text(POSE2SIM)
    session = open_calibration_session(tmp_path)
    assert session.names == ("cam01", "cam02")
    assert not session.videos
    assert [each.instants for each in session.clips] == [(0, 1, 2, 3)] * 2
    board = session_board(tmp_path)[1]
    assert (board.kind, board.columns, board.rows, board.square) == ("chessboard", 8, 5, 0.06)


def test_pictures_of_a_scene_are_not_a_session(tmp_path):
    for number in (1, 2):
        write_pictures(tmp_path / "calibration" / "extrinsics" / f"ext_cam{number:02d}_img", 1)
        folder = tmp_path / "calibration" / "intrinsics" / f"int_cam{number:02d}_img"
        write_each(folder, ("board",))
    session = open_calibration_session(tmp_path)
    assert session.videos
    assert session.names == ("cam01", "cam02")


def test_a_session_of_opencap_has_its_board(tmp_path):
    for camera in ("Cam0", "Cam1"):
        for recording in ("calibration", "walk"):
            write_each(tmp_path / "Videos" / camera / "InputMedia" / recording, ("a-b-c",), suffix=".mov")
    text = "checkerBoard:\n  black2BlackCornersHeight_n: 4\n  black2BlackCornersWidth_n: 5\n"
    (tmp_path / "sessionMetadata.yaml").write_text(text + "  squareSideLength_mm: 35.0\n")
    session = open_calibration_session(tmp_path)
    assert session.names == ("Cam0", "Cam1")
    assert all("calibration" in str(each.clip.path) for each in session.clips)
    board = session_board(tmp_path)[1]
    assert (board.columns, board.rows, board.square) == (6, 5, 0.035)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("Config.toml", "[project]\n", "describes no board"),
        ("Config.toml", POSE2SIM.replace("60", '"60"'), "describes no board"),
        ("Config.toml", POSE2SIM.replace("60", "-60"), "describes no usable board"),
        ("Config.toml", POSE2SIM.replace("[4, 7]", "[4]"), "describes no board"),
        ("Config.toml", POSE2SIM.replace("60", "nan"), "describes no usable board"),
        ("charuco.toml", "columns = 4\n", "describes no board"),
        ("config.toml", "[charuco]\ncolumns = 1e400\nrows = 3\n", "describes no board"),
        ("sessionMetadata.yaml", "checkerBoard: none\n", "describes no board"),
        ("sessionMetadata.yaml", "height_m: 1.8\n", "describes no board"),
    ],
)
def test_a_wrong_description_is_named(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    with pytest.raises(FileProblem, match=message) as caught:
        session_board(tmp_path)
    assert name in str(caught.value)


def test_the_board_of_marey_has_priority(tmp_path):
    (tmp_path / "Config.toml").write_text(POSE2SIM)
    (tmp_path / "board.json").write_text('{"columns": 9, "rows": 6, "square_m": 0.1}')
    assert session_board(tmp_path)[0].name == "board.json"
    with pytest.raises(FileProblem, match=r"has no board.json or board.toml"):
        session_board(tmp_path / "nowhere")


def test_what_caliscope_writes_is_read(tmp_path):
    charuco = pytest.importorskip("caliscope.core.charuco")
    theirs = charuco.Charuco.from_squares(6, 9, 5.4, dictionary="DICT_4X4_100", aruco_scale=0.7, thickness_cm=0.2)
    theirs.to_toml(tmp_path / "calibration" / "targets" / "intrinsic_charuco.toml")
    board = session_board(tmp_path)[1]
    assert (board.columns, board.rows) == (6, 9)
    assert np.allclose([board.square, board.marker, board.thickness], [0.054, 0.0378, 0.002])
