"""Detection of foot strikes and foot offs on force plates."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Mask, true_runs
from marey.markers.data.force_plates import LOADED_N, ForcePlate
from marey.motion.events.cycles import OFF, STRIKE, GaitEvent


@dataclass(frozen=True, kw_only=True)
class ContactSettings:
    """Settings of the detection of contacts with a force plate.

    The defaults were chosen by hand; the errors of the events are measured in docs/accuracy/markers.md
    ("markers/gait_events"), not other values.
    """

    shortest_contact_s: float = 0.1
    """Shortest contact with a force plate [s]; shorter loads are disturbances."""
    foot_distance_m: float = 0.3
    """Largest distance between a foot's marker and the centre of pressure beneath it [m]."""


CONTACT_DEFAULTS = ContactSettings()
"""Default settings of the detection of contacts."""


def events_from_force(
    plates: Sequence[ForcePlate],
    feet: Mapping[str, Floats],
    *,
    rate: float,
    start_s: float = 0.0,
    settings: ContactSettings = CONTACT_DEFAULTS,
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
        The events in chronological order, with the standard deviation that follows from the plate's sampling. A contact
        that begins before or ends after the trial has one event only.
    """
    events = []
    for plate in plates:
        loaded: Mask = plate.vertical > LOADED_N
        for begin, end in true_runs(loaded):
            if (end - begin) / plate.rate < settings.shortest_contact_s:
                continue
            side = foot_on_plate(plate, begin, end, feet, rate, settings.foot_distance_m)
            for kind, sample in ((STRIKE, begin), (OFF, end)):
                if 0 < sample < len(loaded):
                    time = start_s + sample / plate.rate
                    sd = 1 / (np.sqrt(12) * plate.rate)
                    events.append(GaitEvent(kind=kind, side=side, time=time, source="force", sd_s=float(sd)))
    return tuple(sorted(events, key=lambda event: event.time))


def foot_on_plate(
    plate: ForcePlate, begin: int, end: int, feet: Mapping[str, Floats], rate: float, largest_m: float
) -> str | None:
    """Find the foot whose marker stays near the centre of pressure during a contact.

    Args:
        plate: The plate.
        begin: First sample of the contact.
        end: Sample after its last.
        feet: Maps a side to a marker of that foot (F, 3) in the laboratory [m].
        rate: Frame rate of the markers [Hz].
        largest_m: Largest distance [m].

    Returns:
        The side; None if neither stays near.
    """
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
