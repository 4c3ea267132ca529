"""Descriptions of boards: what is read, and which faults are named."""

import json
from pathlib import Path

import pytest

from marey.calibration.boards.board import CalibrationBoard
from marey.errors import FileProblem
from marey.io.calibration.board import board_content, board_file, board_of_content

CHARUCO = {
    "type": "ChArUco", "columns": 9, "rows": 6, "dictionary": "DICT_5X5_250", "square_m": 0.1, "marker_m": 0.075,
}  # fmt: skip


def read_board(path: Path) -> CalibrationBoard:
    return board_of_content(path, board_content(path))


def written(folder: Path, content: object, name: str = "board.json") -> Path:
    path = folder / name
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def test_a_charuco_board_is_read(tmp_path: Path):
    board = read_board(written(tmp_path, CHARUCO | {"inverted": True, "two_sided": True}))
    assert (board.kind, board.columns, board.rows, board.square, board.marker) == ("charuco", 9, 6, 0.1, 0.075)
    assert board.inverted
    assert board.points.shape == (2 * 8 * 5, 3)


def test_a_chessboard_is_read_by_its_inner_corners(tmp_path: Path):
    path = written(tmp_path, "inner_corners = [9, 6]\nsquare_m = 0.01\nsquare_is_assumed = true\n", "board.toml")
    board = read_board(path)
    assert (board.kind, board.columns, board.rows) == ("chessboard", 10, 7)
    assert board.square_assumed
    assert board.points.shape == (54, 3)


def test_a_grid_of_markers_is_read(tmp_path: Path):
    given = {"type": "AprilTag grid", "columns": 3, "rows": 2, "marker_m": 0.08, "gap_m": 0.02}
    board = read_board(written(tmp_path, given | {"dictionary": "APRILTAG_36H11"}))
    assert board.points.shape == (24, 3)
    assert board.extent.tolist() == pytest.approx([0.28, 0.18])
    assert board.points[5].tolist() == pytest.approx([0.18, 0.0, 0.0])


@pytest.mark.parametrize(
    ("content", "text"),
    [
        ("{", "is not JSON"),
        ("[1]", "is not a table"),
        ({"type": "wood"}, "unknown type 'wood'"),
        ({"type": "ChArUco", "columns": 9, "rows": 6}, "has no square_m and no marker_m and no dictionary"),
        (CHARUCO | {"square_m": 100.0}, "wrong value at 'square_m'"),
        (CHARUCO | {"colums": 3}, "wrong value at 'colums'"),
        (CHARUCO | {"marker_m": 0.2}, "must be smaller"),
        (CHARUCO | {"dictionary": "DICT_9X9"}, "no dictionary 'DICT_9X9'"),
    ],
)
def test_faults_are_named_in_one_line(tmp_path: Path, content: object, text: str):
    with pytest.raises(FileProblem, match=text) as caught:
        read_board(written(tmp_path, content))
    assert "\n" not in str(caught.value)


def test_a_folder_without_a_board_is_named(tmp_path: Path):
    with pytest.raises(FileProblem, match=r"has no board\.json or board\.toml"):
        board_file(tmp_path)
    path = written(tmp_path, CHARUCO)
    assert board_file(tmp_path) == path
