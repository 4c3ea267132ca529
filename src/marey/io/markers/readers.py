"""Marker trajectories from C3D, TRC and CSV, in metres and the file's own axes."""

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import ezc3d
import numpy as np

from marey.arrays import Floats
from marey.errors import FileProblem, MareyError
from marey.io.markers.c3d import METRES, open_c3d, point_labels, point_unit
from marey.io.markers.marker_csv import even_rate, read_marker_csv
from marey.io.opensim.trc import read_trc
from marey.markers.data.trajectories import MarkerTrajectories

_COMPUTED = ("ANGLES", "FORCES", "MOMENTS", "POWERS", "SCALARS")
"""Groups of a C3D's points that are no places."""
_SMALLEST, _LARGEST = 0.02, 50.0
"""Between which the markers of a frame spread [m]: a finger, a sports hall."""


def read_markers(path: Path | str, *, unit: str | None = None) -> MarkerTrajectories:
    """Read the trajectories of markers from a C3D, TRC or CSV.

    Axes are the file's own. A point that is missing in the file (empty, NaN, all three coordinates zero, or with a
    residual below zero) is NaN. A subject's prefix (`Subject:LASI`) is taken off where the labels stay different
    without it. Two trajectories with one label cannot be told apart: both are passed over, unless one of them is
    empty. Unlabelled trajectories keep the file's `*110`. What was passed over or decided stands in `notes`.

    Args:
        path: The file.
        unit: mm, cm or m, where the file says it wrong or not at all.

    Raises:
        FileProblem: It cannot be read, holds no markers or no frames, or its unit cannot be right.
    """
    path = Path(path)
    readers: dict[str, Callable[[Path, str | None], Raw]] = {
        ".c3d": _from_c3d, ".trc": _from_trc, ".csv": read_marker_csv, ".tsv": read_marker_csv,
    }  # fmt: skip
    if path.suffix.lower() not in readers:
        raise FileProblem(path, "is no file of markers that is read here", "Give a C3D, TRC or CSV.")
    _require_unit(unit)
    return _checked(path, readers[path.suffix.lower()](path, unit))


def markers_in(path: Path, c3d: ezc3d.c3d, *, unit: str) -> MarkerTrajectories:
    """Return the trajectories of markers in a C3D that is open already; see `read_markers`.

    Args:
        path: The file, for error messages.
        c3d: Its content.
        unit: Unit of its points: mm, cm or m.

    Raises:
        FileProblem: It has no markers or no frames, or its unit is impossible.
    """
    _require_unit(unit)
    return _checked(path, _places_in(c3d, unit))


def _require_unit(unit: str | None) -> None:
    if unit is not None and unit not in METRES:
        raise MareyError(f"The unit {unit!r} is not known. Known are {', '.join(METRES)}.")


def _checked(path: Path, raw: "Raw") -> MarkerTrajectories:
    labels, points, residuals, rate, start_s, unit, said = raw
    points = np.where((points == 0).all(-1, keepdims=True), np.nan, points)
    residuals = np.where(np.isfinite(points).all(-1), residuals, np.nan)
    if not len(points) or not len(labels):
        raise FileProblem(path, "holds no markers" if len(points) else "holds no frames", "Export the trial again.")
    if not np.isfinite(points).all(-1).any():
        raise FileProblem(path, "holds no measured point: every marker is missing in every frame", "Export it again.")
    if not (np.isfinite(rate) and rate > 0):
        raise FileProblem(path, f"has the rate {rate:g} Hz", "Export it with the rate of the cameras.")
    _require_possible(path, points, unit)
    labels, kept, notes = _distinct(labels, points)
    return MarkerTrajectories(
        labels=labels, points=points[:, kept], rate=rate, start_s=start_s, residuals=residuals[:, kept],
        filled=np.zeros((len(points), len(kept)), bool), notes=(*said, *notes),
    )  # fmt: skip


Raw = tuple[Sequence[str], Floats, Floats, float, float, str, list[str]]
"""Labels, points (F, M, 3) [m], residuals (F, M) [m], rate [Hz], time of the first frame [s], unit, notes."""


def _from_c3d(path: Path, unit: str | None) -> Raw:
    c3d = open_c3d(path)
    return _places_in(c3d, unit or point_unit(path, c3d))


def _places_in(c3d: ezc3d.c3d, unit: str) -> Raw:
    """Return the points of a C3D that are places."""
    point = c3d["parameters"]["POINT"]
    computed = {label for key in _COMPUTED if key in point for label in (point[key]["value"] or [])}
    labels = list(point_labels(c3d))
    labels += [f"*{n}" for n in range(len(labels), c3d["data"]["points"].shape[1])]
    kept = [n for n, label in enumerate(labels) if label not in computed]
    points = np.transpose(c3d["data"]["points"][:3, kept], (2, 1, 0)) * METRES[unit]
    residuals = np.transpose(c3d["data"]["meta_points"]["residuals"][0][kept]) * METRES[unit]
    points = np.where((residuals < 0)[..., None] | ~np.isfinite(points).all(-1, keepdims=True), np.nan, points)
    # A residual of zero is how programs write that they have none.
    residuals = np.where(residuals > 0, residuals, np.nan)
    rate = float((point["RATE"]["value"] or [0])[0])
    start = _first_frame(c3d) / rate if rate > 0 else 0.0
    notes = [f"Points that are no places (angles, forces, moments, powers): {len(computed)}."] if computed else []
    return [labels[n] or f"*{n}" for n in kept], points, residuals, rate, start, unit, notes


def _first_frame(c3d: ezc3d.c3d) -> int:
    return int(c3d["header"]["points"]["first_frame"])


def _from_trc(path: Path, unit: str | None) -> Raw:
    """Read a TRC in its own axes."""
    paths, own = read_trc(path, file_from_world=np.eye(3)), _trc_unit(path)
    points = paths.points * (METRES[unit] / METRES[own] if unit else 1.0)
    rate, notes = paths.rate, []
    if len(paths.time) > 1:
        measured, _ = even_rate(path, paths.time)
        if not abs(measured - rate) <= 0.01 * rate:
            notes = [f"The header says {rate:g} Hz, the times {measured:g} Hz; the times are taken."]
            rate = measured
    start = float(paths.time[0]) if len(paths.time) else 0.0
    return list(paths.names), points, np.full(points.shape[:2], np.nan), rate, start, unit or own, notes


def _trc_unit(path: Path) -> str:
    lines = path.read_text(encoding="utf-8").splitlines()
    return dict(zip(lines[1].split(), lines[2].split(), strict=False))["Units"].lower()


def _require_possible(path: Path, points: Floats, unit: str) -> None:
    """Refuse a unit with which the markers would lie impossibly near or far from each other."""
    seen = np.isfinite(points).all(-1).sum(1) > 1
    if not seen.any():
        return
    low, high = (pick(points[seen], axis=1) for pick in (np.nanmin, np.nanmax))
    spread = float(np.median(np.linalg.norm(high - low, axis=-1)))
    if _SMALLEST <= spread <= _LARGEST:
        return
    fitting = [name for name, metres in METRES.items() if _SMALLEST <= spread * metres / METRES[unit] <= _LARGEST]
    perhaps = f" The numbers look like {' or '.join(fitting)}." if fitting else ""
    wrong = f"says its unit is {unit}, but then its markers spread over {_plain(spread)}"
    raise FileProblem(path, wrong, f"Mend its unit, or say which it is.{perhaps}")


def _plain(metres: float) -> str:
    return f"{metres * 1e3:.3g} mm" if metres < 1 else f"{metres:.4g} m"


def _distinct(labels: Sequence[str], points: Floats) -> tuple[tuple[str, ...], list[int], list[str]]:
    """Give labels of which no two are alike, the trajectories they belong to, and what was passed over."""
    labels, notes = [label.strip() for label in labels], []
    bare = [label.rpartition(":")[2].strip() or label for label in labels]
    full = Counter(labels)
    if bare != labels and Counter(bare).most_common(1)[0][1] <= full.most_common(1)[0][1]:
        prefixes = sorted({label.rpartition(":")[0] for label in labels} - {""})
        notes.append(f"Taken off the labels: the prefix {', '.join(prefixes)}.")
        labels = bare
    there, count = np.asarray(np.isfinite(points).all(-1).any(0)), Counter(labels)
    kept = [n for n, label in enumerate(labels) if count[label] == 1]
    for label in [label for label, times in count.items() if times > 1]:
        alike = [n for n, other in enumerate(labels) if other == label and there[n]]
        if len(alike) == 1:
            kept.append(alike[0])
        elif alike:
            notes.append(f"{len(alike)} trajectories have the label {label}; none of them is used.")
    kept.sort()
    return tuple(labels[n] for n in kept), kept, notes
