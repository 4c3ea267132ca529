"""Whether tracks are enough to find shapes, and what is said of a rigid object."""

import numpy as np

from marey.arrays import Floats, Mask
from marey.errors import MareyError

RIGID = "The object is rigid as far as these tracks tell: its mean shape alone explains them."


def checked(tracks: Floats, *, points: int, frames: int) -> Mask:
    """Tell where the tracks of one camera or several show points, if that is enough.

    Args:
        tracks: (F, 2, P) or (C, F, 2, P); NaN where not seen.
        points: The fewest in all, and that some camera must see in each frame.
        frames: The fewest in all, and in which each point must be seen.

    Returns:
        (F, P) or (C, F, P).

    Raises:
        MareyError: The array has another shape, or holds too little.
    """
    if tracks.ndim not in (3, 4) or tracks.shape[-2] != 2:
        raise MareyError(f"Tracks have the shape {tracks.shape} and should have (frames, 2, points).")
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
            f"In frame {bare[0]} fewer than {points} points are seen by one camera (so it is in {len(bare)} of "
            f"{seen.shape[-2]}); leave such frames out."
        )
    lost = np.flatnonzero(together.any(0).sum(0) < frames)
    if len(lost):
        raise MareyError(f"Point {lost[0]} is seen in fewer than {frames} frames; leave such points out.")
    return seen
