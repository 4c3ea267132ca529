"""Detection of foot strikes and foot offs from heel and toe markers or from force plates."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import find_peaks

from marey.arrays import Floats, Mask, true_runs
from marey.errors import MareyError
from marey.markers.data.force_plates import LOADED_N, ForcePlate
from marey.motion.filters import MINIMUM_RATE_RATIO, low_pass
from marey.motion.gait import OFF, STRIKE, GaitEvent


@dataclass(frozen=True, kw_only=True)
class GaitEventSettings:
    """Settings of the detection of strikes and offs.

    The defaults were chosen by hand; the errors of the events are measured in docs/accuracy/markers.md ("Gait events"),
    not other values.
    """

    cutoff_hz: float = 20.0
    """Cut-off of the low-pass filter for heel and toe [Hz]."""
    shortest_cycle_s: float = 0.5
    """Shortest gait cycle [s]."""
    least_prominence: float = 0.4
    """Smallest prominence of a maximum as a ratio to the foot's range of motion."""
    strike_window_s: float = 0.25
    """The strike lies within this time after the heel's most anterior position [s]."""
    overground_m: float = 1.0
    """A body that travels farther than this over the trial walks over ground [m]; otherwise it is on a treadmill."""
    near_lowest_ratio: float = 0.2
    """A local minimum of the heel's height counts as the strike when it lies within this ratio of the descent above the
    lowest position."""
    shortest_contact_s: float = 0.1
    """Shortest contact with a force plate [s]; shorter loads are disturbances."""
    foot_distance_m: float = 0.3
    """Largest distance between a foot's marker and the centre of pressure beneath it [m]."""


GAIT_EVENT_DEFAULTS = GaitEventSettings()
"""Default settings of the detection of strikes and offs."""


def events_from_markers(
    heel: Floats,
    body: Floats,
    *,
    rate: float,
    start_s: float = 0.0,
    side: str | None = None,
    toe: Floats | None = None,
    up: Floats = (0.0, 0.0, 1.0),  # type: ignore[assignment]
    settings: GaitEventSettings = GAIT_EVENT_DEFAULTS,
) -> tuple[GaitEvent, ...]:
    """Detect the strikes of a foot from its heel and its offs from its toe, over ground or on a treadmill.

    The heel is farthest ahead of the body just before it strikes, and lowest at the strike; the toe is farthest behind
    the body when it leaves the floor ([Zeni2008]). Unlike the paper, the strike is the lowest position after the most
    anterior one, which itself is early because the leg swings back before the strike. The walking direction is assumed
    constant over the trial.

    Args:
        heel: (F, 3) [m]; NaN where missing.
        body: (F, 3) a point that moves with the pelvis: the mean of the pelvis' or a thigh's markers [m].
        rate: Frames per second [Hz].
        start_s: Time of the first frame [s].
        side: `left` or `right`, if known.
        toe: (F, 3) [m]; without it no offs are detected.
        up: (3,) upward direction in the laboratory.
        settings: Filter, times and ratios.

    Returns:
        The events in chronological order; none in the first and the last frame, where an extreme cannot be detected.
    """
    vertical = np.asarray(up, float) / np.linalg.norm(up)
    heel = _smooth(heel, rate, settings.cutoff_hz)
    ahead = _direction(heel, body, vertical, settings.overground_m)
    events = []
    reach, height = (heel - body) @ ahead, heel @ vertical
    for peak in _peaks(reach, rate, settings):
        window = slice(peak, peak + max(2, round(settings.strike_window_s * rate)) + 1)
        low = peak + _lowest(height[window], settings.near_lowest_ratio)
        if 0 < low < len(height) - 1 and low > peak and np.isfinite(height[low + 1]):
            frame = low + _vertex(-height[low - 1 : low + 2])
            events.append(GaitEvent(kind=STRIKE, side=side, time=start_s + frame / rate, source="markers"))
    if toe is not None:
        behind = -(_smooth(toe, rate, settings.cutoff_hz) - body) @ ahead
        for peak in _peaks(behind, rate, settings):
            frame = peak + _vertex(behind[peak - 1 : peak + 2])
            events.append(GaitEvent(kind=OFF, side=side, time=start_s + frame / rate, source="markers"))
    return tuple(sorted(events, key=lambda event: event.time))


def _smooth(points: Floats, rate: float, cutoff_hz: float) -> Floats:
    """Remove noise that would cause false extremes."""
    slow = rate < MINIMUM_RATE_RATIO * cutoff_hz
    return np.asarray(points, float) if slow else low_pass(points, rate=rate, cutoff_hz=cutoff_hz)


def _direction(heel: Floats, body: Floats, vertical: Floats, overground_m: float) -> Floats:
    """Estimate the walking direction (3,): that of the body, or, on a treadmill, of the foot's fast motion."""
    level = np.eye(3) - np.outer(vertical, vertical)
    known = np.flatnonzero(np.isfinite(body).all(-1) & np.isfinite(heel).all(-1))
    if len(known) < 3:
        raise MareyError("The heel and the body are never visible together: gait events cannot be detected.")
    way = level @ (body[known[-1]] - body[known[0]])
    if np.linalg.norm(way) > overground_m:
        return np.asarray(way / np.linalg.norm(way))
    relative = (heel - body)[known] @ level
    axis = np.linalg.svd(relative - relative.mean(0), full_matrices=False)[2][0]
    speed = np.diff(relative @ axis)
    # On a treadmill the foot moves back slowly with the belt and swings forward fast.
    return np.asarray(axis if (speed**3).sum() > 0 else -axis)


def _peaks(values: Floats, rate: float, settings: GaitEventSettings) -> list[int]:
    """Return the frames of prominent maxima, separately between gaps."""
    known = values[np.isfinite(values)]
    if not len(known):
        return []
    span = np.percentile(known, 98) - np.percentile(known, 2)
    apart = max(1, int(settings.shortest_cycle_s * rate))
    peaks = []
    for start, end in true_runs(np.isfinite(values)):
        found, _ = find_peaks(values[start:end], prominence=settings.least_prominence * span, distance=apart)
        peaks += [start + int(p) for p in found]
    return peaks


def _lowest(height: Floats, near_ratio: float) -> int:
    """Return the first local minimum near the lowest position of a section."""
    known = np.where(np.isfinite(height), height, np.inf)
    low = float(known.min())
    depth = known[0] - low
    for n in range(1, len(known) - 1):
        if known[n] <= known[n - 1] and known[n] < known[n + 1] and known[n] - low <= near_ratio * depth:
            return n
    return int(np.argmin(known))


def _vertex(values: Floats) -> float:
    """Return the offset of a parabola's vertex through three values from the middle one, in frames."""
    bend = values[0] - 2 * values[1] + values[2]
    return float(np.clip(0.5 * (values[0] - values[2]) / bend, -0.5, 0.5)) if bend < 0 else 0.0


def events_from_force(
    plates: Sequence[ForcePlate],
    feet: Mapping[str, Floats],
    *,
    rate: float,
    start_s: float = 0.0,
    settings: GaitEventSettings = GAIT_EVENT_DEFAULTS,
) -> tuple[GaitEvent, ...]:
    """Detect strikes and offs on force plates: the vertical force rises above, or falls below, `LOADED_N`.

    Args:
        plates: Force plates of the trial.
        feet: Maps a side (`left`, `right`) to a marker of that foot (F, 3) in the laboratory [m]; the foot closest to
            the centre of pressure is on the plate. If empty, the side stays unknown.
        rate: Frame rate of the markers [Hz].
        start_s: Time of the first frame [s].
        settings: Shortest contact, and largest distance of a foot.

    Returns:
        The events in chronological order. A contact that begins before or ends after the trial has one event only.
    """
    events = []
    for plate in plates:
        loaded: Mask = plate.vertical > LOADED_N
        for begin, end in true_runs(loaded):
            if (end - begin) / plate.rate < settings.shortest_contact_s:
                continue
            side = _foot_on(plate, begin, end, feet, rate, settings.foot_distance_m)
            for kind, sample in ((STRIKE, begin), (OFF, end)):
                if 0 < sample < len(loaded):
                    time = start_s + sample / plate.rate
                    events.append(GaitEvent(kind=kind, side=side, time=time, source="force"))
    return tuple(sorted(events, key=lambda event: event.time))


def _foot_on(
    plate: ForcePlate, begin: int, end: int, feet: Mapping[str, Floats], rate: float, largest_m: float
) -> str | None:
    """Return the side whose marker stays near the centre of pressure during a contact; None if neither does."""
    samples = np.arange(begin, end)
    frames = (samples / plate.rate * rate).astype(int)
    pressure, flat = plate.centre_of_pressure[samples], plate.laboratory_from_plate.rotation[:, :2]
    far = {}
    for side, points in feet.items():
        inside = frames < len(points)
        distance = np.linalg.norm((points[frames[inside]] - pressure[inside]) @ flat, axis=-1)
        if np.isfinite(distance).any():
            far[side] = float(np.nanmedian(distance))
    if not far:
        return None
    nearest = min(far, key=lambda side: far[side])
    return nearest if far[nearest] < largest_m else None
