"""People in a C3D: measurements, as Vicon's programs write them in PROCESSING, and the prefixes of labels."""

import re
from collections.abc import Mapping
from itertools import zip_longest
from typing import Any

import ezc3d
import numpy as np

from marey.io.units import METRES
from marey.markers.data.person import DIAMETERS, LENGTHS, PersonMeasurements

_NAME = re.compile(r"(?P<side>left|right|l|r)(?P<what>leglength|kneewidth|anklewidth)")
"""Name of a measurement, in small letters and without spaces."""
_WHAT = {what.replace("_", ""): what for what in LENGTHS}
"""Names of the measurements by their spelling in the files."""
_OFFSETS = re.compile(r"(left|right|l|r)(thighrotation|shankrotation|tibialtorsion)")
"""Names of rotations of the joints' axes about the long axes, in small letters and without spaces."""
_GROUPS = ("PROCESSING", "ANALYSIS", "SUBJECTS", "SUBJECT")
"""Groups of parameters in which programs write measurements, the first with a value counts. Vicon's programs write
PROCESSING."""
_DIAMETER = "markerdiameter"
"""Name of the markers' diameter, in small letters and without spaces."""


def measurements_in(c3d: ezc3d.c3d, unit: str) -> tuple[PersonMeasurements, tuple[str, ...]]:
    """Return what a C3D states of the person's legs and of the markers.

    Args:
        c3d: The content of the file.
        unit: Unit of the points. The measurements are in millimetres, or else in this unit.

    Returns:
        The measurements, and a note on each that is impossible and on each rotation of a joint's axis, which are
        ignored. Zero stands for an unknown value.
    """
    found, notes = PersonMeasurements(), list[str]()
    for group in _GROUPS:
        stated, more = _in_group(group, c3d["parameters"].get(group, {}), unit)
        found = found.completed_by(stated)
        notes += more
    return found, tuple(notes)


def subjects_in(c3d: ezc3d.c3d) -> dict[str, str]:
    """Return the prefixes of labels that a C3D states, each with the name of the person (SUBJECTS).

    Args:
        c3d: The content of the file.
    """
    group = c3d["parameters"].get("SUBJECTS", {})
    names, prefixes = (
        [str(text).strip() for text in (group[key]["value"] if key in group else [])]
        for key in ("NAMES", "LABEL_PREFIXES")
    )
    return {
        prefix: name or prefix.rstrip(":_ .-") or prefix
        for prefix, name in zip_longest(prefixes, names[: len(prefixes)], fillvalue="") if prefix
    }  # fmt: skip


def _in_group(group: str, parameters: Mapping[str, Any], unit: str) -> tuple[PersonMeasurements, list[str]]:
    """Return the measurements of one group of parameters, with notes on what is ignored."""
    lengths: dict[str, float] = {}
    diameter, notes = None, list[str]()
    for name, held in parameters.items():
        plain = re.sub(r"[\s_]", "", name).lower()
        match, values = _NAME.fullmatch(plain), np.ravel(held["value"] if name != "__METADATA__" else [])
        if values.dtype.kind not in "fiu" or values.size != 1 or values[0] == 0 or not np.isfinite(values[0]):
            continue
        if _OFFSETS.fullmatch(plain):
            notes.append(f"{group}:{name} of {values[0]:g} degrees is not used: the plane is that of the markers.")
        if match is None and plain != _DIAMETER:
            continue
        low, high = DIAMETERS if match is None else LENGTHS[_WHAT[match["what"]]]
        possible = [x for x in (float(values[0]) * METRES[u] for u in ("mm", unit)) if low <= x <= high]
        length = possible[0] if possible else 0.0
        if not possible:
            notes.append(f"{group}:{name} of {values[0]:g} is impossible and is ignored.")
        elif match is None:
            diameter = length
        else:
            side = "left" if match["side"].startswith("l") else "right"
            lengths[f"{side}_{_WHAT[match['what']]}"] = length
    return PersonMeasurements(lengths=lengths, diameter_m=diameter), notes
