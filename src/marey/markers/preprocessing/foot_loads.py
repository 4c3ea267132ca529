"""Which foot loads which force plate, and the force, its point and the free moment of each contact."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Floats, Mask, freeze_fields, true_runs
from marey.markers.data.force_plates import LOADED_N, ForcePlate
from marey.markers.preprocessing.gait_events import CONTACT_DEFAULTS, ContactSettings, foot_on_plate

_APART_S = 0.1
"""A plate is unloaded this long after and before loads [s], in which its offset is measured. Chosen by hand."""
_OFFSET_S = 0.2
"""Shortest total time without a load from which the offset of a plate is measured [s]. Chosen by hand."""
_STANDING_M_PER_S = 0.3
"""A foot stands below this speed of its ankle over the floor [m/s]. Chosen by hand: an ankle in the middle of stance
moves by about 0.1 m/s, in swing by 1 m/s and more."""
_STANDING_M = 0.05
"""A foot stands while its ankle is this much higher than its lowest place at most [m]. Chosen by hand."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PlateContact:
    """A load of one plate from beginning to end."""

    plate: str
    """Name of the plate."""
    begin: int
    """First sample."""
    end: int
    """Sample after the last."""
    side: str | None
    """`left` or `right`; None if the load cannot be assigned to one foot."""
    problem: str = ""
    """Why it cannot be assigned, as a clause; empty otherwise."""


@dataclass(frozen=True, eq=False, kw_only=True)
class FootLoad:
    """The load of one foot on one plate over the T samples of the plate, in the laboratory."""

    plate: str
    """Name of the plate."""
    side: str
    """`left` or `right`."""
    rate: float
    """Sampling rate of the plate [Hz]."""
    force: Floats
    """(T, 3) on the foot [N]; 0 outside of its contacts."""
    point: Floats
    """(T, 3) centre of pressure [m]; outside of contacts that of the nearest one."""
    moment: Floats
    """(T, 3) free moment about that point [N m]; 0 outside of contacts."""

    def __post_init__(self) -> None:
        freeze_fields(self, "force", "point", "moment")


def without_offset(plate: ForcePlate) -> tuple[ForcePlate, Floats]:
    """Subtract from a plate what it measures without a load.

    Args:
        plate: The plate.

    Returns:
        The plate, and the force that was subtracted (3,) [N]; zeros if it is not unloaded long enough.
    """
    unloaded: Mask = np.abs(plate.vertical) <= LOADED_N
    around = int(np.ceil(_APART_S * plate.rate))
    for begin, end in true_runs(~unloaded):
        unloaded[max(0, begin - around) : end + around] = False
    if unloaded.sum() < _OFFSET_S * plate.rate:
        return plate, np.zeros(3)
    force, moment = plate.force[unloaded].mean(0), plate.moment[unloaded].mean(0)
    return replace(plate, force=plate.force - force, moment=plate.moment - moment), force


def plate_contacts(
    plates: Sequence[ForcePlate], feet: Mapping[str, Floats], *, rate: float,
    settings: ContactSettings = CONTACT_DEFAULTS,
) -> tuple[PlateContact, ...]:  # fmt: skip
    """Find the loads of force plates, and which foot each belongs to.

    The foot is the one whose ankle stays nearest to the centre of pressure. A load during which the other foot stands
    on the same plate belongs to neither: the plate measures the sum of both.

    Args:
        plates: The plates, with their first sample at the first frame.
        feet: Maps `left` and `right` to the ankle (F, 3) in the laboratory [m]; NaN where it is unknown.
        rate: Frame rate of the feet [Hz].
        settings: Shortest contact, and largest distance of a foot.

    Returns:
        The loads of all plates in the order of time.
    """
    found = []
    for plate in plates:
        for begin, end in true_runs(plate.vertical > LOADED_N):
            if (end - begin) / plate.rate < settings.shortest_contact_s:
                continue
            side = foot_on_plate(plate, begin, end, feet, rate, settings.foot_distance_m)
            problem = "" if side else "no foot is near its centre of pressure"
            both = side is not None and any(
                _stands_on(plate, begin, end, points, rate, settings.shortest_contact_s)
                for other, points in feet.items() if other != side
            )  # fmt: skip
            found.append(
                PlateContact(
                    plate=plate.name, begin=begin, end=end, side=None if both else side,
                    problem="both feet stand on it" if both else problem,
                )
            )  # fmt: skip
    return tuple(sorted(found, key=lambda contact: (contact.begin, contact.plate)))


def _stands_on(plate: ForcePlate, begin: int, end: int, ankle: Floats, rate: float, shortest_s: float) -> bool:
    """Return whether a foot stands within the outline of a plate for a while during a load."""
    frame, up = plate.laboratory_from_plate, plate.laboratory_from_plate.rotation[:, 2]
    inside = (ankle - frame.translation) @ frame.rotation
    size = np.abs((plate.corners - frame.translation) @ frame.rotation).max(0)
    height = np.abs(ankle @ up - float(plate.corners[0] @ up))
    lowest = np.nanmin(height, initial=np.inf)
    if len(ankle) < 2:
        return False
    speed = np.linalg.norm(np.gradient(inside[:, :2], axis=0), axis=1) * rate
    stands = (np.abs(inside[:, :2]) < size[:2]).all(1) & (height < lowest + _STANDING_M) & (speed < _STANDING_M_PER_S)
    first, last = int(begin / plate.rate * rate), int(np.ceil(end / plate.rate * rate))
    return any((b - a) / rate >= shortest_s for a, b in true_runs(stands[first:last]))


def foot_loads(plates: Sequence[ForcePlate], contacts: Sequence[PlateContact]) -> tuple[FootLoad, ...]:
    """Return the load of each foot on each plate that carries it.

    Args:
        plates: The plates.
        contacts: The loads with their feet; those without a foot are left out.
    """
    loads = []
    for plate in plates:
        for side in ("left", "right"):
            own = [c for c in contacts if c.plate == plate.name and c.side == side]
            if own:
                loads.append(_load(plate, side, own))
    return tuple(loads)


def _load(plate: ForcePlate, side: str, contacts: Sequence[PlateContact]) -> FootLoad:
    on = np.zeros(len(plate.force), bool)
    for contact in contacts:
        on[contact.begin : contact.end] = True
    point = plate.centre_of_pressure
    about = plate.moment - np.cross(point - plate.laboratory_from_plate.translation, plate.force)
    known = np.flatnonzero(on & np.isfinite(point).all(1))
    samples = np.arange(len(on))
    later = np.searchsorted(known, samples).clip(0, len(known) - 1)
    earlier = (later - 1).clip(0)
    nearer = np.where(np.abs(known[earlier] - samples) < np.abs(known[later] - samples), earlier, later)
    return FootLoad(
        plate=plate.name, side=side, rate=plate.rate, force=np.where(on[:, None], plate.force, 0.0),
        point=point[known[nearer]], moment=np.where(on[:, None], np.nan_to_num(about), 0.0),
    )  # fmt: skip
