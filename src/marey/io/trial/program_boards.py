"""The calibration boards that Pose2Sim, Caliscope and OpenCap describe in their own files."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from marey.calibration.boards.board import CalibrationBoard
from marey.errors import FileProblem, SettingProblem
from marey.io.calibration.yaml_text import read_yaml
from marey.io.documents import read_tables

_REMEDY = "Correct it there, or describe the board in board.json."
"""Remedy in the error messages."""
_INCH_M = 0.0254
"""Length of an inch [m]."""


def program_board(folder: Path) -> tuple[Path, CalibrationBoard] | None:
    """Read the board from the files of the program that made a folder.

    Args:
        folder: A project of Pose2Sim or Caliscope, or a session of OpenCap.

    Returns:
        The file, and the board; None if there is no such file.

    Raises:
        FileProblem: A file describes no usable board.
    """
    readers: tuple[tuple[str, Callable[[Path], CalibrationBoard]], ...] = (
        ("Config.toml", _of_pose2sim),
        ("calibration/targets/extrinsic_charuco.toml", _of_caliscope),
        ("calibration/targets/intrinsic_charuco.toml", _of_caliscope),
        ("calibration/targets/chessboard.toml", _chessboard_of_caliscope),
        ("charuco.toml", _of_caliscope),
        ("config.toml", _of_old_caliscope),
        ("sessionMetadata.yaml", _of_opencap),
    )
    for name, read in readers:
        path = folder / name
        # Some systems do not distinguish Config.toml of Pose2Sim from config.toml of Caliscope.
        if path.is_file() and name.rsplit("/", 1)[-1] in {each.name for each in path.parent.iterdir()}:
            try:
                return path, read(path)
            except (KeyError, TypeError, ValueError, IndexError, ArithmeticError) as error:
                raise FileProblem(path, f"describes no board (at {error})", _REMEDY) from error
            except SettingProblem as problem:
                raise FileProblem(path, f"describes no usable board: {str(problem).rstrip('.')}", _REMEDY) from problem
    return None


def _of_pose2sim(path: Path) -> CalibrationBoard:
    """Read the inner corners and squares [mm] of the board for the lenses, or else of that for the poses."""
    tables = read_tables(path)["calibration"]["calculate"]
    if "intrinsics_corners_nb" in tables.get("intrinsics", {}):
        corners = tables["intrinsics"]["intrinsics_corners_nb"]
        side = tables["intrinsics"]["intrinsics_square_size"]
    else:
        board = tables["extrinsics"]["board"]
        corners, side = board["extrinsics_corners_nb"], board["extrinsics_square_size"]
    return _chessboard(columns=int(corners[1]), rows=int(corners[0]), side=_number(side) / 1000)


def _of_caliscope(path: Path) -> CalibrationBoard:
    return _charuco(read_tables(path))


def _of_old_caliscope(path: Path) -> CalibrationBoard:
    return _charuco(read_tables(path)["charuco"])


def _charuco(table: Mapping[str, Any]) -> CalibrationBoard:
    """Convert the ChArUco board of Caliscope, whose measured squares have priority over the size of the print [cm]."""
    columns, rows = int(table["columns"]), int(table["rows"])
    measured = table.get("square_size_override_cm")
    if measured in (None, "null", 0):
        unit = _INCH_M if table.get("units", "inch") == "inch" else 0.01
        side = min(_number(table["board_height"]) / rows, _number(table["board_width"]) / columns) * unit
    else:
        side = _number(measured) / 100
    return CalibrationBoard(
        kind="charuco", columns=columns, rows=rows, square=side, marker=side * _number(table["aruco_scale"]),
        dictionary=str(table["dictionary"]), inverted=bool(table.get("inverted", False)),
        legacy=bool(table.get("legacy_pattern", False)), two_sided=_number(table.get("thickness_cm", 0)) > 0,
        thickness=_number(table.get("thickness_cm", 0)) / 100,
    )  # fmt: skip


def _chessboard_of_caliscope(path: Path) -> CalibrationBoard:
    table = read_tables(path)
    side = table.get("square_size_cm")
    known = side not in (None, "null")
    return _chessboard(
        columns=int(table["columns"]), rows=int(table["rows"]), side=_number(side) / 100 if known else 1.0, known=known
    )


def _of_opencap(path: Path) -> CalibrationBoard:
    board = read_yaml(path, _REMEDY)["checkerBoard"]
    if not isinstance(board, dict):
        raise KeyError("checkerBoard")
    columns, rows = (int(str(board[f"black2BlackCorners{side}_n"])) for side in ("Width", "Height"))
    return _chessboard(columns=columns, rows=rows, side=float(str(board["squareSideLength_mm"])) / 1000)


def _chessboard(*, columns: int, rows: int, side: float, known: bool = True) -> CalibrationBoard:
    """Return a chessboard with the given numbers of inner corners."""
    return CalibrationBoard(
        kind="chessboard", columns=columns + 1, rows=rows + 1, square=side, square_assumed=not known
    )  # fmt: skip


def _number(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"{value!r}, which is not a number")
    return float(value)
