"""The two filters of surface tracking: too fast, or not like the surface about it ([Plaenkers1999] section 2.2)."""

from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.errors import SettingProblem
from marey.surface.tracks.local_motion import candidates, misfit, radius_of
from marey.surface.tracks.trajectories import Trajectories, derivatives

_COMMON = 99.0
"""Percentile of speeds and accelerations that is taken for true."""
_BEYOND = 3.0
"""What is so many times faster than that percentile is false."""


@dataclass(frozen=True, kw_only=True)
class FilterSettings:
    """What makes a trajectory false.

    Raises:
        SettingProblem: A value is impossible.
    """

    speed: float | None = None
    """Largest speed [m/s]; None finds it from the data: three times what 99 of 100 steps stay below."""
    acceleration: float | None = None
    """Largest acceleration [m/s2]; None finds it likewise."""
    sigmas: float = 5.0
    """How many standard deviations of what is usual there a motion may differ from that of the surface about it."""
    least_apart: float = 0.001
    """Smaller differences are never false [m]."""
    frames: int = 10
    """Trajectories of fewer frames are removed; in short videos, those of less than half the frames."""

    def __post_init__(self) -> None:
        given = {"speed": self.speed, "acceleration": self.acceleration, "sigmas": self.sigmas}
        faults = [
            f"{name} is {value:g}; it must be positive"
            for name, value in given.items()
            if value is not None and not value > 0
        ]
        if self.frames < 1:
            faults.append(f"frames is {self.frames}; a trajectory has one at least")
        if faults:
            raise SettingProblem(f"False trajectories cannot be told by these settings: {'; '.join(faults)}.")


@dataclass(frozen=True, eq=False, kw_only=True)
class Filtered:
    """What the filters left, and what they did."""

    trajectories: Trajectories
    """Truncated ones have NaN where they were false; removed ones are marked."""
    too_fast: int
    """Trajectories cut by the thresholds."""
    unlike: int
    """Trajectories cut because they moved unlike the surface about them."""
    short: int
    """Trajectories of which too little is left."""
    speed: float
    """The threshold used [m/s]."""
    acceleration: float
    """The threshold used [m/s2]."""


def filtered(trajectories: Trajectories, settings: FilterSettings) -> Filtered:
    """Truncate or remove false trajectories.

    A trajectory is cut where it is false, and its longest part is kept: when that is not the first one, the point was
    false in its first frames, and the surface measured there loses it.

    Args:
        trajectories: As they were tracked.
        settings: Thresholds.

    Returns:
        The trajectories and the counts.
    """
    position = np.array(trajectories.position, float)
    measured = trajectories.measured.copy()
    cuts, speed, acceleration = too_fast(position, rate=trajectories.rate, settings=settings)
    fast = _truncate(measured, cuts)
    position[~measured] = np.nan
    unlike = _truncate(measured, unlike_from_frame_to_frame(position, settings))
    position[~measured] = np.nan
    astray = unlike_since_start(position, settings)
    measured &= ~astray
    unlike |= astray.any(axis=0)
    long = np.count_nonzero(trajectories.measured.any(axis=1))
    short = measured.sum(axis=0) < min(settings.frames, max(long // 2, min(long, 2)))
    return Filtered(
        trajectories=_cut(trajectories, measured, short), too_fast=int(fast.sum()), unlike=int((unlike & ~fast).sum()),
        short=int(short.sum()), speed=speed, acceleration=acceleration,
    )  # fmt: skip


def _cut(trajectories: Trajectories, measured: Mask, removed: Mask) -> Trajectories:
    """Take out what is false; what is removed whole keeps its arrays."""
    false = ~measured & ~removed
    position, covariance, pixels = (
        np.array(getattr(trajectories, name)) for name in ("position", "covariance", "pixels")
    )
    for array in (position, covariance, pixels):
        array[false] = np.nan
    velocity, acceleration = derivatives(position, rate=trajectories.rate)
    return replace(
        trajectories, position=position, velocity=velocity, acceleration=acceleration, covariance=covariance,
        pixels=pixels, removed=removed,
    )  # fmt: skip


def too_fast(position: Floats, *, rate: float, settings: FilterSettings) -> tuple[Mask, float, float]:
    """Find steps that are faster, or change more, than anything true.

    Args:
        position: (F, N, 3) [m]; NaN where not measured.
        rate: Frames a second [Hz].
        settings: The thresholds, or None to take them from the steps themselves.

    Returns:
        (F, N) true where a trajectory must be cut before a frame; and the thresholds of speed [m/s] and acceleration
        [m/s2], infinite where there is nothing to take them from.
    """
    known = np.isfinite(position[..., 0])
    speed, change = np.full(known.shape, np.nan), np.full(known.shape, np.nan)
    place, when, last = (
        np.full(position.shape[1:], np.nan),
        np.zeros(known.shape[1]),
        np.full(position.shape[1:], np.nan),
    )
    for f, here in enumerate(known):
        span = (f - when) / rate
        velocity = (position[f] - place) / np.where(span > 0, span, np.nan)[:, None]
        speed[f] = np.linalg.norm(velocity, axis=1)
        change[f] = np.linalg.norm(velocity - last, axis=1) * rate
        last = np.where((here & (f - when == 1))[:, None], velocity, np.nan)
        place, when = np.where(here[:, None], position[f], place), np.where(here, f, when)
    speed_limit = _limit(speed, settings.speed)
    change_limit = _limit(change, settings.acceleration)
    return (speed > speed_limit) | (change > change_limit), speed_limit, change_limit


def _limit(values: Floats, given: float | None) -> float:
    if given is not None:
        return given
    known = values[np.isfinite(values)]
    return _BEYOND * float(np.percentile(known, _COMMON)) if len(known) else np.inf


def unlike_from_frame_to_frame(position: Floats, settings: FilterSettings) -> Mask:
    """Find steps that the surface about a point did not take.

    Unlike [Plaenkers1999], a step is not compared with the mean of its neighbours' steps but with the rigid motion that
    carries them best: a surface that turns has no two equal velocities.

    Args:
        position: (F, N, 3) [m]; NaN where not measured.
        settings: How much may differ.

    Returns:
        (F, N) true where a trajectory must be cut before a frame.
    """
    known = np.isfinite(position[..., 0])
    cuts, when = np.zeros(known.shape, bool), np.full(known.shape[1], -1)
    radius = _radius(position, known)
    for f, here in enumerate(known):
        for g in np.unique(when[here & (when >= 0)]):
            which = np.flatnonzero(here & (when == g))
            near = candidates(position[g], which, radius=radius)
            cuts[f, which] = _differs(position[g], position[f], which, near, settings)
        when[here] = f
    return cuts


def unlike_since_start(position: Floats, settings: FilterSettings) -> Mask:
    """Find frames in which a point is not where the surface about its first place has gone: uniform in time.

    Ours: errors too small to see from one frame to the next show in the sum.

    Args:
        position: (F, N, 3) [m]; NaN where not measured.
        settings: How much may differ.

    Returns:
        (F, N) true where a point is elsewhere.
    """
    known = np.isfinite(position[..., 0])
    astray, first = np.zeros(known.shape, bool), np.where(known.any(axis=0), known.argmax(axis=0), -1)
    radius = _radius(position, known)
    for s in np.unique(first[first >= 0]):
        begun = np.flatnonzero(first == s)
        near = candidates(position[s], begun, radius=radius)
        for f in range(s + 1, len(known)):
            here = known[f, begun]
            which = begun[here]
            astray[f, which] = _differs(position[s], position[f], which, near[here], settings)
    return astray


def _radius(position: Floats, known: Mask) -> float:
    """Say how far neighbours are in the frame that has most points."""
    return radius_of(position[known.sum(axis=1).argmax()]) if len(position) else 0.0


def _differs(start: Floats, end: Floats, which: Integers, near: Integers, settings: FilterSettings) -> Mask:
    """Tell which points moved unlike their neighbours, by more than these moved unlike each other."""
    if not len(which):
        return np.zeros(0, bool)
    apart, spread = misfit(start, end, which, near)
    usual = np.nanmedian(spread) if np.isfinite(spread).any() else 0.0
    return apart > np.maximum(settings.least_apart, settings.sigmas * np.maximum(spread, usual))


def _truncate(measured: Mask, cuts: Mask) -> Mask:
    """Keep the longest part of each trajectory that is cut; say which ones were."""
    touched = np.flatnonzero((cuts & measured).any(axis=0))
    part = np.cumsum(cuts & measured, axis=0)[:, touched]
    counts = np.stack([((part == k) & measured[:, touched]).sum(axis=0) for k in range(int(part.max(initial=0)) + 1)])
    measured[:, touched] &= part == counts.argmax(axis=0)
    return np.isin(np.arange(measured.shape[1]), touched)
