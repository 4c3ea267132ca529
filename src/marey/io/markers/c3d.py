"""Reading and writing C3D files: points in millimetres, and poses as 4x4 matrices in the group ROTATION."""

import struct
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

import ezc3d
import numpy as np

from marey.arrays import Floats
from marey.errors import FileProblem
from marey.io.atomic import replacing, require_complete, reserve
from marey.io.markers.c3d_structure import BLOCK, BYTES_OF_A_ROTATION, c3d_structure
from marey.io.markers.marker_csv import RawMarkers
from marey.io.opensim.trc import PointPaths
from marey.io.units import METRES, MM_PER_M
from marey.motion.events.cycles import STRIKE, GaitEvent

_COMPUTED = ("ANGLES", "FORCES", "MOMENTS", "POWERS", "SCALARS")
"""Parameters of a C3D that list points that are not positions."""
_MOST_FRAMES = 65535
"""Largest frame number that the header of a C3D can hold, an unsigned 16-bit integer."""
_MOST_PARAMETER_BLOCKS = 256
"""Largest number of blocks of the parameters, and of the padding before the rotations, by the format."""


def write_c3d(
    path: Path | str,
    paths: PointPaths,
    *,
    segment_names: tuple[str, ...] = (),
    segment_rotation: Floats | None = None,
    segment_origin: Floats | None = None,
    events: Sequence[GaitEvent] = (),
) -> None:
    """Write points, poses of segments and events; see `c3d_of_points`.

    Args:
        path: The file.
        paths: The points.
        segment_names: Names of the S segments.
        segment_rotation: (F, S, 3, 3) world from segment.
        segment_origin: (F, S, 3) [m].
        events: Gait events, with times from the first frame on.
    """
    c3d = c3d_of_points(
        paths, segment_names=segment_names, segment_rotation=segment_rotation, segment_origin=segment_origin,
        events=events,
    )  # fmt: skip
    with replacing(path) as temporary:
        save_c3d(c3d, temporary)


def c3d_of_points(
    paths: PointPaths, *, segment_names: tuple[str, ...] = (), segment_rotation: Floats | None = None,
    segment_origin: Floats | None = None, events: Sequence[GaitEvent] = (),
) -> ezc3d.c3d:  # fmt: skip
    """Return the content of a C3D: points and poses of segments in millimetres and the world's axes (Z up).

    A missing point has the residual -1; a missing pose is NaN. The poses are 4x4 matrices, world from segment, in the
    group ROTATION under the names `<segment>_4X4`.

    Args:
        paths: The points.
        segment_names: Names of the S segments.
        segment_rotation: (F, S, 3, 3) world from segment.
        segment_origin: (F, S, 3) [m].
        events: Gait events, with times from the first frame on.
    """
    frames = len(paths.time)
    points = np.ones((4, len(paths.names), frames))
    points[:3] = np.transpose(paths.points, (2, 1, 0)) * MM_PER_M
    missing = np.isnan(points).any(0)
    points[:3, missing] = 0
    c3d = ezc3d.c3d()
    parameters = c3d["parameters"]
    parameters["POINT"]["RATE"]["value"] = [paths.rate]
    parameters["POINT"]["UNITS"]["value"] = ["mm"]
    parameters["POINT"]["LABELS"]["value"] = list(paths.names)
    c3d["data"]["points"] = points
    c3d["data"]["meta_points"]["residuals"] = np.where(missing, -1.0, 0.0)[None]
    c3d["data"]["meta_points"]["camera_masks"] = np.zeros((7, *missing.shape), bool)
    c3d.add_parameter("MANUFACTURER", "SOFTWARE", ["marey"])
    if frames > _MOST_FRAMES:  # beyond the range of the header, the true number is in two 16-bit words
        low, high = frames % 65536, frames // 65536
        c3d.add_parameter("TRIAL", "ACTUAL_START_FIELD", [1, 0])
        c3d.add_parameter("TRIAL", "ACTUAL_END_FIELD", [low - 65536 if low > 32767 else low, high])
    if segment_rotation is not None and segment_origin is not None:
        add_rotations(c3d, segment_names, segment_rotation, segment_origin * MM_PER_M)
    add_events(c3d, events)
    return c3d


def save_c3d(c3d: ezc3d.c3d, path: Path) -> None:
    """Write a C3D, after its space on the disk has been reserved, because ezc3d does not report a full disk.

    Args:
        c3d: The content.
        path: The temporary file of `marey.io.atomic.replacing`.

    Raises:
        OSError: There is not enough space.
    """
    data = c3d["data"]
    numbers = sum(np.size(data[name]) for name in ("points", "analogs"))
    poses = np.size(data["rotations"]) // 16 if "rotations" in data else 0
    least = 2 * BLOCK + 4 * numbers + BYTES_OF_A_ROTATION * poses
    reserve(path, least + _MOST_PARAMETER_BLOCKS * BLOCK)
    c3d.write(str(path))
    require_complete(path, complete=path.stat().st_size >= least)


def add_rotations(c3d: ezc3d.c3d, names: tuple[str, ...], rotation: Floats, origin: Floats) -> None:
    """Add poses to a C3D as 4x4 matrices, world from segment, in the group ROTATION under `<segment>_4X4`.

    Args:
        c3d: The content of the file; existing poses are replaced.
        names: Names of the S segments.
        rotation: (F, S, 3, 3) world from segment.
        origin: (F, S, 3) in the unit of the file's points.
    """
    matrices = np.zeros((4, 4, len(names), len(rotation)))
    matrices[:3, :3] = np.transpose(rotation, (2, 3, 1, 0))
    matrices[:3, 3] = np.transpose(origin, (2, 1, 0))
    matrices[3, 3] = 1
    c3d.add_parameter("ROTATION", "USED", [len(names)])
    c3d.add_parameter("ROTATION", "RATE", [float(c3d["parameters"]["POINT"]["RATE"]["value"][0])])
    c3d.add_parameter("ROTATION", "RATIO", [1])
    c3d.add_parameter("ROTATION", "LABELS", [f"{name}_4X4" for name in names])
    c3d["data"]["rotations"] = matrices


def add_points(c3d: ezc3d.c3d, paths: Mapping[str, Floats]) -> None:
    """Add points to a C3D; a point whose label exists is replaced.

    Args:
        c3d: The content of the file.
        paths: Maps a label to positions (F, 3) in the unit of the file; NaN where missing.
    """
    data, labels = c3d["data"], list(point_labels(c3d))
    labels += [f"*{n}" for n in range(len(labels), data["points"].shape[1])]
    new = [label for label in paths if label not in labels]
    if new:
        _widen(c3d, labels, new)
    labels += new
    for label, path in paths.items():
        at, missing = labels.index(label), np.isnan(path).any(-1)
        data["points"][:3, at] = np.where(missing, 0.0, path.T)
        data["meta_points"]["residuals"][0, at] = np.where(missing, -1.0, 0.0)


def _widen(c3d: ezc3d.c3d, labels: Sequence[str], new: Sequence[str]) -> None:
    """Make room for new points behind those of a C3D."""
    point, data = c3d["parameters"]["POINT"], c3d["data"]
    for key in [key for key in point if key.startswith("LABELS") and key != "LABELS"]:
        del point[key]
    point["LABELS"]["value"] = [*labels, *new]
    meta, room = data["meta_points"], (len(new), data["points"].shape[2])
    data["points"] = np.concatenate([data["points"], np.ones((4, *room))], 1)
    meta["residuals"] = np.concatenate([meta["residuals"], np.zeros((1, *room))], 1)
    meta["camera_masks"] = np.concatenate([meta["camera_masks"], np.zeros((7, *room), bool)], 1)


def add_events(c3d: ezc3d.c3d, events: Sequence[GaitEvent], *, person: str = "") -> None:
    """Add gait events to a C3D: Foot Strike and Foot Off with their sides, in the group EVENT.

    Args:
        c3d: The content of the file; existing events are replaced.
        events: Events on the clock of the file; without any, the file is left as it is.
        person: Name of the person whose events they are, for a file that states names.
    """
    if not events:
        return
    minutes, seconds = np.divmod([event.time for event in events], 60.0)
    c3d.add_parameter("EVENT", "USED", [len(events)])
    c3d.add_parameter("EVENT", "CONTEXTS", [(event.side or "general").capitalize() for event in events])
    c3d.add_parameter("EVENT", "LABELS", ["Foot Strike" if event.kind == STRIKE else "Foot Off" for event in events])
    c3d.add_parameter("EVENT", "TIMES", np.stack([minutes, seconds]))
    if "SUBJECTS" in c3d["parameters"]["EVENT"]:
        c3d.add_parameter("EVENT", "SUBJECTS", [person] * len(events))


def open_c3d(path: Path | str) -> ezc3d.c3d:
    """Open a C3D after checking that it is complete.

    Args:
        path: The file.

    Returns:
        The content of the file.

    Raises:
        FileProblem: The file does not exist, is not a C3D, or is truncated.
    """
    if not Path(path).is_file():
        raise FileProblem(path, "does not exist", "Give a C3D file.")
    try:
        if not c3d_structure(Path(path).read_bytes()).is_complete:
            raise FileProblem(path, "is truncated: it ends before its data", "Copy or export the file again.")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # ezc3d warns about parameters that are irrelevant for points
            return ezc3d.c3d(str(path))
    except (struct.error, IndexError) as error:
        raise FileProblem(path, "is too short for a C3D file", "Export the file again.") from error
    except (OSError, RuntimeError, ValueError) as error:
        raise FileProblem(path, f"cannot be read as C3D ({error})", "Export the file again.") from error


def point_unit(path: Path | str, c3d: ezc3d.c3d) -> str:
    """Return the unit of the points in a C3D: mm, cm or m.

    Raises:
        FileProblem: The unit is none of these.
    """
    unit = (c3d["parameters"]["POINT"]["UNITS"]["value"] or [""])[0].strip()
    if unit.lower() not in METRES:
        raise FileProblem(path, f"has the unit {unit!r}", f"POINT:UNITS should be {', '.join(METRES)}.")
    return str(unit.lower())


def point_labels(c3d: ezc3d.c3d) -> tuple[str, ...]:
    """Return the labels of all points in a C3D, also beyond the 255th, in the order of the points."""
    point = c3d["parameters"]["POINT"]
    labels = [label for key in point if key.startswith("LABELS") for label in (point[key]["value"] or [])]
    return tuple(labels[: c3d["data"]["points"].shape[1]])


def positions_in(c3d: ezc3d.c3d, unit: str) -> RawMarkers:
    """Return the points of a C3D that are positions, and not angles, forces, moments or powers.

    Args:
        c3d: The content of the file.
        unit: Unit of the points: mm, cm or m.
    """
    point = c3d["parameters"]["POINT"]
    lists = [key for key in point if key.rstrip("0123456789") in _COMPUTED]  # ANGLES2 goes on with ANGLES
    computed = {label for key in lists for label in (point[key]["value"] or [])}
    labels = list(point_labels(c3d))
    labels += [f"*{n}" for n in range(len(labels), c3d["data"]["points"].shape[1])]
    kept = [n for n, label in enumerate(labels) if label not in computed]
    points = np.transpose(c3d["data"]["points"][:3, kept], (2, 1, 0)) * METRES[unit]
    residuals = np.transpose(c3d["data"]["meta_points"]["residuals"][0][kept]) * METRES[unit]
    points = np.where((residuals < 0)[..., None] | ~np.isfinite(points).all(-1, keepdims=True), np.nan, points)
    # Programs write a residual of zero if they have none.
    residuals = np.where(residuals > 0, residuals, np.nan)
    rate = float((point["RATE"]["value"] or [0])[0])
    start = int(c3d["header"]["points"]["first_frame"]) / rate if rate > 0 else 0.0
    notes = []
    if computed:
        notes = [f"{len(computed)} points are not positions (but angles, forces, moments, powers) and are ignored."]
    return [labels[n] or f"*{n}" for n in kept], points, residuals, rate, start, unit, notes


def y_points_up(c3d: ezc3d.c3d) -> bool:
    """Return whether Y points up in the laboratory of a C3D: its POINT:Y_SCREEN is +Y."""
    point = c3d["parameters"]["POINT"]
    return "Y_SCREEN" in point and str((point["Y_SCREEN"]["value"] or [""])[0]).strip() == "+Y"


def read_c3d(path: Path | str) -> PointPaths:
    """Read the points of a C3D in metres and the file's own axes.

    Args:
        path: The file.

    Returns:
        The paths of the points.

    Raises:
        FileProblem: The file is not a C3D, or its unit is unknown.
    """
    c3d = open_c3d(path)
    points = np.transpose(c3d["data"]["points"][:3], (2, 1, 0)) * METRES[point_unit(path, c3d)]
    rate = float(c3d["parameters"]["POINT"]["RATE"]["value"][0])
    time = (c3d["header"]["points"]["first_frame"] + np.arange(len(points))) / rate
    return PointPaths(names=point_labels(c3d), time=time, rate=rate, points=points)
