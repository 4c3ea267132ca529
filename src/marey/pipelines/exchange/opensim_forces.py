"""Ground reaction forces of a recording for OpenSim: which foot loads which plate."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.errors import FileProblem
from marey.io.axes import OPENSIM_FROM_WORLD
from marey.io.markers.c3d import open_c3d, point_unit, read_c3d, y_points_up
from marey.io.markers.c3d_forces import force_plates_in
from marey.io.opensim.external_loads import EXTERNAL_LOADS, FORCES, write_external_loads, write_forces
from marey.io.units import METRES
from marey.markers.data.force_plates import ForcePlate
from marey.markers.preprocessing.foot_loads import FootLoad, foot_loads, plate_contacts, without_offset
from marey.motion.device_clock import DeviceClock
from marey.pipelines.exchange.opensim_person import OpenSimPerson

_FEET = {"left": "left_foot", "right": "right_foot"}
"""Segment of each foot, whose origin is the ankle."""
_NOTED_OFFSET_N = 5.0
"""Offset of a plate above which it is noted [N]. Chosen by hand."""


@dataclass(frozen=True, eq=False, kw_only=True)
class GroundForces:
    """The loads of the feet of a recording, in the laboratory of the file with the plates."""

    loads: tuple[FootLoad, ...]
    """Loads of feet on plates; empty if no load can be assigned to a foot."""
    spans: tuple[tuple[str, float, float], ...]
    """Side, begin and end of each contact that was assigned [s]."""
    start_s: float
    """Time of the first sample, on the clock of the motion [s]."""
    world_from_laboratory: Floats
    """(3, 3) rotation from the laboratory to the world (Z up)."""
    notes: tuple[str, ...]
    """What was decided or left out, one sentence each."""


def ground_forces(path: Path, person: OpenSimPerson, clock: DeviceClock | None = None) -> GroundForces:
    """Read the force plates of a C3D, and assign their loads to the feet of a person.

    Args:
        path: The C3D, in the laboratory of the results.
        person: The person, whose ankles decide.
        clock: The clock of the C3D relative to that of the results; None if they have one clock.

    Raises:
        FileProblem: The file has no force plates, or the feet of the person are unknown.
    """
    c3d = open_c3d(path)
    plates = force_plates_in(path, c3d, METRES[point_unit(path, c3d)])
    if not plates:
        raise FileProblem(path, "has no force plates", "Give the C3D with the group FORCE_PLATFORM (--forces).")
    feet = {side: name for side, name in _FEET.items() if name in person.motion.segments}
    if not feet:
        raise FileProblem(
            path, "cannot be used: the results have no segment left_foot or right_foot", "Add the feet to [segments]."
        )
    world = np.asarray(OPENSIM_FROM_WORLD.T if y_points_up(c3d) else np.eye(3))
    start_s = float(read_c3d(path).time[0])
    if clock is not None:
        start_s = float(clock.instants(np.asarray(start_s)))
        plates = tuple(replace(plate, rate=plate.rate / (1 + clock.drift)) for plate in plates)
    length = max(len(plate.force) / plate.rate for plate in plates)
    ankles = {side: _ankle(person, name, start_s, length) @ OPENSIM_FROM_WORLD @ world for side, name in feet.items()}
    return _assigned(plates, ankles, person.rate, start_s, world)


def _ankle(person: OpenSimPerson, segment: str, start_s: float, length_s: float) -> Floats:
    """Return the path of an ankle in OpenSim's ground (F, 3), from the first sample of the plates on, or NaN."""
    path = person.motion.bone(segment)[1]
    time = start_s + np.arange(int(np.ceil(length_s * person.rate)) + 1) / person.rate
    known = np.isfinite(path).all(1)
    if known.sum() < 2:
        return np.full((len(time), 3), np.nan)
    placed = np.stack([np.interp(time, person.time[known], path[known, i], np.nan, np.nan) for i in range(3)], 1)
    # Frames without an answer stay unknown.
    near = np.interp(time, person.time, known.astype(float), 0.0, 0.0) > 0.5
    return np.where(near[:, None], placed, np.nan)


def _assigned(
    plates: tuple[ForcePlate, ...], ankles: Mapping[str, Floats], rate: float, start_s: float, world: Floats
) -> GroundForces:
    """Assign the loads of plates to feet, and note what was left out."""
    notes, used = [], []
    for plate in plates:
        corrected, offset = without_offset(plate)
        used.append(corrected)
        if np.linalg.norm(offset) > _NOTED_OFFSET_N:
            by = ", ".join(f"{v:.1f}" for v in offset)
            notes.append(f"{plate.name} measures a force of {by} N (x, y, z) without a load; it was subtracted.")
    contacts = plate_contacts(used, ankles, rate=rate)
    rates = {plate.name: plate.rate for plate in used}
    spans = []
    for contact in contacts:
        begin, end = (start_s + sample / rates[contact.plate] for sample in (contact.begin, contact.end))
        if contact.side is None:
            notes.append(f"The load of {contact.plate} from {begin:.2f} to {end:.2f} s is left out: {contact.problem}.")
        else:
            spans.append((contact.side, begin, end))
            notes.append(f"{contact.plate} carries the {contact.side} foot from {begin:.2f} to {end:.2f} s.")
    return GroundForces(
        loads=foot_loads(used, contacts), spans=tuple(spans), start_s=start_s, world_from_laboratory=world,
        notes=tuple(notes),
    )  # fmt: skip


def has_force_plates(path: Path) -> bool:
    """Return whether a C3D has force plates that can be read."""
    try:
        c3d = open_c3d(path)
        return bool(force_plates_in(path, c3d, METRES[point_unit(path, c3d)]))
    except FileProblem:
        return False


def write_ground_forces(folder: Path, forces: GroundForces, bodies: Mapping[str, str]) -> None:
    """Write `grf.mot` and `external_loads.xml`.

    Args:
        folder: The folder.
        forces: Loads of at least one foot.
        bodies: Maps `left` and `right` to the body of the model that is the foot.
    """
    write_forces(
        folder / FORCES, forces.loads, start_s=forces.start_s, world_from_laboratory=forces.world_from_laboratory
    )
    write_external_loads(folder / EXTERNAL_LOADS, forces.loads, bodies)
