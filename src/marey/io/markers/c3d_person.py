"""Measurements of a person in a C3D: the group PROCESSING, as Vicon's programs write it."""

import re

import ezc3d
import numpy as np

from marey.io.units import METRES
from marey.markers.data.person import DIAMETERS, LENGTHS, PersonMeasurements

_NAME = re.compile(r"(?P<side>left|right|l|r)(?P<what>leglength|kneewidth|anklewidth)")
"""Name of a measurement, in small letters and without spaces."""
_WHAT = {what.replace("_", ""): what for what in LENGTHS}
"""Names of the measurements by their spelling in the files."""
_DIAMETER = "markerdiameter"
"""Name of the markers' diameter, in small letters and without spaces."""


def measurements_in(c3d: ezc3d.c3d, unit: str) -> tuple[PersonMeasurements, tuple[str, ...]]:
    """Return what a C3D states of the person's legs and of the markers.

    Args:
        c3d: The content of the file.
        unit: Unit of the points, which is that of the measurements.

    Returns:
        The measurements, and a note on each that is impossible and therefore ignored. Zero stands for an unknown one.
    """
    lengths: dict[str, float] = {}
    diameter, notes = None, []
    for name, held in c3d["parameters"].get("PROCESSING", {}).items():
        plain = re.sub(r"[\s_]", "", name).lower()
        match, values = _NAME.fullmatch(plain), np.ravel(held["value"] if name != "__METADATA__" else [])
        if (match is None and plain != _DIAMETER) or values.dtype.kind not in "fiu" or values.size != 1:
            continue
        length = float(values[0]) * METRES[unit]
        low, high = DIAMETERS if match is None else LENGTHS[_WHAT[match["what"]]]
        if length == 0 or not np.isfinite(length):
            continue
        if not low <= length <= high:
            notes.append(f"PROCESSING:{name} of {values[0]:g} {unit} is impossible and is ignored.")
        elif match is None:
            diameter = length
        else:
            side = "left" if match["side"].startswith("l") else "right"
            lengths[f"{side}_{_WHAT[match['what']]}"] = length
    return PersonMeasurements(lengths=lengths, diameter_m=diameter), tuple(notes)
