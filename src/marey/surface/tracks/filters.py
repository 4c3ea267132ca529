"""Filters of trajectories: by speed, and by deviation from the surrounding surface ([Plaenkers1999] section 2.2)."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.errors import SettingProblem
from marey.process import usable_cores
from marey.surface.tracks.local_motion import (
    LOCAL_MOTION_DEFAULTS,
    LocalMotionSettings,
    candidates,
    misfit,
    radius_of,
)
from marey.surface.tracks.trajectories import Trajectories, derivatives


@dataclass(frozen=True, kw_only=True)
class FilterSettings:
    """Criteria for false trajectories.

    The defaults were chosen by hand; results were not measured against other values.

    Raises:
        SettingProblem: A value is impossible.
    """

    speed: float | None = None
    """Largest speed [m/s]; None derives it from the data, by `percentile` and `percentile_ratio`."""
    acceleration: float | None = None
    """Largest acceleration [m/s2]; None derives it likewise."""
    sigmas: float = 5.0
    """Largest deviation of a motion from that of the surrounding surface, in standard deviations of the neighbours."""
    least_apart: float = 0.001
    """Deviations below this are accepted [m]."""
    frames: int = 10
    """Trajectories of fewer frames are removed; in short videos, those of less than half the frames."""
    percentile: float = 99.0
    """Percentile of the speeds and accelerations from which thresholds are derived."""
    percentile_ratio: float = 3.0
    """Ratio of a threshold to that percentile."""
    local_motion: LocalMotionSettings = LOCAL_MOTION_DEFAULTS
    """How the motion of the surface about a point is estimated."""

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
            raise SettingProblem(f"Trajectories cannot be filtered with these settings: {'; '.join(faults)}.")


@dataclass(frozen=True, eq=False, kw_only=True)
class Filtered:
    """Result of the filters, with the number of trajectories changed."""

    trajectories: Trajectories
    """Truncated trajectories have NaN where they were false; removed ones are marked."""
    too_fast: int
    """Number of trajectories cut by the thresholds of speed and acceleration."""
    unlike: int
    """Number of trajectories cut because they deviate from the surrounding surface."""
    short: int
    """Number of trajectories removed because too few frames remain."""
    speed: float
    """Threshold of the speed [m/s]."""
    acceleration: float
    """Threshold of the acceleration [m/s2]."""


def filtered(trajectories: Trajectories, settings: FilterSettings) -> Filtered:
    """Truncate or remove false trajectories.

    A trajectory is cut where it is false, and its longest part is kept. If this is not the first part, the point was
    false in its first frames and is removed there.

    Args:
        trajectories: Trajectories from tracking.
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
    """Set false positions to NaN; removed trajectories keep their arrays."""
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
    """Find steps whose speed or acceleration exceeds a threshold.

    Args:
        position: (F, N, 3) positions [m]; NaN where not measured.
        rate: Sampling rate [Hz].
        settings: The thresholds; None derives them from the steps.

    Returns:
        (F, N) true where a trajectory must be cut before a frame; and the thresholds of speed [m/s] and acceleration
        [m/s2], infinite if there are no steps.
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
    speed_limit = _limit(speed, settings.speed, settings)
    change_limit = _limit(change, settings.acceleration, settings)
    return (speed > speed_limit) | (change > change_limit), speed_limit, change_limit


def _limit(values: Floats, given: float | None, settings: FilterSettings) -> float:
    if given is not None:
        return given
    known = values[np.isfinite(values)]
    return settings.percentile_ratio * float(np.percentile(known, settings.percentile)) if len(known) else np.inf


def unlike_from_frame_to_frame(position: Floats, settings: FilterSettings) -> Mask:
    """Find steps that deviate from the motion of the surrounding surface.

    Unlike [Plaenkers1999], a step is not compared with the mean of its neighbours' steps but with their best-fitting
    rigid motion, because the velocities differ on a rotating surface.

    Args:
        position: (F, N, 3) positions [m]; NaN where not measured.
        settings: Largest deviations.

    Returns:
        (F, N) true where a trajectory must be cut before a frame.
    """
    known = np.isfinite(position[..., 0])
    cuts, when = np.zeros(known.shape, bool), np.full(known.shape[1], -1)
    radius, steps = _radius(position, known, settings), []
    for f, here in enumerate(known):
        for g in np.unique(when[here & (when >= 0)]):
            steps.append((g, f, np.flatnonzero(here & (when == g))))
        when[here] = f

    def examine(step: tuple[int, int, Integers]) -> None:
        g, f, which = step
        near = candidates(position[g], which, radius=radius, settings=settings.local_motion)
        cuts[f, which] = _differs(position[g], position[f], which, near, settings)

    with ThreadPoolExecutor(usable_cores()) as pool:
        list(pool.map(examine, steps))
    return cuts


def unlike_since_start(position: Floats, settings: FilterSettings) -> Mask:
    """Find frames in which a point deviates from the motion of the surrounding surface since its first frame.

    Ours: errors too small to detect from one frame to the next are visible in their sum.

    Args:
        position: (F, N, 3) positions [m]; NaN where not measured.
        settings: Largest deviations.

    Returns:
        (F, N) true where a point deviates.
    """
    known = np.isfinite(position[..., 0])
    astray, first = np.zeros(known.shape, bool), np.where(known.any(axis=0), known.argmax(axis=0), -1)
    radius = _radius(position, known, settings)
    with ThreadPoolExecutor(usable_cores()) as pool:
        for s in np.unique(first[first >= 0]):
            begun = np.flatnonzero(first == s)
            near = candidates(position[s], begun, radius=radius, settings=settings.local_motion)

            def examine(f: int, s: int = s, begun: Integers = begun, near: Integers = near) -> None:
                here = known[f, begun]
                which = begun[here]
                astray[f, which] = _differs(position[s], position[f], which, near[here], settings)

            list(pool.map(examine, range(s + 1, len(known))))
    return astray


def _radius(position: Floats, known: Mask, settings: FilterSettings) -> float:
    """Return the largest distance of neighbours, from the frame with the most points [m]."""
    if not len(position):
        return 0.0
    return radius_of(position[known.sum(axis=1).argmax()], settings.local_motion)


def _differs(start: Floats, end: Floats, which: Integers, near: Integers, settings: FilterSettings) -> Mask:
    """Return which points deviate from their neighbours' motion by more than these deviate from each other."""
    if not len(which):
        return np.zeros(0, bool)
    apart, spread = misfit(start, end, which, near, settings.local_motion)
    usual = np.nanmedian(spread) if np.isfinite(spread).any() else 0.0
    return apart > np.maximum(settings.least_apart, settings.sigmas * np.maximum(spread, usual))


def _truncate(measured: Mask, cuts: Mask) -> Mask:
    """Keep the longest part of each trajectory that is cut; return which ones were."""
    touched = np.flatnonzero((cuts & measured).any(axis=0))
    part = np.cumsum(cuts & measured, axis=0)[:, touched]
    counts = np.stack([((part == k) & measured[:, touched]).sum(axis=0) for k in range(int(part.max(initial=0)) + 1)])
    measured[:, touched] &= part == counts.argmax(axis=0)
    return np.isin(np.arange(measured.shape[1]), touched)
