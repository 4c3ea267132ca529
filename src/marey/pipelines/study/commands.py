"""The commands that are steps of a study, each as a function of a trial, its settings and a folder for the results."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from marey.errors import FileProblem, SettingProblem
from marey.pipelines.progress import Progress
from marey.pipelines.verdict import Verdict

Command = Callable[[Path, Mapping[str, Any], Path, Progress], Verdict | None]
"""A command: trial, settings by name with absolute paths, folder for the results, progress reporter."""


def _capture(trial: Path, settings: Mapping[str, Any], out: Path, progress: Progress) -> Verdict | None:
    from marey.pipelines.capture.tasks import capture

    return capture(_folder(trial), out=out, progress=progress, **settings).verdict


def _surface(trial: Path, settings: Mapping[str, Any], out: Path, progress: Progress) -> Verdict | None:
    from marey.pipelines.surface.tasks import measure_surface

    return measure_surface(_folder(trial), out=out, progress=progress, **settings).verdict


def _shape(trial: Path, settings: Mapping[str, Any], out: Path, progress: Progress) -> Verdict | None:
    from marey.pipelines.shape.tasks import fit_shape
    from marey.pipelines.surface.result import load_surface

    given = dict(settings)
    measured = given.pop("surface", None)
    surface = None if measured is None else load_surface(measured)
    return fit_shape(_folder(trial), surface, out=out, progress=progress, **given).verdict


def _markers(trial: Path, settings: Mapping[str, Any], out: Path, progress: Progress) -> Verdict | None:
    from marey.pipelines.markers.estimate import estimate_bones, open_markers

    given = dict(settings)
    path, method = Path(given.pop("file", trial)), given.pop("method", None)
    if path.is_dir():
        raise FileProblem(path, "is a folder", 'A step markers needs a file: set file = "{folder}/NAME.c3d".')
    opened = open_markers(path, progress=progress, **given)
    return estimate_bones(opened, method, out=out, progress=progress).verdict


def _folder(trial: Path) -> Path:
    if not trial.is_dir():
        raise FileProblem(trial, "is a file", "Only a step markers takes files: correct the pattern in study.toml.")
    return trial


COMMANDS: Mapping[str, Command] = {
    "capture": _capture, "surface": _surface, "shape": _shape, "markers": _markers,
}  # fmt: skip
"""The commands by name."""
REPORTS = ("report.html", "surface.html")
"""Names of the pages that these commands write."""


def run_command(name: str, trial: Path, settings: Mapping[str, Any], out: Path, progress: Progress) -> Verdict | None:
    """Run a command on a trial.

    Args:
        name: Name of the command.
        trial: The trial.
        settings: Settings by name, with absolute paths.
        out: Folder for the results.
        progress: Progress reporter.

    Returns:
        The verdict on the results.

    Raises:
        SettingProblem: There is no such command.
    """
    if name not in COMMANDS:
        raise SettingProblem(f"There is no command {name} for a step; there are: {', '.join(COMMANDS)}.")
    return COMMANDS[name](trial, settings, out, progress)
