"""Reading of what is filmed in a calibration: a board or wand, and points with known coordinates."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from marey.calibration.boards.board import CalibrationBoard
from marey.calibration.boards.detection import known_dictionary
from marey.calibration.boards.wand import CalibrationTarget, CalibrationWand, Landmark, NoTarget
from marey.errors import FileProblem, SettingProblem
from marey.io.calibration.board import Length, board_content, board_of_content
from marey.io.documents import Number

_WAND_REMEDY = (
    'A wand needs type = "wand" and distances_m (one or two distances between neighbouring balls or tags), for balls '
    "colours, and for tags wand_tags (their numbers) and dictionary."
)
"""Remedy in the error messages: the expected keys of a wand."""
_POINTS_REMEDY = (
    "Points need points (name = [x, y, z] in metres), tags (number = [x, y, z], with dictionary) or markers (a C3D or "
    "TRC file), and for named points and markers pixels (camera: name = [x, y])."
)
"""Remedy in the error messages: the expected keys of points with known coordinates."""
Place = tuple[Number, Number, Number]
"""Coordinates [m]."""
MarkerReader = Callable[[Path, str], Mapping[str, Place]]
"""Returns the places of the static markers of a file by their labels, with the axis of the file that points up."""


class _PointsTable(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    points: dict[str, Place] = {}
    tags: dict[int, Place] = {}
    dictionary: str = ""
    markers: str = ""
    markers_up: Literal["z", "y"] = "z"
    sd_m: Annotated[Number, Field(gt=0, lt=1)] = 1e-3
    pixels: dict[str, dict[str, tuple[Number, Number]]] = {}
    pixel_sd: Annotated[Number, Field(gt=0, lt=100)] = 1.0


class _WandTable(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    type: str
    distances_m: list[Length]
    colours: list[str] = ["bright"]
    ball_m: Annotated[Number, Field(ge=0, lt=1)] = 0.0
    wand_tags: list[int] = []
    dictionary: str = ""


@dataclass(frozen=True, eq=False, kw_only=True)
class SessionTarget:
    """What is filmed in a calibration."""

    moved: CalibrationTarget
    """The board or wand that is moved about."""
    landmarks: tuple[Landmark, ...]
    """Points with known coordinates."""
    dictionary: str
    """OpenCV's name of the dictionary of the tags among them."""
    pixels: Mapping[tuple[str, str], tuple[float, float]]
    """Pixels that were picked, by camera and name of the point."""
    pixel_sd: float
    """Their standard deviation [px]."""


def read_target(path: Path, points: Path | None, markers: MarkerReader) -> SessionTarget:
    """Read the description of a board or wand, and of points with known coordinates.

    Args:
        path: `board.json` or `board.toml`; the points may be in its table `landmarks`.
        points: A file with the points alone.
        markers: Reader of static markers.

    Returns:
        The board or wand, and the points.

    Raises:
        FileProblem: A file cannot be read, or its content is incomplete or impossible.
    """
    content = board_content(path)
    inner = content.pop("landmarks", None)
    if inner is not None and points is not None:
        raise FileProblem(path, "has landmarks, and a file of points was given as well", "Give only one of them.")
    kind = "".join(letter for letter in str(content.get("type", "")).lower() if letter.isalnum())
    moved: CalibrationTarget
    if kind == "wand":
        moved = _wand(path, content)
    elif kind == "points" and len(content) == 1:
        moved = NoTarget()
    else:
        moved = board_of_content(path, content)
    if points is not None:
        return replace(_points(points, board_content(points), markers), moved=moved)
    if inner is None and isinstance(moved, NoTarget):
        raise FileProblem(path, "has type points, but no table landmarks", _POINTS_REMEDY)
    found = _points(path, inner if isinstance(inner, dict) else {}, markers) if inner is not None else _nothing()
    return replace(found, moved=moved)


def target_of_board(board: CalibrationBoard, points: Path | None, markers: MarkerReader) -> SessionTarget:
    """Return a session with a known board.

    Args:
        board: The board.
        points: A file with points of known coordinates.
        markers: Reader of static markers.

    Returns:
        The board, and the points.

    Raises:
        FileProblem: The file of points cannot be read, or its content is incomplete or impossible.
    """
    found = _nothing() if points is None else _points(points, board_content(points), markers)
    return replace(found, moved=board)


def _nothing() -> SessionTarget:
    return SessionTarget(moved=NoTarget(), landmarks=(), dictionary="", pixels={}, pixel_sd=1.0)


def _wand(path: Path, content: dict[str, Any]) -> CalibrationWand:
    try:
        given = _WandTable.model_validate(content)
    except ValidationError as error:
        raise _wrong_value(path, error, _WAND_REMEDY) from error
    try:
        if given.wand_tags:
            known_dictionary(given.dictionary)
        return CalibrationWand(
            distances=tuple(given.distances_m), colours=tuple(given.colours), diameter=given.ball_m,
            tags=tuple(given.wand_tags), dictionary=given.dictionary,
        )  # fmt: skip
    except SettingProblem as error:
        raise FileProblem(path, f"describes no usable wand: {str(error).rstrip('.')}", _WAND_REMEDY) from error


def _wrong_value(path: Path, error: ValidationError, remedy: str) -> FileProblem:
    first = error.errors()[0]
    key = ".".join(str(part) for part in first["loc"]) or "the file"
    why = first["msg"].lower().removeprefix("value error, ")
    return FileProblem(path, f"has a wrong value at '{key}': {why}", remedy)


def _points(path: Path, content: dict[str, Any], markers: MarkerReader) -> SessionTarget:
    try:
        given = _PointsTable.model_validate(content)
    except ValidationError as error:
        raise _wrong_value(path, error, _POINTS_REMEDY) from error
    places = dict(given.points)
    if given.markers:
        places |= markers(path.parent / given.markers, given.markers_up)
    if given.tags:
        try:
            known_dictionary(given.dictionary)
        except SettingProblem as error:
            raise FileProblem(path, f"has no usable dictionary: {str(error).rstrip('.')}", _POINTS_REMEDY) from error
    named = [Landmark(name=name, place=place, sd=given.sd_m) for name, place in places.items()]
    tags = [Landmark(name=f"tag {k}", place=place, sd=given.sd_m, tag=k) for k, place in given.tags.items()]
    picked = {(camera, name): pixel for camera, of in given.pixels.items() for name, pixel in of.items()}
    unknown = sorted({name for _, name in picked if name not in places})
    if unknown:
        raise FileProblem(path, f"has pixels of '{unknown[0]}', whose coordinates are missing", _POINTS_REMEDY)
    marked = {name for _, name in picked}
    named = [each for each in named if each.name in marked]
    every = (*named, *tags)
    if not every:
        raise FileProblem(path, "has no point with coordinates and pixels, and no tag", _POINTS_REMEDY)
    if not all(np.isfinite(each.place).all() for each in every):
        raise FileProblem(path, "has a coordinate that is not a number", _POINTS_REMEDY)
    return SessionTarget(
        moved=NoTarget(), landmarks=every, dictionary=given.dictionary, pixels=picked, pixel_sd=given.pixel_sd
    )  # fmt: skip

