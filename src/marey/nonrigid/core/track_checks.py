"""Check whether tracks suffice for a factorisation."""

import numpy as np

from marey.arrays import Floats, Mask
from marey.errors import MareyError

FEWEST_POINTS = 4
"""Least number of points that one orthographic camera must see in a frame. Chosen by hand; results were not measured
against other values."""
RIGID = "The object is rigid as far as these tracks show: its mean shape alone explains them."
"""Note of results without deformation modes."""


def check_tracks(tracks: Floats, *, points: int, frames: int) -> Mask:
    """Check that tracks of one or several cameras suffice, and find where points are seen.

    Args:
        tracks: (F, 2, P) or (C, F, 2, P); NaN where not seen.
        points: Least number in all, and of points that some camera must see in each frame.
        frames: Least number in all, and of frames in which each point must be seen.

    Returns:
        Mask (F, P) or (C, F, P) of the places seen.

    Raises:
        MareyError: The array has a wrong shape or too few points or frames.
    """
    if tracks.ndim not in (3, 4) or tracks.shape[-2] != 2:
        raise MareyError(f"Tracks have shape {tracks.shape}; expected (frames, 2, points).")
    seen: Mask = np.asarray(np.isfinite(tracks).all(-2))
    together = seen.reshape(-1, *seen.shape[-2:])
    if seen.shape[-2] < frames or seen.shape[-1] < points:
        raise MareyError(
            f"{seen.shape[-1]} points over {seen.shape[-2]} frames are too few: at least {points} points over {frames} "
            "frames are needed."
        )
    bare = np.flatnonzero(together.sum(2).max(0) < points)
    if len(bare):
        raise MareyError(
            f"In frame {bare[0]} fewer than {points} points are seen by one camera (the same holds for {len(bare)} of "
            f"{seen.shape[-2]} frames). Leave such frames out."
        )
    lost = np.flatnonzero(together.any(0).sum(0) < frames)
    if len(lost):
        raise MareyError(f"Point {lost[0]} is seen in fewer than {frames} frames. Leave such points out.")
    return seen
