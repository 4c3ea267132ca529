"""Reading and writing of tracked points: `tracks.npz`, and the points that a user selects for tracking."""

from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.errors import FileProblem
from marey.images.matching.feature_tracks import FeatureTracks
from marey.io.documents import whole_number
from marey.io.npz import read_arrays, write_arrays

_NAMES = ("tracks", "tracks_sd", "visible", "predicted")
"""Arrays of `tracks.npz`, which are fields of `FeatureTracks`."""


def write_tracks(path: Path | str, tracks: FeatureTracks) -> None:
    """Write `tracks.npz`: `tracks` (F, 2, P) and `tracks_sd` in pixels, `visible` and `predicted` (F, P)."""
    write_arrays(path, {name: getattr(tracks, name) for name in _NAMES})


def read_points(path: Path | str, *, frames: int, size: tuple[int, int]) -> tuple[Floats, int]:
    """Read the points to track in a video: `points` (P, 2) in pixels, and their `frame`.

    Args:
        path: The file.
        frames: Number of frames of the video.
        size: Width and height of the video [px].

    Returns:
        The points (P, 2) [px], and the frame to which they belong.

    Raises:
        FileProblem: An array is missing or has another shape, or a point or the frame is not in the video.
    """
    arrays = read_arrays(path, ("points", "frame"))
    points, frame = arrays["points"], arrays["frame"]
    if points.dtype.kind not in "iuf" or points.ndim != 2 or points.shape[1] != 2 or not len(points):
        wrong = f"has points of shape {points.shape} and type {points.dtype}"
        raise FileProblem(path, wrong, "They must be numbers of shape (points, 2): x and y in pixels from 0.")
    number = whole_number(frame.item(), least=-(2**53), greatest=2**53) if frame.size == 1 else None
    if number is None or frame.dtype.kind not in "iuf":
        raise FileProblem(path, f"has the frame {frame.tolist()}", "It must be one whole number.")
    if not 0 <= number < frames:
        raise FileProblem(
            path, f"has points of frame {number}, which does not exist", f"The video has the frames 0 to {frames - 1}."
        )
    _require_in_picture(path, points, size)
    return points.astype(float), number


def _require_in_picture(path: Path | str, points: np.ndarray, size: tuple[int, int]) -> None:
    width, height = size
    bad = np.flatnonzero(~np.all((points >= 0) & (points <= (width - 1, height - 1)), axis=1))
    if len(bad):
        x, y = points[bad[0]]
        wrong = f"has point {bad[0]} at ({x:g}, {y:g}), which is outside the image"
        raise FileProblem(path, wrong, f"The video's images have {width} x {height} pixels.")
