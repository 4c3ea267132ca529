"""Reading and writing TRC: paths of named points, for OpenSim and motion-capture programs."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from marey.arrays import Floats, freeze_fields
from marey.errors import FileProblem
from marey.io.atomic import replacing
from marey.io.axes import OPENSIM_FROM_WORLD, change_point_axes
from marey.io.documents import require_stated_count
from marey.io.units import METRES

_KEYS = "DataRate CameraRate NumFrames NumMarkers Units OrigDataRate OrigDataStartFrame OrigNumFrames"
"""Keys of the header in their order, separated by blanks."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PointPaths:
    """Paths of named points."""

    names: tuple[str, ...]
    """Names of the N points."""
    time: Floats
    """(F,) [s]."""
    rate: float
    """Sampling rate [Hz]."""
    points: Floats
    """(F, N, 3) in the world (Z up) [m]; NaN where missing."""

    def __post_init__(self) -> None:
        freeze_fields(self, "time", "points")


def write_trc(path: Path | str, paths: PointPaths) -> None:
    """Write paths in metres and OpenSim's axes, in which a missing number is `nan`.

    Most programs would also accept empty cells, but OpenSim rejects a row that ends with one.

    Args:
        path: The file.
        paths: The paths to write.
    """
    points = change_point_axes(OPENSIM_FROM_WORLD, paths.points)
    frames, count = points.shape[:2]
    values = (f"{paths.rate:.6f}", f"{paths.rate:.6f}", frames, count, "m", f"{paths.rate:.6f}", 1, frames)
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{Path(path).name}",
        _KEYS.replace(" ", "\t"),
        "\t".join(map(str, values)),
        "Frame#\tTime\t" + "\t\t\t".join(paths.names) + "\t\t",
        "\t\t" + "\t".join(f"{axis}{n}" for n in range(1, count + 1) for axis in "XYZ"),
        "",
    ]
    for f in range(frames):
        lines.append("\t".join([str(f + 1), f"{paths.time[f]:.6f}", *(f"{v:.7f}" for v in points[f].ravel())]))
    with replacing(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


def read_trc(path: Path | str, *, file_from_world: Floats = OPENSIM_FROM_WORLD) -> PointPaths:
    """Read paths from a TRC and rotate them into the world's axes.

    Args:
        path: The file.
        file_from_world: (3, 3) rotation into the axes of the file; the identity keeps its axes.

    Returns:
        The paths.

    Raises:
        FileProblem: The file is not a TRC, or is damaged.
    """
    try:
        lines = Path(path).read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise FileProblem(path, f"cannot be read ({error})", "Give a TRC file.") from error
    if len(lines) < 5 or not lines[0].startswith("PathFileType"):
        wrong = "is not a TRC file: its first line does not begin with PathFileType"
        raise FileProblem(path, wrong, "Give a TRC file.")
    head = dict(zip(lines[1].split(), lines[2].split(), strict=False))
    unit = head.get("Units", "").strip().lower()
    if unit not in METRES:
        raise FileProblem(path, f"has the unit {unit!r}", f"Units should be one of {', '.join(METRES)}.")
    names = tuple(n.strip() for n in lines[3].split("\t")[2:] if n.strip())
    require_stated_count(path, "NumMarkers", head.get("NumMarkers"), len(names))
    width = 2 + 3 * len(names)
    rows = [(line.split("\t") + [""] * width)[:width] for line in lines[5:] if line.strip()]
    require_stated_count(path, "NumFrames", head.get("NumFrames"), len(rows))
    try:
        data = np.array([[float(c) if c.strip() else np.nan for c in row] for row in rows]).reshape(-1, width)
        rate = float(head["DataRate"])
    except (ValueError, KeyError) as error:
        raise FileProblem(path, f"has a cell that is not a number ({error})", "Correct or export it again.") from error
    points = data[:, 2:].reshape(len(data), len(names), 3) * METRES[unit]
    return PointPaths(names=names, time=data[:, 1], rate=rate, points=points @ file_from_world)
