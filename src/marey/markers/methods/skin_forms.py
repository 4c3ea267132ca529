"""Functional forms of a marker's motion over the bone: a few functions of time, each times a vector."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline

from marey.arrays import Floats, freeze_fields
from marey.errors import SettingProblem


@dataclass(frozen=True, eq=False, kw_only=True)
class SkinForm:
    """A form of displacement on the bone: the sum of Q functions of time, each times an unknown vector [m]."""

    name: str
    """Name in reports: `constant`, `sinusoid of 1.20 s`, ..."""
    functions: Floats
    """(F, Q) the functions, scaled to a maximum of 1, so that the vector is the largest displacement."""

    def __post_init__(self) -> None:
        freeze_fields(self, "functions")

    @property
    def count(self) -> int:
        """Number Q of functions."""
        return int(self.functions.shape[1])


def constant(frames: int) -> SkinForm:
    """Create the form of markers that do not move over the bone."""
    return SkinForm(name="constant", functions=np.zeros((frames, 0)))


def linear_in_time(time: Floats) -> SkinForm:
    """Create a form that is linear in time (F,) [s]."""
    return SkinForm(name="linear in time", functions=_scaled((time - time[0])[:, None]))


def linear_in_turn(turn: Floats) -> SkinForm:
    """Create a form that is linear in a joint's rotation (F,) [rad], interpolated where it is unknown."""
    known = np.isfinite(turn)
    if not known.any():
        raise SettingProblem("A form in a joint's rotation needs frames in which the joint is known.")
    frames = np.arange(len(turn))
    return SkinForm(
        name="linear in the joint's rotation",
        functions=_scaled(np.interp(frames, frames[known], np.asarray(turn)[known])[:, None]),
    )


def sinusoid(time: Floats, period_s: float) -> SkinForm:
    """Create a sinusoid with the activity's period [s] ([Alexander2003] section 2.3 for level walking)."""
    if not period_s > 0:
        raise SettingProblem(f"The period is {period_s} s; it should be above 0.")
    phase = 2 * np.pi * (time - time[0]) / period_s
    return SkinForm(
        name=f"sinusoid of {period_s:.2f} s", functions=_scaled(np.stack([np.sin(phase), np.cos(phase)], -1))
    )


def spline(time: Floats, pieces: int) -> SkinForm:
    """Create a cubic B-spline with a number of equal pieces over the trial."""
    if pieces < 1:
        raise SettingProblem(f"A spline has {pieces} pieces; it should have at least 1.")
    knots = np.concatenate([np.zeros(3), np.linspace(0, 1, pieces + 1), np.ones(3)])
    along = (time - time[0]) / max(time[-1] - time[0], np.finfo(float).tiny)
    functions = BSpline.design_matrix(np.clip(along, 0, 1), knots, 3).toarray()
    # The functions sum to 1, the constant position; one of them is therefore redundant.
    return SkinForm(name=f"spline of {pieces} pieces", functions=_scaled(functions[:, 1:]))


def custom(name: str, function: Callable[[Floats], Floats], time: Floats) -> SkinForm:
    """Create a form from a user-defined function.

    Args:
        name: Name in reports.
        function: Maps times (F,) [s] to (F, Q) values.
        time: (F,) [s].

    Returns:
        The form.

    Raises:
        SettingProblem: The function returns another shape, or values that are not finite.
    """
    values = np.asarray(function(time), float)
    if values.ndim != 2 or len(values) != len(time) or not np.isfinite(values).all():
        raise SettingProblem(
            f"The form {name!r} should return ({len(time)}, Q) finite values; it returned the shape {values.shape}."
        )
    return SkinForm(name=name, functions=_scaled(values))


def period_of(signal: Floats, rate: float) -> float | None:
    """Estimate the period of a repeated motion [s] as the first peak of its autocorrelation above one half.

    Args:
        signal: (F, D) coordinates of the motion; NaN where unknown.
        rate: Frames per second [Hz].

    Returns:
        The period; None if the motion does not repeat within the trial.
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
