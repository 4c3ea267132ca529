"""Foot strikes and foot offs, found from the heel's and toe's markers or from force plates."""

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.signal import find_peaks

from marey.arrays import Floats, Mask
from marey.errors import MareyError
from marey.markers.data.force_plates import ForcePlate
from marey.motion.filters import known_runs, low_pass
from marey.motion.gait import OFF, STRIKE, GaitEvent

_CUTOFF_HZ = 20.0
_SHORTEST_CYCLE_S = 0.5
_PROMINENT = 0.4  # of the foot's way: less is no step
_SETTLES_S = 0.25  # after its farthest reach the heel is down within
_TRAVELS_M = 1.0  # a body that gets farther than this walks over ground
_LOADED_N, _SHORTEST_CONTACT_S = 20.0, 0.1
_REACH_M = 0.3  # from a foot's marker to the centre of pressure under it


def events_from_markers(
    heel: Floats,
    body: Floats,
    *,
    rate: float,
    start_s: float = 0.0,
    side: str | None = None,
    toe: Floats | None = None,
    up: Floats = (0.0, 0.0, 1.0),  # type: ignore[assignment]
) -> tuple[GaitEvent, ...]:
    """Find the strikes of a heel, and the foot's offs from its toe, over ground or on a treadmill.

    The heel is farthest ahead of the body just before it strikes, and lowest when it does; the toe is farthest behind
    the body when it leaves the floor ([Zeni2008]). Unlike the paper, the strike is the lowest place after the
    farthest reach, not the reach itself, which is early by what the leg swings back. A person who turns within the
    trial is not followed.

    Args:
        heel: (F, 3) [m]; NaN where missing.
        body: (F, 3) something that goes along with the pelvis: its markers' mean, or a thigh's [m].
        rate: Frames a second [Hz].
        start_s: Time of the first frame [s].
        side: `left` or `right`, where known.
        toe: (F, 3) [m]; without it there are no offs.
        up: (3,) which way is up in the laboratory.

    Returns:
        The events in the order of time; none at the very first and last frame, where an extreme does not show.
    """
    vertical = np.asarray(up, float) / np.linalg.norm(up)
    heel = _smooth(heel, rate)
    ahead = _direction(heel, body, vertical)
    events = []
    reach, height = (heel - body) @ ahead, heel @ vertical
    for peak in _peaks(reach, rate):
        window = slice(peak, peak + max(2, round(_SETTLES_S * rate)) + 1)
        low = peak + _lowest(height[window])
        if 0 < low < len(height) - 1 and low > peak and np.isfinite(height[low + 1]):
            frame = low + _vertex(-height[low - 1 : low + 2])
            events.append(GaitEvent(kind=STRIKE, side=side, time=start_s + frame / rate, source="markers"))
    if toe is not None:
        behind = -(_smooth(toe, rate) - body) @ ahead
        for peak in _peaks(behind, rate):
            frame = peak + _vertex(behind[peak - 1 : peak + 2])
            events.append(GaitEvent(kind=OFF, side=side, time=start_s + frame / rate, source="markers"))
    return tuple(sorted(events, key=lambda event: event.time))


def _smooth(points: Floats, rate: float) -> Floats:
    """Take the noise away that would make false extremes."""
    slow = rate < 2.2 * _CUTOFF_HZ
    return np.asarray(points, float) if slow else low_pass(points, rate=rate, cutoff_hz=_CUTOFF_HZ)


def _direction(heel: Floats, body: Floats, vertical: Floats) -> Floats:
    """Tell which way the person walks (3,): where the body goes, or, on a treadmill, where the foot goes fast."""
    level = np.eye(3) - np.outer(vertical, vertical)
    known = np.flatnonzero(np.isfinite(body).all(-1) & np.isfinite(heel).all(-1))
    if len(known) < 3:
        raise MareyError("The heel and the body are not seen together, so no gait event shows.")
    way = level @ (body[known[-1]] - body[known[0]])
    if np.linalg.norm(way) > _TRAVELS_M:
        return np.asarray(way / np.linalg.norm(way))
    relative = (heel - body)[known] @ level
    axis = np.linalg.svd(relative - relative.mean(0), full_matrices=False)[2][0]
    speed = np.diff(relative @ axis)
    # On a treadmill the foot goes back slowly with the belt and swings forward fast.
    return np.asarray(axis if (speed**3).sum() > 0 else -axis)


def _peaks(values: Floats, rate: float) -> list[int]:
    """List the frames of clear maxima, between gaps."""
    known = values[np.isfinite(values)]
    if not len(known):
        return []
    span = np.percentile(known, 98) - np.percentile(known, 2)
    apart = max(1, int(_SHORTEST_CYCLE_S * rate))
    peaks = []
    for start, end in known_runs(values):
        found, _ = find_peaks(values[start:end], prominence=_PROMINENT * span, distance=apart)
        peaks += [start + int(p) for p in found]
    return peaks


def _lowest(height: Floats) -> int:
    """Give the first local minimum that lies near the lowest place of a stretch."""
    known = np.where(np.isfinite(height), height, np.inf)
    low = float(known.min())
    depth = known[0] - low
    for n in range(1, len(known) - 1):
        if known[n] <= known[n - 1] and known[n] < known[n + 1] and known[n] - low <= 0.2 * depth:
            return n
    return int(np.argmin(known))


def _vertex(values: Floats) -> float:
    """Give the place of a parabola's top through three values, from the middle one, in frames."""
    bend = values[0] - 2 * values[1] + values[2]
    return float(np.clip(0.5 * (values[0] - values[2]) / bend, -0.5, 0.5)) if bend < 0 else 0.0


def events_from_force(
    plates: Sequence[ForcePlate], feet: Mapping[str, Floats], *, rate: float, start_s: float = 0.0
) -> tuple[GaitEvent, ...]:
    """Find when feet meet and leave force plates: the vertical force rises above, or falls below, 20 N.

    Args:
        plates: Of the trial.
        feet: Side (`left`, `right`) to a marker of that foot (F, 3) in the laboratory [m]; the one nearest to the
            centre of pressure stood on the plate. Empty: the side stays unknown.
        rate: Of the markers [Hz].
        start_s: Time of the first frame [s].

    Returns:
        The events in the order of time. A contact that the trial cuts off has the event that it shows.
    """
    events = []
    for plate in plates:
        loaded: Mask = plate.vertical > _LOADED_N
        for begin, end in known_runs(np.where(loaded, 0.0, np.nan)):
            if (end - begin) / plate.rate < _SHORTEST_CONTACT_S:
                continue
            side = _foot_on(plate, begin, end, feet, rate)
            for kind, sample in ((STRIKE, begin), (OFF, end)):
                if 0 < sample < len(loaded):
                    time = start_s + sample / plate.rate
                    events.append(GaitEvent(kind=kind, side=side, time=time, source="force"))
    return tuple(sorted(events, key=lambda event: event.time))


def _foot_on(plate: ForcePlate, begin: int, end: int, feet: Mapping[str, Floats], rate: float) -> str | None:
    """Say whose marker stays near the centre of pressure over a contact; the other foot only swings by."""
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
    return nearest if far[nearest] < _REACH_M else None
