"""Reading gait events and force plates from C3D files."""

from pathlib import Path
from typing import Any

import ezc3d
import numpy as np

from marey.arrays import Floats
from marey.errors import FileProblem
from marey.io.markers.c3d import open_c3d, point_unit
from marey.io.units import METRES
from marey.markers.data.force_plates import ForcePlate
from marey.markers.kinematics.transform_chain import CAPTURE_GLOBAL, NamedTransform
from marey.motion.events.cycles import GIVEN, OFF, STRIKE, GaitEvent

_KINDS = {"foot strike": STRIKE, "heel strike": STRIKE, "foot off": OFF, "toe off": OFF}
"""Kind of a gait event by its label in the file, in lower case."""
_CHANNELS = {1: 6, 2: 6, 3: 8, 4: 6}
"""Number of analog channels by type of force plate, by the definition of the C3D format."""


def read_events(path: Path | str) -> tuple[GaitEvent, ...]:
    """Read the gait events of a C3D file; see `events_in`.

    Raises:
        FileProblem: The file is not a C3D.
    """
    return events_in(open_c3d(path))


def events_in(c3d: ezc3d.c3d) -> tuple[GaitEvent, ...]:
    """Return the gait events in a C3D: Foot Strike and Foot Off of the left and the right foot.

    Args:
        c3d: The content of the file.

    Returns:
        The events in the order of time; other events are skipped.
    """
    found = [event for own in events_by_person(c3d).values() for event in own]
    return tuple(sorted(found, key=lambda e: e.time))


def events_by_person(c3d: ezc3d.c3d) -> dict[str, tuple[GaitEvent, ...]]:
    """Return the gait events in a C3D by the person whose they are (EVENT:SUBJECTS).

    Args:
        c3d: The content of the file.

    Returns:
        The events of each person in the order of time; those of nobody are under the empty text.
    """
    group = c3d["parameters"]
    event = group.get("EVENT", {})
    if not event or not (_values(event, "USED") or [0])[0]:
        return {}
    times = np.asarray(_values(event, "TIMES"), float)
    times = times.reshape(2, -1, order="F") if times.ndim == 1 and times.size % 2 == 0 else times
    if times.ndim != 2 or len(times) != 2:
        return {}
    labels, sides, names = (_values(event, key) for key in ("LABELS", "CONTEXTS", "SUBJECTS"))
    found: dict[str, list[GaitEvent]] = {}
    for n, label in enumerate(labels):
        kind = _KINDS.get(str(label).strip().lower())
        if kind is not None and n < times.shape[1]:
            side = str(sides[n]).strip().lower() if n < len(sides) else ""
            time = float(60 * times[0, n] + times[1, n])
            known = side if side in ("left", "right") else None
            name = str(names[n]).strip() if n < len(names) else ""
            found.setdefault(name, []).append(GaitEvent(kind=kind, side=known, time=time, source=GIVEN))
    return {name: tuple(sorted(own, key=lambda e: e.time)) for name, own in found.items()}


def _values(group: ezc3d.c3d, key: str) -> list[Any]:
    return list(group[key]["value"]) if key in group else []


def read_force_plates(path: Path | str) -> tuple[ForcePlate, ...]:
    """Read the force plates of a C3D file; see `force_plates_in`.

    Raises:
        FileProblem: The file is not a C3D, or a plate has an unsupported type or lacks channels.
    """
    c3d = open_c3d(path)
    return force_plates_in(path, c3d, METRES[point_unit(path, c3d)])


def force_plates_in(path: Path | str, c3d: ezc3d.c3d, metres: float) -> tuple[ForcePlate, ...]:
    """Return the force plates in a C3D: their corners, ground reaction forces and moments.

    Plates of types 1 to 4 are supported. The baseline in the frames of FORCE_PLATFORM:ZERO is subtracted. The sign of
    the force is chosen so that the plate supports the person.

    Args:
        path: The file, for error messages.
        c3d: The content of the file.
        metres: Length of the unit of the points [m].

    Raises:
        FileProblem: A plate has an unsupported type or lacks channels.
    """
    group = c3d["parameters"].get("FORCE_PLATFORM", {})
    used = int((_values(group, "USED") or [0])[0])
    try:
        return tuple(_plate(Path(path), c3d, n, metres) for n in range(used))
    except (KeyError, IndexError, ValueError, TypeError) as error:
        wrong = f"has force plates that are not described completely ({error})"
        raise FileProblem(path, wrong, "Export the file with the group FORCE_PLATFORM.") from error


def plate_frames(path: Path | str) -> tuple[NamedTransform, ...]:
    """Return the frames of the force plates as named transforms: `capture global` from `force_plate_1`, ... [m]."""
    frames = [(plate.name, plate.laboratory_from_plate) for plate in read_force_plates(path)]
    return tuple(
        NamedTransform(to=CAPTURE_GLOBAL, from_=name, rotation=frame.rotation, translation=frame.translation)
        for name, frame in frames
    )


def _plate(path: Path, c3d: ezc3d.c3d, n: int, metres: float) -> ForcePlate:
    """Read one plate."""
    group, name = c3d["parameters"]["FORCE_PLATFORM"], f"force_plate_{n + 1}"
    kind = int(group["TYPE"]["value"][n])
    if kind not in _CHANNELS:
        raise FileProblem(path, f"has {name} of type {kind}", "Types 1 to 4 are supported.")
    numbers = np.asarray(group["CHANNEL"]["value"], int).reshape(-1, np.shape(group["CHANNEL"]["value"])[-1])
    numbers = numbers[: _CHANNELS[kind], n]
    analogs = c3d["data"]["analogs"][0]
    if numbers.min() < 1 or numbers.max() > len(analogs):
        wrong = f"lacks analog channels that {name} refers to"
        raise FileProblem(path, wrong, "Export the file with its analog channels.")
    signals = analogs[numbers - 1].T.copy()
    _subtract_baseline(signals, c3d)
    if kind == 4:
        matrix = np.asarray(group["CAL_MATRIX"]["value"], float)[:, :, n]
        signals = signals @ matrix.T
    origin = np.asarray(group["ORIGIN"]["value"], float)[:, n] * metres
    force, moment = _at_surface(kind, signals, origin, _moment_metres(c3d, numbers, metres))
    corners = np.asarray(group["CORNERS"]["value"], float)[:, :, n].T * metres
    bare = ForcePlate(name=name, corners=corners, rate=1.0, force=np.zeros((0, 3)), moment=np.zeros((0, 3)))
    turn = bare.laboratory_from_plate.rotation
    sign = _sign_of_reaction(force @ turn.T, turn[:, 2])
    rate = float(c3d["parameters"]["ANALOG"]["RATE"]["value"][0])
    return ForcePlate(name=name, corners=corners, rate=rate, force=sign * force @ turn.T, moment=sign * moment @ turn.T)


def _subtract_baseline(signals: Floats, c3d: ezc3d.c3d) -> None:
    """Subtract the mean of each channel in the frames of FORCE_PLATFORM:ZERO, counted from 1, in place."""
    zero = [int(v) for v in _values(c3d["parameters"]["FORCE_PLATFORM"], "ZERO")]
    if len(zero) == 2 and 1 <= zero[0] <= zero[1]:
        each = max(1, round(len(signals) / max(1, c3d["data"]["points"].shape[2])))
        stretch = signals[(zero[0] - 1) * each : zero[1] * each]
        if len(stretch):
            signals -= stretch.mean(0)


def _moment_metres(c3d: ezc3d.c3d, numbers: np.ndarray, metres: float) -> float:
    """Return the length in the unit of moments [m]: that of the channels (`Nmm`, `Nm`) if given, else of the points."""
    units = _values(c3d["parameters"]["ANALOG"], "UNITS")
    unit = str(units[numbers[-1] - 1]).strip().lower() if numbers[-1] - 1 < len(units) else ""
    return {"nmm": 1e-3, "ncm": 1e-2, "nm": 1.0}.get(unit.replace("*", "").replace(".", ""), metres)


def _at_surface(kind: int, signals: Floats, origin: Floats, moment_metres: float) -> tuple[Floats, Floats]:
    """Convert the channels to force [N] and moment about the centre of the surface [N m], in the plate's axes."""
    if kind == 1:  # force, centre of pressure, free moment
        force = signals[:, :3]
        free = np.stack([0 * signals[:, 5], 0 * signals[:, 5], signals[:, 5] * moment_metres], -1)
        pressure = np.concatenate([signals[:, 3:5] * moment_metres, np.zeros((len(signals), 1))], 1)
        return force, free + np.cross(pressure, force)
    if kind == 3:  # four sensors; the origin holds their distances and the depth
        a, b, depth = origin
        x12, x34, y14, y23, *z = signals.T
        force = np.stack([x12 + x34, y14 + y23, z[0] + z[1] + z[2] + z[3]], -1)
        moment = np.stack([
            b * (z[0] + z[1] - z[2] - z[3]), a * (z[1] + z[2] - z[0] - z[3]), b * (x34 - x12) + a * (y14 - y23),
        ], -1)  # fmt: skip
        to_surface = np.array([0.0, 0.0, -abs(depth)])
    else:
        force, moment = signals[:, :3], signals[:, 3:] * moment_metres
        # The vector from the sensors to the centre of the surface above; some programs write it with the opposite sign.
        to_surface = -origin if origin[2] > 0 else origin
    return force, moment - np.cross(to_surface, force)


def _sign_of_reaction(force: Floats, normal: Floats) -> float:
    """Return 1 if the forces act on the person, -1 if they act on the plate.

    The normal points down, along the plate's Z; the force that supports a person points up, against it.
    """
    along = force @ normal
    heaviest = along[int(np.argmax(np.abs(along)))] if len(along) else 0.0
    return 1.0 if heaviest <= 0 else -1.0
