"""Whether several cameras' tracks fit each other: the same surface, the same instants, the same points."""

import numpy as np

from marey.arrays import Floats
from marey.errors import MareyError
from marey.nonrigid.many_cameras.view_geometry import ViewPair, along_one_direction, pair_of

LONGEST_LAG = 30
LAG_SHOWS = 0.8
"""A lag is told where it lowers what is left along the shared direction to this share."""
STRANGE = 0.7
"""Two cameras do not show the same where what is left along the best shared direction is at least this share of what
they see differently..."""
LARGE = 0.1
"""...and at least this share of the object's size."""


def checked_views(tracks: Floats) -> tuple[Floats, tuple[str, ...]]:
    """Take out tracks that cannot be of the point whose number they have, and say what does not fit.

    Args:
        tracks: (C, F, 2, P); NaN where not seen.

    Returns:
        The tracks, with NaN for those of a later camera that do not fit, and notes.

    Raises:
        MareyError: A camera's tracks have nothing in common with the others'.
    """
    tracks, notes = tracks.copy(), []
    for camera in range(1, len(tracks)):
        together = np.isfinite(tracks[:camera]).all(2) & np.isfinite(tracks[camera]).all(1)
        other = int(together.sum((1, 2)).argmax())
        pair = pair_of(tracks[other], tracks[camera])
        if pair is None:
            continue
        lag, share = _lag(tracks[other], tracks[camera])
        if lag and share < LAG_SHOWS:
            notes.append(
                f"Camera {camera} and camera {other} are not synchronised: the tracks fit best where frame f of camera "
                f"{camera} is taken with frame f {'-' if lag > 0 else '+'} {abs(lag)} of camera {other}. "
                "Shift them and begin again; these shapes are not to be trusted."
            )
            continue
        if _strange(pair):
            raise MareyError(
                f"The tracks of camera {camera} do not go with those of camera {other}: along no direction do both "
                "show the same. They are of another object, of other points, or not of the same instants."
            )
        wrong = np.flatnonzero(pair.outlying)
        if len(wrong):
            tracks[camera][..., wrong] = np.nan
            notes.append(
                f"Camera {camera} and camera {other} show different points under the numbers "
                f"{', '.join(map(str, wrong))}: their tracks in camera {camera} are left out."
            )
    return tracks, tuple(notes)


def _strange(pair: ViewPair) -> bool:
    return bool(pair.spread[0] > STRANGE * pair.spread[1] and pair.spread[0] > LARGE * pair.spread[3])


def _lag(first: Floats, second: Floats) -> tuple[int, float]:
    """Find by how many frames the second camera is late, and what share of the unlike part that leaves."""
    frames = len(first)
    longest = min(LONGEST_LAG, frames // 4)
    left = {}
    for lag in range(-longest, longest + 1):
        early, late = (first, second[lag:]) if lag >= 0 else (first[-lag:], second)
        count = min(len(early), len(late))
        pair = along_one_direction(early[:count], late[:count])
        if pair is not None:
            left[lag] = pair.spread[0] / pair.spread[3]
    if 0 not in left or left[0] == 0:
        return 0, 1.0
    best = min(left, key=lambda lag: left[lag])
    return best, left[best] / left[0]
