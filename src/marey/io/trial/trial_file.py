"""Writing of trial.toml: the calibration and the videos of the cameras."""

from collections.abc import Mapping
from pathlib import Path

from marey.errors import FileProblem
from marey.io.atomic import replacing
from marey.io.calibration.readers import toml_text
from marey.io.documents import read_text, tables_of_text

TRIAL_FILE = "trial.toml"
"""Name of the file in the folder of a trial."""
_HEAD = "# Settings of this trial; all keys are optional, such as stature_m = 1.80 or frames = [0, 300].\n"
"""First line of a new file."""


def write_trial_file(folder: Path, *, videos: Mapping[str, str], calibration: str | None = None) -> Path:
    """Write the videos of the cameras, and the calibration, to trial.toml; what is in it stays.

    Args:
        folder: The trial; it is created if it does not exist.
        videos: Path of each camera's video, relative to the trial.
        calibration: Path of the calibration, relative to the trial; None to leave it out.

    Returns:
        The file.

    Raises:
        FileProblem: The file has these keys already, or cannot be read or written.
    """
    path = folder / TRIAL_FILE
    text = read_text(path, "It should be a TOML file.") if path.exists() else _HEAD
    known = tables_of_text(path, text)
    there = [key for key, wanted in (("videos", videos), ("calibration", calibration)) if wanted and key in known]
    if there:
        wrong = f"has {' and '.join(there)} already"
        raise FileProblem(path, wrong, "Remove them to write a new proposal, or give --print to see it.")
    if calibration is not None:
        text = _with_top_line(text, f"calibration = {toml_text(calibration)}\n")
    if videos:
        lines = [f"{toml_text(camera)} = {toml_text(video)}" for camera, video in videos.items()]
        text = text.rstrip("\n") + "\n\n# The video of each camera.\n[videos]\n" + "\n".join(lines) + "\n"
    with replacing(path) as beside:
        beside.write_text(text, encoding="utf-8")
    return path


def _with_top_line(text: str, line: str) -> str:
    """Insert a line after the comments at the beginning, where it belongs to no table and to no list."""
    lines = text.splitlines(keepends=True)
    at = next((number for number, each in enumerate(lines) if not each.lstrip().startswith("#")), len(lines))
    if lines and not lines[-1].endswith("\n"):
        lines[-1] += "\n"
    return "".join([*lines[:at], line, *lines[at:]])
