"""Writing anatomical angles and segment parameters to CSV."""

import csv
from collections.abc import Sequence
from pathlib import Path

from marey.arrays import Floats, Mask
from marey.body.metaballs.segment_measures import SegmentMeasures
from marey.io.atomic import replacing
from marey.motion.motion import BodyMotion

NOT_DETERMINED = "not_determined"
"""Name of the column of `angles.csv` with the angles that the images of a frame do not determine."""


def write_angles(path: Path | str, motion: BodyMotion) -> None:
    """Write `angles.csv`: one row per frame with time, state, and every angle with its standard deviation.

    The names of the columns include the units; cells of unknown angles are empty. The last column names the angles that
    the images of the frame do not determine, with spaces between them; it is missing if that is not known.

    Args:
        path: The file.
        motion: The motion to write.
    """
    head = ["time_s", "state"] + [f"{name}{end}" for name in motion.angle_names for end in ("_deg", "_sd_deg")]
    flags = motion.angles_determined
    with replacing(path) as temporary, temporary.open("w", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(head if flags is None else [*head, NOT_DETERMINED])
        for f, (time, state, angles, sds) in enumerate(
            zip(motion.time, motion.state, motion.angles_deg, motion.angles_deg_sd, strict=True)
        ):
            cells = [value for pair in zip(angles, sds, strict=True) for value in pair]
            row = [f"{time:.6f}", int(state), *("" if v != v else f"{v:.5f}" for v in cells)]
            open_ones = [] if flags is None else [" ".join(_not_determined(motion.angle_names, angles, flags[f]))]
            rows.writerow([*row, *open_ones])


def _not_determined(names: Sequence[str], angles: Floats, determined: Mask) -> list[str]:
    """Return the names of the angles of a frame that have a value which the images do not determine."""
    return [name for name, value, sure in zip(names, angles, determined, strict=True) if value == value and not sure]


def write_segments(path: Path | str, measures: SegmentMeasures, length: Floats, length_sd: Floats) -> None:
    """Write `segments.csv`: one row per segment, every parameter with its standard deviation.

    The units are metres, litres, kilograms and kg m2. Centres of mass are relative to the proximal joint centre, along
    the axes of the rest posture (X to the person's left, Y backward, Z up); cells of unknown values are empty.
    A girth that is not determined has an empty cell beside its standard deviation. `equal_by_model_to` names the
    segment of the other side if the model holds both equal: they are one measurement.

    Args:
        path: The file.
        measures: The parameters of n segments.
        length: (n,) lengths [m].
        length_sd: (n,) standard deviations of the lengths [m].
    """
    girths = ("girth_proximal_m", "girth_middle_m", "girth_distal_m")
    columns = {"length_m": (length, length_sd)}
    columns |= {name: (measures.girth[:, i], measures.girth_sd[:, i]) for i, name in enumerate(girths)}
    columns |= {
        "volume_l": (1e3 * measures.volume, 1e3 * measures.volume_sd),
        "mass_kg": (measures.mass, measures.mass_sd),
    }
    for i, axis in enumerate("xyz"):
        columns[f"centre_{axis}_m"] = (measures.centre[:, i], measures.centre_sd[:, i])
    for i, axes in enumerate(("xx", "yy", "zz", "xy", "xz", "yz")):
        columns[f"inertia_{axes}_kgm2"] = (measures.inertia[:, i], measures.inertia_sd[:, i])
    with replacing(path) as temporary, temporary.open("w", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(["segment", *(part for name in columns for part in (name, _sd_of(name))), "equal_by_model_to"])
        for i, segment in enumerate(measures.names):
            cells = [float(values[i]) for pair in columns.values() for values in pair]
            rows.writerow([segment, *map(_number_text, cells), measures.equal_side(segment)])


def _number_text(value: float) -> str:
    """Return a number as a cell; an unknown one is empty."""
    return "" if value != value else f"{value:.6g}"


def _sd_of(column: str) -> str:
    """Return the name of the column of a standard deviation: `length_sd_m` for `length_m`."""
    name, _, unit = column.rpartition("_")
    return f"{name}_sd_{unit}"
