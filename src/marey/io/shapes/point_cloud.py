"""Writing of coloured point clouds as binary PLY."""

from pathlib import Path

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.io.atomic import replacing


def write_point_cloud(
    path: Path | str, points: Floats, colours: np.ndarray, *, comment: str, edges: Integers | None = None
) -> None:
    """Write points with their colours, and edges between them, in single precision.

    Args:
        path: The file.
        points: (N, 3) positions; those that are NaN are omitted, together with their edges.
        colours: (N, 3) red, green and blue from 0 to 255.
        comment: Comment in the header: the unit and the axes.
        edges: (E, 2) indices of the points that are joined by a line; none by default.
    """
    known: Mask = np.asarray(np.isfinite(points).all(1))
    kept = np.zeros((0, 2), np.int64)
    if edges is not None and len(edges):
        kept = (np.cumsum(known) - 1)[edges[known[edges].all(1)]]
    channels = ("red", "green", "blue")
    rows = np.empty(int(known.sum()), [(axis, "<f4") for axis in "xyz"] + [(name, "u1") for name in channels])
    for values, names in ((points, "xyz"), (colours, channels)):
        for column, name in zip(values[known].T, names, strict=True):
            rows[name] = column
    head = ["ply", "format binary_little_endian 1.0", f"comment {comment}", f"element vertex {len(rows)}"]
    head += [f"property float {axis}" for axis in "xyz"] + [f"property uchar {name}" for name in channels]
    head += [f"element edge {len(kept)}", "property int vertex1", "property int vertex2"] if len(kept) else []
    with replacing(path) as beside, beside.open("wb") as file:
        file.write("\n".join([*head, "end_header", ""]).encode("ascii"))
        file.write(rows.tobytes() + kept.astype("<i4").tobytes())
