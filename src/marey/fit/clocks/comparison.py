"""Differences of the signals of two cameras for assumed clocks."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats
from marey.fit.clocks.signals import EpipolarSignal
from marey.fit.clocks.smoothing import smoothed

WIDTH = 1.0
"""Width of the smoothing of the signals, in the longer one of both cameras' frame periods. Chosen by hand."""


@dataclass(frozen=True, eq=False)
class ComparedSignals:
    """Two cameras' measurements of one signal at equal instants, at the pictures of the first of them."""

    times: tuple[Floats, Floats]
    """(n,) of each camera's own video [s]."""
    residual_px: Floats
    """(n,) the first camera's value less the second's [px]; NaN where one of them has none."""
    slope: Floats
    """(n,) change of the signal over time [px/s], the mean of both cameras'."""


@dataclass(frozen=True, eq=False)
class SampledSignal:
    """A signal with the times of its samples, in a fixed order of its two cameras, the slower one first."""

    cameras: tuple[int, int]
    """The two cameras."""
    times: tuple[Floats, Floats]
    """(F,) times of the samples in each camera's own video, ascending [s]."""
    angles: tuple[Floats, Floats]
    """(F,) as in `EpipolarSignal`."""
    radians_per_pixel: tuple[Floats, Floats]
    """(F,) as in `EpipolarSignal`."""
    bias_px: float
    """Standard deviation of a constant difference [px]."""
    least_sd_px: float
    """Least standard deviation of the other differences [px]."""
    source: str
    """Kind of the measurement."""
    change: float
    """As in `EpipolarSignal`."""
    own: tuple[Floats, Floats]
    """(F,) smoothed values and slopes of the first camera at its own samples [rad, rad/s]."""
    width: float
    """Width of the smoothing [s]."""

    @staticmethod
    def of(signal: EpipolarSignal, times: Sequence[Floats]) -> "SampledSignal":
        """Sample a signal at the times (F,) of each camera's pictures [s]."""
        periods = [float(np.median(np.diff(times[c]))) for c in signal.cameras]
        first = int(np.argmax(periods))
        order = (first, 1 - first)
        cameras = signal.cameras[order[0]], signal.cameras[order[1]]
        angles = signal.angles[order[0]], signal.angles[order[1]]
        per_pixel = signal.radians_per_pixel[order[0]], signal.radians_per_pixel[order[1]]
        own_times, other_times = (_sampled_at(times[c], signal, k) for c, k in zip(cameras, order, strict=True))
        width = WIDTH * max(periods)
        own = smoothed(own_times, angles[0], own_times, width)
        return SampledSignal(
            cameras, (own_times, other_times), angles, per_pixel, signal.bias_px, signal.least_sd_px,
            signal.source, signal.change, own, width,
        )  # fmt: skip

    def resampled(self, camera: int, step: float) -> Floats:
        """Return the smoothed angle and the radians per pixel (n, 2) of one camera, from time 0 on [rad, rad/px]."""
        k = self.cameras.index(camera)
        at = np.arange(0.0, self.times[k][-1] + 1e-9, step)
        angle, _ = smoothed(self.times[k], self.angles[k], at, self.width)
        return np.stack([angle, np.interp(at, self.times[k], self.radians_per_pixel[k])], axis=1)

    def compared(self, offset_s: Floats, drift: Floats) -> ComparedSignals:
        """Compare both cameras' values at equal instants.

        Args:
            offset_s: (C,) offsets of the cameras' clocks [s].
            drift: (C,) drifts of the cameras' clocks [s/s].

        Returns:
            The comparison at the first camera's pictures.
        """
        (i, j), own = self.cameras, self.times[0]
        others = ((1 + drift[i]) * own + offset_s[i] - offset_s[j]) / (1 + drift[j])
        value, slope = smoothed(self.times[1], self.angles[1], others, self.width)
        spread = np.hypot(self.radians_per_pixel[0], np.interp(others, self.times[1], self.radians_per_pixel[1]))
        residual = np.angle(np.exp(1j * (self.own[0] - value))) / spread
        return ComparedSignals((own, others), residual, 0.5 * (self.own[1] + slope) / spread)


def _sampled_at(times: Floats, signal: EpipolarSignal, k: int) -> Floats:
    """Return the times (F,) of the samples of one of a signal's two cameras, from those of its pictures [s]."""
    return times if signal.delays is None else times + np.nan_to_num(signal.delays[k])
