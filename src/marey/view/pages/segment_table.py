"""The tables of a person's segments on the page of `marey shape`: `segments.csv` with intervals."""

from collections.abc import Sequence

import numpy as np

from marey.arrays import Floats
from marey.body.metaballs.segment_measures import SegmentMeasures
from marey.view.pages.curves import NumberTable
from marey.view.pages.problems import readable

_SIZES = (
    "Values with 95 % intervals, from joint centre to joint centre; girths at 1/4, 1/2 and 3/4 of the length. Where "
    "the model holds both sides equal, two rows are one measurement. Empty cells: not defined for the segment. "
    "segments.csv contains the standard deviations."
)
"""Legend of the table of sizes."""
_MASSES = (
    "Values with 95 % intervals. The centre of mass is measured from the joint about which the segment turns, "
    "along the axes of the rest posture (X to the left, Y backward, Z up); the inertia I is about that centre. "
    "A mass is the volume times a density from the literature."
)
"""Legend of the table of masses."""
_CM, _KG_CM2 = 100.0, 1e4
"""Centimetres per metre, and kg cm2 per kg m2."""


def segment_tables(measures: SegmentMeasures, length: Floats, length_sd: Floats) -> list[NumberTable]:
    """Return the tables of sizes, and of masses, of n segments.

    Args:
        measures: Girths, volumes, masses, centres of mass and inertia of the segments.
        length: (n,) lengths [m].
        length_sd: (n,) standard deviations of the lengths [m].
    """
    names = [readable(name) for name in measures.names]
    equal = [readable(measures.equal_side(name)) for name in measures.names]
    sizes = [
        _cells(_CM * length, _CM * length_sd, 1),
        *(_cells(_CM * measures.girth[:, i], _CM * measures.girth_sd[:, i], 1) for i in range(3)),
        _cells(1e3 * measures.volume, 1e3 * measures.volume_sd, 2),
    ]
    masses = [
        _cells(measures.mass, measures.mass_sd, 2),
        *(_cells(_CM * measures.centre[:, i], _CM * measures.centre_sd[:, i], 1) for i in range(3)),
        *(_cells(_KG_CM2 * measures.inertia[:, i], _KG_CM2 * measures.inertia_sd[:, i], 0) for i in range(6)),
    ]
    girths = [f"girth {where} cm" for where in ("1/4", "1/2", "3/4")]
    centres = [f"centre {axis} cm" for axis in "xyz"]
    inertia = [f"I{axes} kg cm²" for axes in ("xx", "yy", "zz", "xy", "xz", "yz")]
    return [
        NumberTable(
            title="Segments", head=("segment", "length cm", *girths, "volume l", "equal by the model to"),
            rows=[list(row) for row in zip(names, *sizes, equal, strict=True)], text_columns=(0, 6), legend=_SIZES,
        ),
        NumberTable(
            title="Masses of the segments", head=("segment", "mass kg", *centres, *inertia),
            rows=[list(row) for row in zip(names, *masses, strict=True)], legend=_MASSES,
        ),
    ]  # fmt: skip


def _cells(values: Floats, sds: Floats, digits: int) -> Sequence[str]:
    """Return values with their 95 % intervals as texts; an unknown value is empty, an unknown interval is named."""
    texts = []
    for value, sd in zip(values, sds, strict=True):
        spread = f"{1.96 * sd:.{digits}f}" if np.isfinite(sd) else "unknown"
        shown = np.round(value, digits) + 0.0  # Without the sign of a zero.
        texts.append(f"{shown:.{digits}f} ± {spread}".replace("-", "−") if np.isfinite(value) else "")
    return texts
