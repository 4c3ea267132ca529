"""Walks that were measured before: their curves over the gait cycle, parameters and verdicts."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.errors import FileProblem
from marey.io.results.gait import read_cycle_bands, read_event_csv, read_gait_cycles_csv
from marey.motion.events.curves import CYCLE_POINTS, CycleCurves, CycleMark, cycle_marks, cycles_of_side, side_of
from marey.motion.events.cycles import gait_cycles
from marey.motion.events.summaries import GaitSummary, summarise_gait
from marey.pipelines.run_record import record_of
from marey.pipelines.verdict import Verdict

CURVES_FILE = "cycles.csv"
"""The table of curves over the cycle."""
_EVENTS_FILE, _PARAMETERS_FILE = "events.csv", "gait_cycles.csv"
"""The tables of events, and of the parameters of each cycle."""
LEAST_REFERENCES = 2
"""Smallest number of reference walks: with one, its own distance from the others is not known."""
_HEADING = "pelvis_rotation"
"""The angle that contains the direction of walking."""


@dataclass(frozen=True, eq=False, kw_only=True)
class MeasuredWalk:
    """The results of one walk."""

    folder: Path
    """Folder of the results."""
    label: str
    """Name of the walk: that of its folder."""
    curves: CycleCurves
    """Angles over the cycle; the rotation of the pelvis is relative to its mean, because it contains the direction of
    walking."""
    parameters: tuple[GaitSummary, ...]
    """Spatio-temporal parameters; none if the heels are not known."""
    marks: tuple[CycleMark, ...]
    """Events in the mean cycle."""
    command: str
    """The command that measured the walk, for example `capture`; empty if it is not known."""
    verdict: Verdict | None
    """The verdict on the results; None for results of an earlier version."""

    @property
    def angles(self) -> dict[str, Floats]:
        """Mean curves (101,) of the angles, by their names without unit [degrees]; those that are complete."""
        return _complete_angles(dict(zip(self.curves.names, self.curves.mean.T, strict=True)))

    @property
    def files(self) -> tuple[Path, ...]:
        """The files that were read."""
        names = (CURVES_FILE, _EVENTS_FILE, _PARAMETERS_FILE)
        return tuple(path for path in (self.folder / name for name in names) if path.is_file())


def read_walk(path: Path | str) -> MeasuredWalk:
    """Read the results of a walk.

    Args:
        path: Folder with the results of `marey capture` or `marey markers`, or the trial whose results are in `marey/`.

    Raises:
        FileProblem: There is no walk with a complete gait cycle, or a table is damaged.
    """
    folder = walk_folder(path)
    events = _EVENTS_FILE
    if not (folder / events).is_file():
        raise FileProblem(folder, f"has {CURVES_FILE} and no {events}", "Run the command that measured the walk again.")
    bands = _without_heading(read_cycle_bands(folder / CURVES_FILE))
    found = read_event_csv(folder / events)
    cycles = gait_cycles(found)
    own = {name: cycles_of_side(cycles, side_of(name)) for name in bands}
    curves = CycleCurves(
        names=tuple(bands), mean=_columns(bands.values(), 0), spread=_columns(bands.values(), 1),
        counts=tuple(len(own[name]) if np.isfinite(band[:, 0]).all() else 0 for name, band in bands.items()),
        sides=tuple(own[name][0].side if own[name] else None for name in bands),
    )  # fmt: skip
    parameters = folder / _PARAMETERS_FILE
    record = record_of(folder, CURVES_FILE)
    return MeasuredWalk(
        folder=folder, label=_label(folder), curves=curves,
        parameters=summarise_gait(read_gait_cycles_csv(parameters)) if parameters.is_file() else (),
        marks=cycle_marks(cycles, found), command=str(record.get("command", "")), verdict=Verdict.from_record(record),
    )  # fmt: skip


def read_references(folder: Path | str, *, without: Iterable[Path] = ()) -> tuple[MeasuredWalk, ...]:
    """Read all reference walks of a folder.

    Args:
        folder: Folder with the results of the walks in folders of their own, at any depth.
        without: Folders with results that are not references.

    Returns:
        The walks, in the order of their folders.

    Raises:
        FileProblem: There are fewer than two, or a table is damaged.
    """
    return tuple(read_walk(each) for each in reference_folders(Path(folder), without=without))


def reference_folders(folder: Path, *, without: Iterable[Path] = ()) -> Sequence[Path]:
    """List the folders with reference walks.

    Args:
        folder: Folder with the results of the walks in folders of their own, at any depth.
        without: Folders with results that are not references.

    Raises:
        FileProblem: It is no folder, or there are fewer than two.
    """
    if not folder.is_dir():
        raise FileProblem(folder, "is not a folder", "Give the folder that holds the results of your reference walks.")
    excluded = {path.resolve() for path in without}
    folders = sorted(path.parent for path in folder.rglob(CURVES_FILE) if path.parent.resolve() not in excluded)
    if len(folders) < LEAST_REFERENCES:
        wrong = f"has the results of {len(folders)} reference walks and should have at least {LEAST_REFERENCES}"
        remedy = f"Each of them is a folder with {CURVES_FILE}, by `marey capture` or `marey markers`."
        raise FileProblem(folder, wrong, remedy)
    return folders


def walk_folder(path: Path | str) -> Path:
    """Return the folder with the curves of a walk: the given one, or its `marey/`.

    Args:
        path: Folder with the results of a walk, or the trial whose results are in `marey/`.

    Raises:
        FileProblem: Neither has curves over the cycle.
    """
    path = Path(path)
    for folder in (path, path / "marey"):
        if (folder / CURVES_FILE).is_file():
            return folder
    wrong = f"has no {CURVES_FILE}" if path.is_dir() else "is not a folder"
    raise FileProblem(path, wrong, "Give the results of a walk with at least one complete gait cycle.")


def mean_curves(folder: Path) -> dict[str, Floats]:
    """Read the mean curves (101,) of the angles of a walk, by their names without unit [degrees].

    Args:
        folder: Folder with the results of the walk.

    Returns:
        The complete curves; the rotation of the pelvis is relative to its mean.

    Raises:
        FileProblem: The table is missing or damaged.
    """
    bands = _without_heading(read_cycle_bands(folder / CURVES_FILE))
    return _complete_angles({name: band[:, 0] for name, band in bands.items()})


def _complete_angles(means: Mapping[str, Floats]) -> dict[str, Floats]:
    """Return the curves (101,) of angles without gaps, by their names without unit."""
    return {
        name.removesuffix("_deg"): mean for name, mean in means.items()
        if name.endswith("_deg") and np.isfinite(mean).all()
    }  # fmt: skip


def _without_heading(bands: Mapping[str, Floats]) -> dict[str, Floats]:
    """Take the rotation of the pelvis relative to its mean over the cycle."""
    return {
        name: band - [band[:, 0].mean(), 0.0] if name.removesuffix("_deg") == _HEADING else band
        for name, band in bands.items()
    }  # fmt: skip


def _columns(bands: Iterable[Floats], column: int) -> Floats:
    """Return one column of all bands (101, N)."""
    return np.array([band[:, column] for band in bands]).reshape(-1, CYCLE_POINTS).T


def _label(folder: Path) -> str:
    """Return the name of a walk: that of the folder with its results, or of the trial that they are in."""
    folder = folder.resolve()
    return folder.parent.name if folder.name == "marey" else folder.name
