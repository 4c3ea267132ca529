"""`markers.json`: the markers of an MR volume, with what a user wrote of them; and landmarks picked in it."""

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.errors import FileProblem, MareyError
from marey.knee.anatomical_frames import Landmarks
from marey.knee.marker_naming import ScannerMarkers

_RIGHT = (
    "It holds marker_centres_lps_mm and marker_centres_sd_mm (lists of M x 3), and may hold marker_names (M labels of "
    "the laboratory, null where unknown) and marker_segment (M of femur, tibia, patella or null)."
)
_LANDMARKS_RIGHT = 'It holds {"landmarks_lps_mm": {"LE": [x, y, z], ...}}; docs/knee-markers.md names them.'


def read_scanner_markers(path: Path | str) -> ScannerMarkers:
    """Read `markers.json`.

    Args:
        path: The file, as `marey knee segment` leaves it, or as a user completed it.

    Raises:
        FileProblem: It is missing or damaged, holds no markers, or its lists do not fit together.
    """
    path = Path(path)
    table = _table(path, "`marey knee segment` writes it when it finds markers.", _RIGHT)
    places, sd = (_list_of_places(path, table, f"marker_centres_{what}") for what in ("lps_mm", "sd_mm"))
    if not len(places):
        raise FileProblem(path, "holds no marker", "No balls were found in the volume; add them by hand to the file.")
    if not (sd > 0).all():
        raise FileProblem(path, "has a standard deviation that is not above 0", _RIGHT)
    try:
        return ScannerMarkers(
            centres_mm=places, sd_mm=sd, names=_texts(path, table, "marker_names", len(places)),
            bones=_texts(path, table, "marker_segment", len(places)),
        )  # fmt: skip
    except MareyError as problem:
        raise FileProblem(path, f"cannot be used: {problem}".rstrip("."), _RIGHT) from None


def read_landmarks(path: Path | str) -> Landmarks:
    """Read `landmarks.json`: landmarks picked by hand in the scanner's images.

    Args:
        path: The file: `landmarks_lps_mm`, name to [x, y, z].

    Raises:
        FileProblem: It is missing or damaged, or a place is none.
    """
    path = Path(path)
    named = _table(path, "", _LANDMARKS_RIGHT).get("landmarks_lps_mm")
    if not isinstance(named, dict) or not named:
        raise FileProblem(path, "holds no landmarks_lps_mm", _LANDMARKS_RIGHT)
    places = {str(name): _numbers(at) for name, at in named.items()}
    wrong = [name for name, at in places.items() if at.shape != (3,)]
    if wrong:
        raise FileProblem(path, f"has no three numbers for {', '.join(wrong)}", _LANDMARKS_RIGHT)
    return Landmarks(places_mm=places)


def _table(path: Path, missing: str, right: str) -> Mapping[str, object]:
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise FileProblem(path, "is not there", missing) from error
    except (OSError, ValueError) as error:
        raise FileProblem(path, "is no JSON", right) from error
    if not isinstance(table, dict):
        raise FileProblem(path, "is no table", right)
    return table


def _numbers(values: object) -> Floats:
    """Give an array of finite numbers; an empty one of no shape that fits where they are none."""
    try:
        array = np.array(values, float)
    except (TypeError, ValueError):
        return np.zeros((0, 0, 0))
    return array if np.isfinite(array).all() else np.zeros((0, 0, 0))


def _list_of_places(path: Path, table: Mapping[str, object], key: str) -> Floats:
    if key not in table:
        raise FileProblem(path, f"lacks {key}", _RIGHT)
    if table[key] == []:
        return np.zeros((0, 3))
    values = _numbers(table[key])
    if values.ndim != 2 or values.shape[1] != 3:
        raise FileProblem(path, f"has a {key} that is no list of three numbers each", _RIGHT)
    return values


def _texts(path: Path, table: Mapping[str, object], key: str, count: int) -> tuple[str | None, ...]:
    values = table.get(key)
    if values is None:
        return ()
    if not isinstance(values, list) or len(values) != count:
        raise FileProblem(path, f"has a {key} that is no list of {count}, one a marker", _RIGHT)
    return tuple(str(value) if value else None for value in values)
