"""Local quadratic regression of a signal over time, at any instant."""

import numpy as np

from marey.arrays import Floats

REACH_SD = 3.0
"""Samples farther away than this are ignored, in standard deviations of the weights; they weigh 1 % of the nearest."""
LEAST_IN_REACH = 4
"""Least number of samples for a value; a quadratic has three coefficients. Chosen by hand."""


def smoothed(times: Floats, values: Floats, at: Floats, width: float) -> tuple[Floats, Floats]:
    """Smooth a signal at given times by local quadratic regression with normal weights.

    The same regression is applied to the signals of all cameras, at the cameras' own samples and between them, so that
    the noise of the result depends little on the time between two samples. With interpolation alone it would be least
    midway between them, and the estimate of an offset would be biased towards half a frame.

    Args:
        times: (F,) of the samples, ascending [s].
        values: (F,) the samples; NaN where there is none.
        at: (n,) times [s].
        width: Standard deviation of the weights [s].

    Returns:
        Values (n,) and slopes (n,) per second; NaN where one of the two samples beside a time is missing.
    """
    count, reach = len(times), REACH_SD * width
    if count < LEAST_IN_REACH:
        return np.full(len(at), np.nan), np.full(len(at), np.nan)
    known = np.isfinite(values)
    before = np.clip(np.searchsorted(times, at, side="right") - 1, 0, count - 2)
    each_side = int(np.ceil(reach / np.median(np.diff(times))))
    index = before[:, None] + np.arange(1 - each_side, each_side + 1)
    inside = (index >= 0) & (index < count)
    index = np.clip(index, 0, count - 1)
    offset = (times[index] - at[:, None]) / width
    weight = np.exp(-0.5 * offset**2) * (inside & known[index] & (np.abs(offset) <= REACH_SD))
    sample = np.where(known[index], values[index], 0.0)
    powers = [np.sum(weight * offset**p, axis=1) for p in range(5)]
    moments = np.stack([np.sum(weight * sample * offset**p, axis=1) for p in range(3)], axis=1)
    normal = np.stack([np.stack([powers[a + b] for b in range(3)], axis=1) for a in range(3)], axis=1)
    good = (at >= times[0]) & (at <= times[-1]) & _beside(known, before, at == times[before])
    good &= np.count_nonzero(weight, axis=1) >= LEAST_IN_REACH
    normal[~good] = np.eye(3)
    found = np.linalg.solve(normal, moments[..., None])[..., 0]
    return np.where(good, found[:, 0], np.nan), np.where(good, found[:, 1] / width, np.nan)


def _beside(known: np.ndarray, before: np.ndarray, exact: np.ndarray) -> np.ndarray:
    """Return whether the samples on both sides of a time are known, or the one at it."""
    return np.asarray(known[before] & (exact | known[before + 1]))
