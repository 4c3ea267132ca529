"""Reading marker trajectories from C3D, TRC and CSV, in metres and the file's own axes."""

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.errors import FileProblem
from marey.io.markers.c3d import open_c3d, point_unit, positions_in
from marey.io.markers.marker_csv import RawMarkers, even_rate, read_marker_csv
from marey.io.opensim.trc import read_trc
from marey.io.units import METRES, require_unit
from marey.markers.data.trajectories import MarkerTrajectories

_SMALLEST, _LARGEST = 0.02, 50.0
"""Plausible extent of the markers of a frame [m], from a finger to a sports hall; chosen by hand."""


def read_markers(path: Path | str, *, unit: str | None = None) -> MarkerTrajectories:
    """Read the trajectories of markers from a C3D, TRC or CSV.

    The axes are the file's own. A point that is missing in the file (empty, NaN, all three coordinates zero, or with a
    residual below zero) is NaN. The prefix of a subject (`Subject:LASI`) is removed if the labels remain unique without
    it. Two trajectories with the same label cannot be distinguished: both are skipped, unless one of them is empty.
    Unlabelled trajectories keep the file's `*110`. `notes` reports what was skipped or decided.

    Args:
        path: The file.
        unit: mm, cm or m, if the file states it wrongly or not at all.

    Returns:
        The trajectories in metres.

    Raises:
        FileProblem: The file cannot be read, has no markers or no frames, or states an impossible unit.
    """
    path = Path(path)
    readers: dict[str, Callable[[Path, str | None], RawMarkers]] = {
        ".c3d": _from_c3d, ".trc": _from_trc, ".csv": read_marker_csv, ".tsv": read_marker_csv,
    }  # fmt: skip
    if path.suffix.lower() not in readers:
        raise FileProblem(path, "is not a file of markers", "Give a C3D, TRC or CSV.")
    require_unit(unit)
    return checked_markers(path, readers[path.suffix.lower()](path, unit))


def checked_markers(path: Path, raw: RawMarkers) -> MarkerTrajectories:
    """Check the content of a file and remove ambiguous trajectories; see `read_markers`.

    Args:
        path: The file, for error messages.
        raw: The content of the file.

    Raises:
        FileProblem: The file has no markers or no frames, or its unit is impossible.
    """
    labels, points, residuals, rate, start_s, unit, reading_notes = raw
    points = np.where((points == 0).all(-1, keepdims=True), np.nan, points)
    residuals = np.where(np.isfinite(points).all(-1), residuals, np.nan)
    if not len(points) or not len(labels):
        raise FileProblem(path, "has no markers" if len(points) else "has no frames", "Export the trial again.")
    if not np.isfinite(points).all(-1).any():
        wrong = "has no measured point: every marker is missing in every frame"
        raise FileProblem(path, wrong, "Export the trial again.")
    if not (np.isfinite(rate) and rate > 0):
        raise FileProblem(path, f"has a rate of {rate:g} Hz", "Export the trial with the rate of the cameras.")
    _require_possible(path, points, unit)
    labels, kept, notes, people = _distinct(labels, points)
    return MarkerTrajectories(
        labels=labels, points=points[:, kept], rate=rate, start_s=start_s, residuals=residuals[:, kept],
        filled=np.zeros((len(points), len(kept)), bool), notes=(*reading_notes, *notes), people=people,
    )  # fmt: skip


def _from_c3d(path: Path, unit: str | None) -> RawMarkers:
    c3d = open_c3d(path)
    return positions_in(c3d, unit or point_unit(path, c3d))


def _from_trc(path: Path, unit: str | None) -> RawMarkers:
    """Read a TRC in its own axes."""
    paths, own = read_trc(path, file_from_world=np.eye(3)), _trc_unit(path)
    points = paths.points * (METRES[unit] / METRES[own] if unit else 1.0)
    rate, notes = paths.rate, []
    if len(paths.time) > 1:
        measured, _ = even_rate(path, paths.time)
        if not abs(measured - rate) <= 0.01 * rate:
            notes = [f"The header states {rate:g} Hz, but the times correspond to {measured:g} Hz, which is used."]
            rate = measured
    start = float(paths.time[0]) if len(paths.time) else 0.0
    return list(paths.names), points, np.full(points.shape[:2], np.nan), rate, start, unit or own, notes


def _trc_unit(path: Path) -> str:
    lines = path.read_text(encoding="utf-8").splitlines()
    return dict(zip(lines[1].split(), lines[2].split(), strict=False))["Units"].lower()


def _require_possible(path: Path, points: Floats, unit: str) -> None:
    """Reject a unit for which the extent of the markers is impossible."""
    seen = np.isfinite(points).all(-1).sum(1) > 1
    if not seen.any():
        return
    low, high = (pick(points[seen], axis=1) for pick in (np.nanmin, np.nanmax))
    extent = float(np.median(np.linalg.norm(high - low, axis=-1)))
    if _SMALLEST <= extent <= _LARGEST:
        return
    fitting = [name for name, metres in METRES.items() if _SMALLEST <= extent * metres / METRES[unit] <= _LARGEST]
    likely = f" The numbers look like {' or '.join(fitting)}." if fitting else ""
    wrong = f"states that its unit is {unit}, for which its markers would extend over {_with_unit(extent)}"
    raise FileProblem(path, wrong, f"Correct the unit in the file, or give the unit (--unit).{likely}")


def _with_unit(metres: float) -> str:
    return f"{metres * 1e3:.3g} mm" if metres < 1 else f"{metres:.4g} m"


def _distinct(
    labels: Sequence[str], points: Floats
) -> tuple[tuple[str, ...], list[int], list[str], tuple[str, ...]]:  # fmt: skip
    """Return unique labels, the indices of their trajectories, notes on what was skipped, and removed names."""
    labels, notes = [label.strip() for label in labels], []
    bare = [label.rpartition(":")[2].strip() or label for label in labels]
    full, prefixes = Counter(labels), list[str]()
    if bare != labels and Counter(bare).most_common(1)[0][1] <= full.most_common(1)[0][1]:
        prefixes = sorted({label.rpartition(":")[0] for label in labels} - {""})
        notes.append(f"The prefix {', '.join(prefixes)} is removed from the labels.")
        labels = bare
    there, count = np.asarray(np.isfinite(points).all(-1).any(0)), Counter(labels)
    kept = [n for n, label in enumerate(labels) if count[label] == 1]
    for label in [label for label, times in count.items() if times > 1]:
        alike = [n for n, other in enumerate(labels) if other == label and there[n]]
        if len(alike) == 1:
            kept.append(alike[0])
        elif alike:
            notes.append(f"{len(alike)} trajectories have the same label {label}; none of them is used.")
    kept.sort()
    return tuple(labels[n] for n in kept), kept, notes, tuple(prefixes)
