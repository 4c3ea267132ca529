"""Data of the 3-D view of markers: markers and bones over time, upright and scaled to the view."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Mask
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.data.marker_motion import MarkerMotion
from marey.view.pages.curves import COLOURS
from marey.view.pages.html import packed
from marey.view.pictures.palette import OTHER

_MOST_PLACES = 150_000
"""Number of vectors (one per marker and four per bone and frame) that the view contains at most, about 2.5 MB; of more
frames every second, third, ... one is shown. Chosen by hand for small files."""
_LEGEND = (
    "Dots are markers in the colour of their segment, grey without a segment; small dots are filled gaps. The three "
    "lines at the origin of a bone are its axes, X (red), Y (green), Z (blue); thin lines join the origin to the "
    "markers of its segment. What has no value in a frame is not drawn."
)
"""Legend of the view."""


@dataclass(frozen=True, eq=False, kw_only=True)
class MarkerPaths:
    """The markers that the view shows, over the F frames of the trial."""

    labels: Sequence[str]
    """M labels."""
    points: Floats
    """(F, M, 3) positions in the laboratory [m]; NaN where a marker is missing."""
    filled: Mask
    """(F, M) true where a point was filled rather than measured."""
    upright: Floats
    """(3, 3) rotation of the axes of the laboratory that makes Z the vertical."""


def frames_apart(paths: MarkerPaths, bones: int, frames: int) -> int:
    """Return the step between those of the frames of the curves that the view contains.

    Args:
        paths: The markers.
        bones: Number of bones.
        frames: Number of frames of the curves.
    """
    return max(1, -(-frames * (len(paths.labels) + 4 * bones) // _MOST_PLACES))


def marker_legend(every: int) -> str:
    """Return the legend of a view that contains every so-many-th frame of the curves."""
    thinned = f" To keep the page small, the view shows one of {every} frames of the curves."
    return _LEGEND + (thinned if every > 1 else "")


def marker_scene(
    paths: MarkerPaths, motion: BoneMotion, markers: MarkerMotion, *, frames: slice, every: int
) -> dict[str, object]:
    """Return the data of the view.

    Args:
        paths: The markers.
        motion: The bones.
        markers: Which marker belongs to which bone.
        frames: The frames of the view.
        every: Step between the frames of the curves that the view contains, for the scripts.
    """
    points = paths.points[frames] @ paths.upright.T
    middle = _middles(points)
    size = _size(points - middle[:, None])
    centre = middle.mean(0) if len(middle) else np.zeros(3)
    owners = dict(zip(markers.labels, markers.segments, strict=True))
    order = {name: s for s, name in enumerate(motion.segments)}
    return {
        "labels": list(paths.labels), "segments": list(motion.segments), "every": every,
        "owner": [order.get(owners.get(label, ""), -1) for label in paths.labels],
        "colours": [COLOURS[s % len(COLOURS)] for s in range(len(motion.segments))], "other": OTHER,
        "place": packed((points - centre) / size, "f4"), "filled": packed(paths.filled[frames], "u1"),
        "rotation": packed(paths.upright @ motion.rotation[frames], "f4"),
        "origin": packed((motion.origin[frames] @ paths.upright.T - centre) / size, "f4"),
        "middle": packed((middle - centre) / size, "f4"), "centre": centre.tolist(), "size": size,
    }  # fmt: skip


def _middles(points: Floats) -> Floats:
    """Return the mean of the markers in each frame (F, 3), gaps bridged linearly, so that it jumps at none."""
    frames = np.arange(len(points))
    seen: Mask = np.asarray(np.isfinite(points).all(2))
    bridged = [
        np.stack([np.interp(frames, frames[seen[:, m]], points[seen[:, m], m, axis]) for axis in range(3)], 1)
        for m in np.flatnonzero(seen.any(0))
    ]
    return np.mean(bridged, 0) if bridged else np.zeros((len(points), 3))


def _size(away: Floats) -> float:
    """Return the distance from the middle [m] within which nearly all markers are; 1 without any marker."""
    distance = np.linalg.norm(away, axis=-1)
    known = distance[np.isfinite(distance)]
    return max(float(np.percentile(known, 98)), 1e-6) if known.size else 1.0
