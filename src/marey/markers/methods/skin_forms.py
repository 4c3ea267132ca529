"""Forms that a marker's motion over the bone may have: a few functions of time, each times a vector of its own."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline

from marey.arrays import Floats, freeze_fields
from marey.errors import SettingProblem


@dataclass(frozen=True, eq=False, kw_only=True)
class SkinForm:
    """A marker's displacement on the bone is the sum of Q functions of time, each times an unknown vector [m]."""

    name: str
    """As a report says it: `constant`, `sinusoid of 1.20 s`, ..."""
    functions: Floats
    """(F, Q) the functions, each of largest size 1, so that its vector is the largest displacement."""

    def __post_init__(self) -> None:
        freeze_fields(self, "functions")

    @property
    def count(self) -> int:
        """Q."""
        return self.functions.shape[1]


def constant(frames: int) -> SkinForm:
    """Say that the markers do not move over the bone."""
    return SkinForm(name="constant", functions=np.zeros((frames, 0)))


def linear_in_time(time: Floats) -> SkinForm:
    """Let the markers drift evenly over the trial."""
    return SkinForm(name="linear in time", functions=_scaled((time - time[0])[:, None]))


def linear_in_turn(turn: Floats) -> SkinForm:
    """Let the markers follow a joint's turn (F,) [rad]; where it is not known it is interpolated."""
    known = np.isfinite(turn)
    if not known.any():
        raise SettingProblem("A form in a joint's turn needs frames in which the joint is known.")
    frames = np.arange(len(turn))
    return SkinForm(
        name="linear in the joint's turn",
        functions=_scaled(np.interp(frames, frames[known], np.asarray(turn)[known])[:, None]),
    )


def sinusoid(time: Floats, period_s: float) -> SkinForm:
    """Let the markers swing with the activity's period [s] ([Alexander2003] section 2.3 for level walking)."""
    if not period_s > 0:
        raise SettingProblem(f"The period is {period_s} s and should be above 0.")
    phase = 2 * np.pi * (time - time[0]) / period_s
    return SkinForm(
        name=f"sinusoid of {period_s:.2f} s", functions=_scaled(np.stack([np.sin(phase), np.cos(phase)], -1))
    )


def spline(time: Floats, pieces: int) -> SkinForm:
    """Let the markers follow a cubic B-spline of so many even pieces over the trial."""
    if pieces < 1:
        raise SettingProblem(f"A spline has {pieces} pieces and should have at least 1.")
    knots = np.concatenate([np.zeros(3), np.linspace(0, 1, pieces + 1), np.ones(3)])
    along = (time - time[0]) / max(time[-1] - time[0], np.finfo(float).tiny)
    functions = BSpline.design_matrix(np.clip(along, 0, 1), knots, 3).toarray()
    # The functions add up to 1, which is the marker's own place; one of them is left to that.
    return SkinForm(name=f"spline of {pieces} pieces", functions=_scaled(functions[:, 1:]))


def own(name: str, function: Callable[[Floats], Floats], time: Floats) -> SkinForm:
    """Let the markers follow a function of the user's own.

    Args:
        name: What a report calls it.
        function: From times (F,) [s] to (F, Q) values.
        time: (F,) [s].

    Raises:
        SettingProblem: The function gives another shape, or values that are not finite.
    """
    values = np.asarray(function(time), float)
    if values.ndim != 2 or len(values) != len(time) or not np.isfinite(values).all():
        raise SettingProblem(f"The form {name!r} should give ({len(time)}, Q) finite values; it gave {values.shape}.")
    return SkinForm(name=name, functions=_scaled(values))


def combined(*forms: SkinForm) -> SkinForm:
    """Add forms up."""
    return SkinForm(name=" + ".join(f.name for f in forms), functions=np.concatenate([f.functions for f in forms], 1))


def period_of(signal: Floats, rate: float) -> float | None:
    """Find the period of a repeated motion [s] as the first peak of its autocorrelation above one half.

    Args:
        signal: (F, D) some coordinates of the motion, NaN where there is no answer.
        rate: [Hz].

    Returns:
        The period; None where the motion does not repeat at least once within the trial.
    """
    held = np.where(np.isfinite(signal), signal - np.nanmean(signal, 0), 0.0)
    count = len(held)
    spectrum = np.abs(np.fft.rfft(held, 2 * count, axis=0)) ** 2
    product = np.fft.irfft(spectrum.sum(1))[:count] / (count - np.arange(count))
    likeness = product / max(product[0], np.finfo(float).tiny)
    inner = likeness[1:-1]
    peaks = np.flatnonzero((inner >= likeness[:-2]) & (inner >= likeness[2:]) & (inner > 0.5)) + 1
    fell = np.flatnonzero(likeness < 0.5)
    peaks = peaks[(peaks > (fell[0] if len(fell) else count)) & (peaks <= 0.8 * count)]
    return float(peaks[0] / rate) if len(peaks) else None


def _scaled(functions: Floats) -> Floats:
    return np.asarray(functions / np.maximum(np.abs(functions).max(0, initial=0.0), np.finfo(float).tiny))
