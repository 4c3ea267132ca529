"""Finding the part of a trial in which a person stands upright and still, or else the most upright frame."""

from collections.abc import Sequence

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.markers.data.trajectories import MarkerTrajectories

LEAST_STANDING_S = 0.5
"""Shortest time of standing still that is accepted in a longer trial [s]; chosen by hand."""
_STILL_M_S = 0.05
"""Largest speed of a marker on a person who stands still [m/s]: swaying moves a pelvis by a few centimetres per second.
Chosen by hand."""
_OVER_S = 0.1
"""Half the time over which the speed is measured [s]; chosen by hand."""
_MOST_LEAN_DEG = 45.0
"""Largest angle of thigh and shank, between markers, with the vertical in standing [deg]: wide enough for people who
stand with bent knees, too small for sitting. Chosen by hand."""
LegLabels = tuple[str, str, str]
"""Labels of one leg: anterior spine of the pelvis, lateral knee, lateral ankle."""


def standing_frames(
    trial: MarkerTrajectories, legs: Sequence[LegLabels], further: Sequence[str], *, up: Floats
) -> Integers:  # fmt: skip
    """Find the longest part of a trial in which a person stands upright and still.

    Args:
        trial: The trial.
        legs: Labels of each leg, proximal to distal.
        further: Labels of further markers that must be visible and still.
        up: (3,) upward direction.

    Returns:
        (K,) successive frames; none if there is no such part of at least half a second, or of the whole trial if it is
        shorter.
    """
    labels = list(dict.fromkeys([*(label for leg in legs for label in leg), *further]))
    good = _still(trial.select(labels).points, trial.rate)
    for leg in legs:
        good &= _lean(trial, leg, up) < _MOST_LEAN_DEG
    edges = np.flatnonzero(np.diff(np.concatenate([[False], good, [False]]).astype(int)))
    starts, ends = edges[::2], edges[1::2]
    if not len(starts) or (ends - starts).max() < min(LEAST_STANDING_S * trial.rate, len(trial)):
        return np.zeros(0, np.int64)
    longest = int(np.argmax(ends - starts))
    return np.arange(starts[longest], ends[longest])


def most_upright_frame(trial: MarkerTrajectories, legs: Sequence[LegLabels], further: Sequence[str]) -> int | None:
    """Find the frame in which the legs are least bent and all markers are visible; None if there is none.

    Args:
        trial: The trial.
        legs: Labels of each leg, proximal to distal.
        further: Labels of further markers that must be visible.
    """
    bent = np.sum([knee_bend_deg(trial, leg) for leg in legs], 0)
    bent = np.where(trial.select(further).present.all(1), bent, np.nan)
    return int(np.nanargmin(bent)) if np.isfinite(bent).any() else None


def knee_bend_deg(trial: MarkerTrajectories, leg: LegLabels) -> Floats:
    """Return the angle (F,) between the lines from spine to knee and from knee to ankle [deg]; NaN in gaps.

    Args:
        trial: The trial.
        leg: Labels of the leg.
    """
    spine, knee, ankle = np.moveaxis(trial.select(leg).points, 1, 0)
    return _angle_deg(spine - knee, knee - ankle)


def _still(points: Floats, rate: float) -> Mask:
    """Return the frames (F,) in which all markers (F, M, 3) are visible and slow."""
    half = max(1, round(_OVER_S * rate))
    padded = np.pad(points, ((half, half), (0, 0), (0, 0)), mode="edge")
    speed = np.linalg.norm(padded[2 * half :] - padded[: -2 * half], axis=-1) * rate / (2 * half)
    return np.asarray((speed < _STILL_M_S).all(1) & np.isfinite(points).all((1, 2)))


def _lean(trial: MarkerTrajectories, leg: LegLabels, up: Floats) -> Floats:
    """Return the larger angle (F,) of thigh and shank with the vertical [deg]."""
    spine, knee, ankle = np.moveaxis(trial.select(leg).points, 1, 0)
    return np.asarray(np.maximum(_angle_deg(spine - knee, up), _angle_deg(knee - ankle, up)))


def _angle_deg(first: Floats, second: Floats) -> Floats:
    """Return the angle (F,) between vectors (F, 3), or with one vector (3,) [deg]."""
    lengths = np.linalg.norm(first, axis=-1) * np.linalg.norm(second, axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        cosine = (first * second).sum(-1) / lengths
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
