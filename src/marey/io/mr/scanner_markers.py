"""Reading of the scanner's markers for the correspondence, and of landmarks picked by hand in MR images."""

from pathlib import Path

from marey.errors import FileProblem, MareyError
from marey.io.documents import finite, read_json_table
from marey.io.mr.gadolinium import read_markers
from marey.knee.markers.anatomical_frames import Landmarks
from marey.knee.markers.marker_naming import ScannerMarkers

_LANDMARKS_REMEDY = 'Expected is {"landmarks_lps_mm": {"LE": [x, y, z], ...}}; docs/how-to/knee-markers.md names them.'
"""Remedy in the error messages on `landmarks.json`: the expected content."""


def read_scanner_markers(path: Path | str) -> ScannerMarkers:
    """Read `markers.json` with the names and bones added by hand.

    Args:
        path: The file, as written by `marey knee segment` or completed by hand.

    Raises:
        FileProblem: The file is missing or damaged, contains no markers, or has inconsistent names or bones.
    """
    read = read_markers(path)
    if not len(read.centres_mm):
        raise FileProblem(path, "contains no marker", "None were detected in the volume: add them to the file by hand.")
    # An empty text is a name left out by hand.
    names, bones = (tuple(value or None for value in values) for values in (read.names, read.bones))
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
        FileProblem: The file is missing or damaged, or a landmark does not have three finite coordinates.
    """
    path = Path(path)
    named = read_json_table(path, _LANDMARKS_REMEDY).get("landmarks_lps_mm")
    if not isinstance(named, dict) or not named:
        raise FileProblem(path, "has no landmarks_lps_mm", _LANDMARKS_REMEDY)
    places = {str(name): finite(at, (3,)) for name, at in named.items()}
    wrong = [name for name, at in places.items() if at is None]
    if wrong:
        raise FileProblem(path, f"does not have three numbers for {', '.join(wrong)}", _LANDMARKS_REMEDY)
    return Landmarks(places_mm={name: at for name, at in places.items() if at is not None})
