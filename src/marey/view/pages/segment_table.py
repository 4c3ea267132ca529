"""The tables of a person's segments on the page of `marey shape`: `segments.csv` with intervals."""

from collections.abc import Sequence

import numpy as np

from marey.arrays import Floats
from marey.body.metaballs.segment_measures import MOST_GIRTH_SD, SegmentMeasures
from marey.view.pages.curves import NumberTable
from marey.view.pages.problems import readable

_SIZES = (
    "Values with 95 % intervals, from joint centre to joint centre; girths at 1/4, 1/2 and 3/4 of the length. "
    "{equal}Empty cells: not defined for the segment. {lost}segments.csv contains the standard deviations."
)
"""Legend of the table of sizes."""
_EQUAL_LENGTHS = "The lengths of both sides are equal by the model: two rows are one measurement. "
"""What the legend adds if the lengths of both sides are equal."""
_LOST_GIRTHS = (
    "Not determined: the standard deviation exceeds {most:.0f} % of the girth, the spread among people of the same "
    "size, as near shoulders and hips, where a limb merges with the trunk. "
)
"""What the legend adds if girths are not determined."""
_MASSES = (
    "Values with 95 % intervals. The centre of mass is measured from the joint about which the segment turns. Axes of "
    "this table only: those of the rest posture, X to the person's left, Y backward, Z up. The inertia I is about the "
    "centre of mass. A mass is the volume times a density from the literature; compare the mass of all segments "
    "with the person's weight on a scale."
)
"""Legend of the table of masses."""
_UNDETERMINED = "not determined"
"""Content of the cell of a girth that is not determined."""
_MOST_DIGITS = 4
"""Number of digits behind the point at most; chosen by hand."""
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
    sizes = [_cells(_CM * length, _CM * length_sd, 1), *_girths(measures),
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
    head, columns = ["segment", "length cm", *girths, "volume l"], [names, *sizes]
    if any(equal):
        head, columns = [*head, "equal by the model to"], [*columns, equal]
    whole = "all segments"
    volume = _cell(1e3 * measures.whole_volume, 1e3 * measures.whole_volume_sd, 2)
    mass = _cell(measures.whole_mass, measures.whole_mass_sd, 2)
    return [
        NumberTable(
            title="Segments", head=head, text_columns=(0, 6), legend=_sizes_legend(measures, length),
            rows=[*map(list, zip(*columns, strict=True)), [whole, "", "", "", "", volume, *[""] * (len(head) - 6)]],
        ),
        NumberTable(
            title="Masses of the segments", head=("segment", "mass kg", *centres, *inertia), legend=_MASSES,
            rows=[*map(list, zip(names, *masses, strict=True)), [whole, mass, *[""] * (len(centres) + len(inertia))]],
        ),
    ]  # fmt: skip


def _sizes_legend(measures: SegmentMeasures, length: Floats) -> str:
    """Return the legend of the table of sizes, with what concerns these segments only."""
    pairs = [
        (k, measures.names.index(name.replace("left_", "right_", 1)))
        for k, name in enumerate(measures.names)
        if name.startswith("left_") and name.replace("left_", "right_", 1) in measures.names
    ]
    same = bool(pairs) and all(np.isclose(length[a], length[b], rtol=1e-9) for a, b in pairs)
    lost = _LOST_GIRTHS.format(most=100 * MOST_GIRTH_SD) if measures.undetermined_girths.any() else ""
    return _SIZES.format(equal=_EQUAL_LENGTHS if same else "", lost=lost)


def _girths(measures: SegmentMeasures) -> list[Sequence[str]]:
    """Return the columns of the girths."""
    columns: list[Sequence[str]] = []
    for i, lost in enumerate(measures.undetermined_girths.T):
        cells = _cells(_CM * measures.girth[:, i], _CM * measures.girth_sd[:, i], 1)
        columns.append([_UNDETERMINED if gone else cell for cell, gone in zip(cells, lost, strict=True)])
    return columns


def _cells(values: Floats, sds: Floats, digits: int) -> Sequence[str]:
    """Return values with their 95 % intervals as texts; see `_cell`."""
    return [_cell(float(value), float(sd), digits) for value, sd in zip(values, sds, strict=True)]


def _cell(value: float, sd: float, digits: int) -> str:
    """Return a value with its 95 % interval as a text; an unknown value is empty, an unknown interval is named.

    Args:
        value: The value.
        sd: Its standard deviation.
        digits: Number of digits behind the point; more for an interval that would be zero with so many.
    """
    if not np.isfinite(value):
        return ""
    half = 1.96 * sd
    if half > 0:
        digits = int(np.clip(np.ceil(-np.log10(2 * half)), digits, max(digits, _MOST_DIGITS)))
    shown = np.round(value, digits) + 0.0  # Without the sign of a zero.
    return f"{shown:.{digits}f} ± {f'{half:.{digits}f}' if np.isfinite(sd) else 'unknown'}".replace("-", "−")
