"""Check that the tracks of several cameras show the same points of one surface at the same instants."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats
from marey.errors import MareyError
from marey.nonrigid.many_cameras.view_geometry import ViewPair, along_one_direction, view_pair

UNRELIABLE = "These shapes are unreliable; shift the tracks and repeat."
"""End of the note of cameras that are not synchronised."""


@dataclass(frozen=True, kw_only=True)
class ViewCheckSettings:
    """Settings of the checks; chosen by hand, results were not measured against other values."""

    longest_lag: int = 30
    """Largest lag between two cameras that is searched for [frames]."""
    lag_gain: float = 0.8
    """A lag is reported where it lowers the departure along the shared direction below this fraction."""
    unrelated_share: float = 0.7
    """Two cameras show different objects where the departure along the best shared direction is more than this fraction
    of the parallax..."""
    unrelated_size: float = 0.1
    """...and more than this fraction of the object's size."""


def checked_views(tracks: Floats, settings: ViewCheckSettings = ViewCheckSettings()) -> tuple[Floats, tuple[str, ...]]:
    """Remove tracks that cannot belong to the point with their index, and report cameras that do not fit each other.

    Args:
        tracks: (C, F, 2, P); NaN where not seen.
        settings: Tuned constants.

    Returns:
        The tracks, with NaN for those of a later camera that do not fit; and notes.

    Raises:
        MareyError: The tracks of a camera have nothing in common with the others.
    """
    tracks, notes = tracks.copy(), []
    for camera in range(1, len(tracks)):
        together = np.isfinite(tracks[:camera]).all(2) & np.isfinite(tracks[camera]).all(1)
        other = int(together.sum((1, 2)).argmax())
        pair = view_pair(tracks[other], tracks[camera])
        if pair is None:
            continue
        lag, share = _lag(tracks[other], tracks[camera], settings.longest_lag)
        if lag and share < settings.lag_gain:
            notes.append(
                f"Camera {camera} and camera {other} are not synchronised: the tracks fit best where frame f of camera "
                f"{camera} is combined with frame f {'-' if lag > 0 else '+'} {abs(lag)} of camera {other}. "
                f"{UNRELIABLE}"
            )
            continue
        if _unrelated(pair, settings):
            raise MareyError(
                f"The tracks of camera {camera} do not match those of camera {other}: the images agree along no "
                "direction. They must show the same points of one object at the same instants."
            )
        wrong = np.flatnonzero(pair.outlying)
        if len(wrong):
            tracks[camera][..., wrong] = np.nan
            notes.append(
                f"Camera {camera} and camera {other} show different points under the numbers "
                f"{', '.join(map(str, wrong))}: their tracks in camera {camera} are ignored."
            )
    return tracks, tuple(notes)


def _unrelated(pair: ViewPair, settings: ViewCheckSettings) -> bool:
    departure, parallax, _, size = pair.spread
    return bool(departure > settings.unrelated_share * parallax and departure > settings.unrelated_size * size)


def _lag(first: Floats, second: Floats, longest: int) -> tuple[int, float]:
    """Estimate the delay of the second camera in frames, and the fraction of the departure that it leaves."""
    frames = len(first)
    longest = min(longest, frames // 4)
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
