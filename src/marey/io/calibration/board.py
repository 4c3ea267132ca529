"""Reading of the description of a calibration board: board.json or board.toml."""

from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from marey.calibration.boards.board import BoardKind, CalibrationBoard
from marey.calibration.boards.detection import known_dictionary
from marey.errors import FileProblem, SettingProblem
from marey.io.documents import Number, WholeNumber, read_json_table, read_tables

_NAMES = ("board.json", "board.toml")
"""File names of the description of a board, in the order in which a folder is searched."""
_KINDS: dict[str, BoardKind] = {
    "charuco": "charuco", "chessboard": "chessboard", "checkerboard": "chessboard", "aruco": "markers",
    "apriltag": "markers", "arucogrid": "markers", "apriltaggrid": "markers", "markers": "markers",
}  # fmt: skip
"""Kind of board by the words of its type, in lower case without spaces and hyphens."""
_REMEDY = (
    'It needs type ("ChArUco", "chessboard", "ArUco grid" or "AprilTag grid"), columns and rows (of squares or '
    "markers; or inner_corners = [across, down]), square_m, and for markers marker_m and dictionary (for example "
    '"DICT_5X5_250"); a grid of markers also gap_m.'
)
"""Remedy in the error messages: the expected keys of a board."""

Length = Annotated[Number, Field(gt=0, lt=10)]
_Corners = Annotated[WholeNumber, Field(ge=2, le=200)]
"""A length between 0 and 10 m; boards are given in metres, not in millimetres."""


class _BoardFile(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    type: str = "chessboard"
    columns: Annotated[WholeNumber, Field(ge=1, le=200)] | None = None
    rows: Annotated[WholeNumber, Field(ge=1, le=200)] | None = None
    inner_corners: tuple[_Corners, _Corners] | None = None
    square_m: Length | None = None
    marker_m: Length | None = None
    gap_m: Length | None = None
    thickness_m: Annotated[Number, Field(ge=0, lt=1)] = 0.0
    dictionary: str = ""
    first_marker: Annotated[WholeNumber, Field(ge=0)] = 0
    legacy_pattern: bool = False
    inverted: bool = False
    two_sided: bool = False
    square_is_assumed: bool = False


def board_file(folder: Path) -> Path:
    """Find the description of the board in a folder.

    Args:
        folder: The folder of the session.

    Raises:
        FileProblem: There is none.
    """
    for name in _NAMES:
        if (folder / name).is_file():
            return folder / name
    remedy = f'{_REMEDY} A wand has type "wand" and distances_m.'
    raise FileProblem(folder, "has no board.json or board.toml with the dimensions of the board", remedy)


def board_of_content(path: Path, content: dict[str, Any]) -> CalibrationBoard:
    """Return the board that a file describes.

    Args:
        path: The file, for error messages.
        content: Its keys and values.

    Raises:
        FileProblem: The description is incomplete or impossible.
    """
    try:
        given = _BoardFile.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"]) or "the file"
        why = first["msg"].lower().removeprefix("value error, ")
        raise FileProblem(path, f"has a wrong value at '{key}': {why}", _REMEDY) from error
    try:
        board = _board(path, given)
        if board.has_markers:
            known_dictionary(board.dictionary)
    except SettingProblem as error:
        raise FileProblem(path, f"describes no usable board: {str(error).rstrip('.')}", _REMEDY) from error
    return board


def board_content(path: Path) -> dict[str, Any]:
    """Return the keys and values of a JSON or TOML file.

    Args:
        path: The file.

    Raises:
        FileProblem: The file cannot be read, or is no table.
    """
    return read_tables(path) if path.suffix.lower() == ".toml" else read_json_table(path, _REMEDY)


def _board(path: Path, given: _BoardFile) -> CalibrationBoard:
    kind = _KINDS.get("".join(letter for letter in given.type.lower() if letter.isalnum()))
    if kind is None:
        raise FileProblem(path, f"has the unknown type '{given.type}'", _REMEDY)
    columns, rows = given.columns, given.rows
    if given.inner_corners is not None:
        columns, rows = given.inner_corners[0] + 1, given.inner_corners[1] + 1
    side = given.marker_m if kind == "markers" else given.square_m
    needed: dict[str, object] = {
        "columns": columns,
        "rows": rows,
        "marker_m" if kind == "markers" else "square_m": side,
    }
    needed |= {"marker_m": given.marker_m, "dictionary": given.dictionary or None} if kind != "chessboard" else {}
    needed |= {"gap_m": given.gap_m} if kind == "markers" else {}
    missing = [key for key, value in needed.items() if value is None]
    if missing or columns is None or rows is None or side is None:
        raise FileProblem(path, f"has no {' and no '.join(missing)}", _REMEDY)
    return CalibrationBoard(
        kind=kind, columns=columns, rows=rows, square=side, marker=given.marker_m or 0.0, gap=given.gap_m or 0.0,
        dictionary=given.dictionary, first_marker=given.first_marker, legacy=given.legacy_pattern,
        inverted=given.inverted, two_sided=given.two_sided, thickness=given.thickness_m,
        square_assumed=given.square_is_assumed,
    )  # fmt: skip
