"""Plots of curves over time with Matplotlib, which is an optional package."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from marey.arrays import Floats, Image
from marey.extras import import_optional

BAND_OPACITY = 0.2
"""Opacity of the band of an interval, from 0 to 1. Chosen by eye, so that three overlapping bands stay readable."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Line:
    """One line of a plot."""

    label: str
    """Name of the line in the legend."""
    time: Floats
    """(F,) [s]."""
    values: Floats
    """(F,) in the unit of the plot; NaN leaves a gap."""
    low: Floats | None = None
    """(F,) lower limit of the band; None draws no band."""
    high: Floats | None = None
    """(F,) upper limit of the band."""


def new_axes(*, projection: str | None = None) -> Any:
    """Return Matplotlib's axes in a new figure.

    Args:
        projection: `3d` for axes in three dimensions.

    Raises:
        MissingPackage: Matplotlib is not installed.
    """
    pyplot: Any = import_optional("matplotlib.pyplot", extra="plot", purpose="Plots")
    return pyplot.subplots(layout="constrained", subplot_kw={"projection": projection})[1]


def draw_lines(lines: Sequence[Line], *, unit: str = "", axes: Any = None) -> Any:
    """Draw lines over time, each with its band.

    Args:
        lines: The lines to be drawn.
        unit: Unit of the values, for the axis.
        axes: Matplotlib's axes to draw on; new ones by default.

    Returns:
        The axes.

    Raises:
        MissingPackage: Matplotlib is not installed.
    """
    if axes is None:
        axes = new_axes()
    for line in lines:
        (drawn,) = axes.plot(line.time, line.values, label=line.label)
        if line.low is not None and line.high is not None:
            shown = np.isfinite(line.low) & np.isfinite(line.high)
            axes.fill_between(
                line.time, line.low, line.high, where=shown, color=drawn.get_color(), alpha=BAND_OPACITY, linewidth=0
            )
    axes.set_xlabel("time (s)")
    single = lines[0].label if len(lines) == 1 else ""
    axes.set_ylabel(f"{single} ({unit})" if single and unit else single or unit)
    if len(lines) > 1:
        axes.legend()
    return axes


def draw_points(points: Floats, *, colour: Image | None = None, axes: Any = None) -> Any:
    """Draw points in space.

    Args:
        points: (N, 3) [m].
        colour: (N, 3) red, green and blue from 0 to 255; one colour for all by default.
        axes: Matplotlib's axes in three dimensions to draw on; new ones by default.

    Returns:
        The axes.

    Raises:
        MissingPackage: Matplotlib is not installed.
    """
    if axes is None:
        axes = new_axes(projection="3d")
    known = np.isfinite(points).all(axis=1)
    shades = None if colour is None else colour[known] / 255.0
    axes.scatter(*np.asarray(points)[known].T, c=shades, s=1.0)
    axes.set_aspect("equal")
    for name in "xyz":
        getattr(axes, f"set_{name}label")(f"{name} (m)")
    return axes
