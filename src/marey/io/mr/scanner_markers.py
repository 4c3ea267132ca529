"""The scanner's markers as the correspondence takes them, and landmarks picked by hand in its images."""

import json
from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.errors import FileProblem, MareyError
from marey.io.mr.gadolinium import read_markers
from marey.knee.markers.anatomical_frames import Landmarks
from marey.knee.markers.marker_naming import ScannerMarkers

_LANDMARKS_RIGHT = 'It holds {"landmarks_lps_mm": {"LE": [x, y, z], ...}}; docs/how-to/knee-markers.md names them.'


def read_scanner_markers(path: Path | str) -> ScannerMarkers:
    """Read `markers.json` with what a user wrote into it.

    Args:
        path: The file, as `marey knee segment` leaves it, or as a user completed it.

    Raises:
        FileProblem: It is missing or damaged, holds no markers, or what is said of them cannot be.
    """
    read = read_markers(path)
    if not len(read.centres_mm):
        raise FileProblem(path, "holds no marker", "No balls were found in the volume; add them by hand to the file.")
    # An empty text is how one leaves a name out by hand.
    names, bones = (tuple(value or None for value in said) for said in (read.names, read.bones))
    try:
        return ScannerMarkers(centres_mm=read.centres_mm, sd_mm=read.sd_mm, names=names, bones=bones)
    except MareyError as problem:
        wrong = f"cannot be used: {problem}".rstrip(".")
        raise FileProblem(path, wrong, "docs/how-to/knee-markers.md describes the file.") from None


def read_landmarks(path: Path | str) -> Landmarks:
    """Read `landmarks.json`: landmarks picked by hand in the scanner's images.

    Args:
        path: The file: `landmarks_lps_mm`, name to [x, y, z].

    Raises:
        FileProblem: It is missing or damaged, or a place is none.
    """
    path = Path(path)
    try:
        named = json.loads(path.read_text(encoding="utf-8")).get("landmarks_lps_mm")
    except FileNotFoundError as error:
        raise FileProblem(path, "is not there", _LANDMARKS_RIGHT) from error
    except (OSError, ValueError, AttributeError) as error:
        raise FileProblem(path, "is no table of JSON", _LANDMARKS_RIGHT) from error
    if not isinstance(named, dict) or not named:
        raise FileProblem(path, "holds no landmarks_lps_mm", _LANDMARKS_RIGHT)
    places = {str(name): _numbers(at) for name, at in named.items()}
    wrong = [name for name, at in places.items() if at.shape != (3,)]
    if wrong:
        raise FileProblem(path, f"has no three numbers for {', '.join(wrong)}", _LANDMARKS_RIGHT)
    return Landmarks(places_mm=places)


def _numbers(values: object) -> Floats:
    """Give an array of finite numbers; an empty one of no shape that fits where they are none."""
    try:
        array = np.array(values, float)
    except (TypeError, ValueError):
        return np.zeros((0, 0, 0))
    return array if np.isfinite(array).all() else np.zeros((0, 0, 0))
