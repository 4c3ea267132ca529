"""Reading of deforming points from NPZ and marker files: tracks in images, or points in space."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.errors import FileProblem, SettingProblem
from marey.io.markers.readers import read_markers
from marey.io.markers.results import is_y_up
from marey.io.npz import read_arrays
from marey.nonrigid.recovered import UNKNOWN_UNIT
from marey.wording import listed

_REMEDY = (
    "An NPZ should have `tracks` (frames, 2, points) or (cameras, frames, 2, points), or `points` (frames, 3, points)."
)
"""Remedy in the error messages: the expected arrays."""
_SHAPES = {
    "tracks": "(frames, 2, points), or (cameras, frames, 2, points) of several cameras",
    "points": "(frames, 3, points)",
}
"""Expected shape of each array, for the error messages."""
_LARGEST = 1e9
"""Largest position [px or m]; larger numbers are no positions, and their squares could not be held. Chosen by hand."""
_USED = ("tracks", "points", "predicted", "edges", "rate", "labels")
"""Keys of an NPZ that are read; others are reported as ignored."""
_OF_MARKERS = (".c3d", ".trc", ".csv", ".tsv")
"""File name extensions of marker files."""


@dataclass(frozen=True, eq=False, kw_only=True)
class DeformingPoints:
    """The contents of a file of deforming points; exactly one of `tracks` and `points` is given."""

    tracks: Floats | None = None
    """(C, F, 2, P) positions in the images [px]; NaN where missing."""
    points: Floats | None = None
    """(F, P, 3) positions in space, in `unit`; NaN where missing."""
    unit: str
    """Unit of `points`: m, or "unit of the input"."""
    labels: tuple[str, ...]
    """P names; numbers where the file has none."""
    edges: Integers
    """(E, 2) indices of the points that are joined by a line in drawings."""
    rate: float | None = None
    """Sampling rate [Hz]; None where the file has none."""
    y_up: bool = False
    """Whether Y points up in space; otherwise Z does."""
    notes: tuple[str, ...] = ()
    """Remarks on what was ignored or assumed, one sentence each."""


def read_deforming(path: Path) -> DeformingPoints:
    """Read tracks or points.

    Args:
        path: An NPZ with `tracks` or `points`, and if there are any `edges` (E, 2), `rate` (Hz), `labels` (P,) and
            `predicted` (F, P), true where a position was not observed; or a C3D, TRC or CSV with markers.

    Raises:
        FileProblem: The file has another format, or its contents cannot be used.
    """
    if path.suffix.lower() in _OF_MARKERS:
        return _from_markers(path)
    if path.suffix.lower() != ".npz":
        raise FileProblem(path, "has an unknown format", f"Give videos, an NPZ or a C3D. {_REMEDY}")
    return deforming_points(path, read_arrays(path))


def deforming_points(path: Path, arrays: dict[str, np.ndarray]) -> DeformingPoints:
    """Check the arrays of an NPZ, or arrays in memory, and combine them.

    Args:
        path: The file, or a name for arrays in memory, for the error messages.
        arrays: Arrays as described by `read_deforming`.

    Raises:
        FileProblem: The arrays cannot be used.
    """
    held = [name for name in ("tracks", "points") if name in arrays]
    if len(held) != 1:
        contained = listed(arrays, none="nothing")
        wrong = "has both tracks and points" if held else f"has neither tracks nor points, but {contained}"
        raise FileProblem(path, wrong, _REMEDY)
    values = _numbers(path, held[0], arrays[held[0]])
    if held[0] == "points":
        notes, points, tracks = _incomplete_remark(values, 1), np.moveaxis(values, 1, 2), None
    else:
        whole = values if values.ndim == 4 else values[None]
        notes, points, tracks = _incomplete_remark(whole, 2), None, _observed(path, whole, arrays)
        if "predicted" in arrays:
            notes.append("Positions that are marked as predicted are treated as missing.")
    count = values.shape[-1]
    unused = [name for name in arrays if name not in _USED and not name.endswith("_sd") and name != "visible"]
    if unused:
        notes.append(f"Ignored arrays of {path.name}: {', '.join(unused)}.")
    return DeformingPoints(
        tracks=tracks, points=points, unit=UNKNOWN_UNIT, labels=_labels(path, arrays, count),
        edges=_edges(path, arrays, count), rate=_rate(path, arrays), notes=tuple(notes),
    )  # fmt: skip


def with_labels(data: DeformingPoints, patterns: Sequence[str]) -> DeformingPoints:
    """Keep the points whose labels match one of the patterns, and the edges between them.

    Args:
        data: The points.
        patterns: Labels, or patterns with * and ?.

    Raises:
        SettingProblem: A pattern matches no label.
    """
    fits = {pattern: [fnmatchcase(label, pattern) for label in data.labels] for pattern in patterns}
    lost = [pattern for pattern, found in fits.items() if not any(found)]
    if lost:
        known = ", ".join(data.labels[:12]) + (" ..." if len(data.labels) > 12 else "")
        raise SettingProblem(f"only (--only) has {', '.join(lost)}, which matches no point. The points are {known}.")
    kept = np.any(list(fits.values()), axis=0)
    number = np.cumsum(kept) - 1
    return replace(
        data, tracks=None if data.tracks is None else data.tracks[..., kept],
        points=None if data.points is None else data.points[:, kept],
        labels=tuple(label for label, wanted in zip(data.labels, kept, strict=True) if wanted),
        edges=number[data.edges[kept[data.edges].all(1)]],
    )  # fmt: skip


def _from_markers(path: Path) -> DeformingPoints:
    read = read_markers(path)
    return DeformingPoints(
        points=read.points, unit="m", labels=read.labels, edges=np.zeros((0, 2), np.int64), rate=read.rate,
        y_up=is_y_up(path), notes=read.notes,
    )  # fmt: skip


def _numbers(path: Path, name: str, values: np.ndarray) -> Floats:
    """Check the type and shape of an array, and return it as float64."""
    rows, dims = ("23"[name == "points"], (3,) if name == "points" else (3, 4))
    fits = values.ndim in dims and values.shape[-2] == int(rows) and values.shape[-1] > 0 and values.shape[-3] > 0
    if values.dtype.kind not in "iuf" or not fits:
        turned = (
            " Its last two axes seem to be exchanged." if values.ndim in dims and values.shape[-1] == int(rows) else ""
        )
        wrong = f"has {name} of shape {values.shape} and type {values.dtype}"
        raise FileProblem(path, wrong, f"They should be numbers of shape {_SHAPES[name]}.{turned}")
    values = values.astype(float)
    if np.isinf(values).any():
        raise FileProblem(path, f"has infinite values in {name}", "Write NaN where a point is missing.")
    if np.abs(values, where=np.isfinite(values), out=np.zeros(values.shape)).max(initial=0) > _LARGEST:
        wrong = f"has values above {_LARGEST:g} in {name}"
        raise FileProblem(path, wrong, "Pixels and lengths are smaller. Write NaN where a point is missing.")
    if not np.isfinite(values).any():
        raise FileProblem(path, f"has no valid value in {name}: all are NaN", "Give a file with observed points.")
    return values


def _incomplete_remark(values: Floats, axis: int) -> list[str]:
    """Return a remark on positions with some but not all coordinates; they are treated as missing."""
    known = np.isfinite(values)
    half = int((known.any(axis) & ~known.all(axis)).sum())
    return [f"{half} positions have an incomplete set of coordinates and are treated as missing."] if half else []


def _observed(path: Path, tracks: Floats, arrays: dict[str, np.ndarray]) -> Floats:
    """Return the tracks with NaN where a position was predicted or is incomplete."""
    seen: Mask = np.asarray(np.isfinite(tracks).all(2))
    if "predicted" in arrays:
        predicted = np.asarray(arrays["predicted"])
        if predicted.size != seen.size or predicted.dtype.kind not in "biu":
            raise FileProblem(
                path, f"has predicted of shape {predicted.shape}", f"The shape should be {seen.shape[1:]}."
            )
        seen &= ~predicted.astype(bool).reshape(seen.shape)
    return np.where(seen[:, :, None], tracks, np.nan)


def _labels(path: Path, arrays: dict[str, np.ndarray], count: int) -> tuple[str, ...]:
    if "labels" not in arrays:
        return tuple(map(str, range(count)))
    labels = tuple(map(str, np.ravel(arrays["labels"])))
    if len(labels) != count or len(set(labels)) != count:
        raise FileProblem(
            path, f"has {len(set(labels))} different labels for {count} points", "Give each point a label of its own."
        )
    return labels


def _edges(path: Path, arrays: dict[str, np.ndarray], count: int) -> Integers:
    edges = np.asarray(arrays.get("edges", np.zeros((0, 2), np.int64)))
    if edges.ndim != 2 or edges.shape[1] != 2 or edges.dtype.kind not in "iuf":
        raise FileProblem(path, f"has edges of shape {edges.shape}", "They should be whole numbers (edges, 2).")
    whole = edges.astype(np.int64)
    if (whole != edges).any() or (whole < 0).any() or (whole >= count).any():
        raise FileProblem(path, "has edges to points that do not exist", f"Points are numbered from 0 to {count - 1}.")
    return whole


def _rate(path: Path, arrays: dict[str, np.ndarray]) -> float | None:
    if "rate" not in arrays:
        return None
    rate = np.asarray(arrays["rate"])
    if rate.size != 1 or rate.dtype.kind not in "iuf" or not (np.isfinite(rate).all() and float(rate.item()) > 0):
        raise FileProblem(
            path, f"has the rate {rate.tolist()}", "It should be one positive number, in frames per second."
        )
    return float(rate.item())
