"""Groups of curves of the page of `marey view`: angles, joint centres, agreement and forces of one or two results."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from marey.arrays import Floats, Mask
from marey.geometry.continuity import continuous_angles
from marey.motion.events.cycles import OFF
from marey.motion.recording import interpolated
from marey.view.pages.capture_report import angle_plots
from marey.view.pages.curves import COLOURS, CurvePlot, PlotGroup, PlotMark, Trace
from marey.view.pages.problems import readable
from marey.view.pictures.palette import LEFT, MIDDLE, RIGHT, side_colour
from marey.view.viewer.viewed import PlateForce, ViewedBody, ViewedResult

_SECOND = {LEFT: "#43a3b5", RIGHT: "#d08a2c", MIDDLE: "#6f7a3c"}
"""Colours of the curves of the second result by those of the first, as #rrggbb. Chosen by eye."""
_MOST_MARKS = 24
"""Number of events that are marked in the plots at most; more of them would hide the curves. Chosen by hand."""
_LEAST_M, _LEAST_N = 0.05, 50.0
"""Smallest ranges of the vertical axes of joint centres [m] and forces [N], so that noise is not magnified."""


def plot_groups(results: Sequence[ViewedResult]) -> list[PlotGroup]:
    """Return the groups of plots over the time of the first result, those without values left out.

    Args:
        results: One or two results.
    """
    marks = _marks(results[0])
    groups = _angle_groups(results) | {
        "joint centres": _joints(results), "agreement": _agreement(results[0]), "forces": _forces(results[0].forces),
    }  # fmt: skip
    made = [
        PlotGroup(title=title, plots=[replace(plot, marks=marks) for plot in plots]) for title, plots in groups.items()
    ]
    return [group for group in made if group.plots]


def event_colour(side: str | None) -> str:
    """Return the colour of an event of a foot, as #rrggbb."""
    return {"left": LEFT, "right": RIGHT}.get(side or "", MIDDLE)


def side_colours() -> list[list[tuple[str, str]]]:
    """Return the names and colours of the sides in the curves of the first and of the second result."""
    first = [("left", LEFT), ("right", RIGHT), ("trunk and head", MIDDLE)]
    return [first, [(side, _SECOND[colour]) for side, colour in first]]


def _marks(result: ViewedResult) -> list[PlotMark]:
    if len(result.events) > _MOST_MARKS:
        return []
    return [PlotMark(at=e.time, colour=event_colour(e.side) + "a0", dotted=e.kind == OFF) for e in result.events]


def _angle_groups(results: Sequence[ViewedResult]) -> dict[str, list[CurvePlot]]:
    """Return the plots of angles by group; angles that both results have share a plot."""
    time = results[0].time
    names = list(dict.fromkeys(name for result in results for name in result.angle_names))
    held = [_angles_at(result, names, time) for result in results]
    known = np.any([np.isfinite(angles.values).any(0) for angles in held], axis=0)
    groups: dict[str, list[CurvePlot]] = {}
    for plot in angle_plots(names, known):
        traces = [
            trace
            for n, angles in enumerate(held)
            for trace in _angle_traces(plot["curves"], angles, results[n].name if len(results) > 1 else "", n)
        ]
        groups.setdefault(plot["group"], []).append(CurvePlot(title=plot["title"], curves=traces, least=14.0))
    return groups


class _Angles(NamedTuple):
    """Angles by name (N, A) at common times, NaN where there are none."""

    values: Floats
    """[degrees]."""
    sd: Floats
    """Standard deviations [degrees]."""
    determined: Mask | None
    """Where the images determine an angle; None where that is not known."""


def _angle_traces(curves: Any, angles: _Angles, owner: str, number: int) -> list[Trace]:
    made = []
    for curve in curves:
        column, colour = curve["index"], curve["colour"]
        label = f"{curve['label']}, {owner}" if owner else curve["label"]
        if np.isfinite(angles.values[:, column]).any():
            made.append(
                Trace(
                    label=label, values=angles.values[:, column], sd=angles.sd[:, column],
                    colour=_SECOND.get(colour, colour) if number else colour,
                    determined=None if angles.determined is None else angles.determined[:, column],
                )
            )  # fmt: skip
    return made


def _angles_at(result: ViewedResult, names: Sequence[str], time: Floats) -> _Angles:
    """Return the angles of a result by name at times (N,) [s]."""
    values, sd = np.full((len(time), len(names)), np.nan), np.full((len(time), len(names)), np.nan)
    columns = [names.index(name) for name in result.angle_names]
    own, own_sd = continuous_angles(result.angles_deg, period=360.0, centred=True), result.angles_deg_sd
    if result.time is not time:
        own = interpolated(result.time, own, time)
        own_sd = interpolated(result.time, own_sd, time, cubic=False)
    values[:, columns], sd[:, columns] = own, own_sd
    if result.angles_determined is None:
        return _Angles(values, sd, None)
    determined = np.zeros(values.shape, bool)
    rows = result.rows_at(time)
    determined[:, columns] = result.angles_determined[rows] & (rows >= 0)[:, None]
    return _Angles(values, sd, determined)


def _joints(results: Sequence[ViewedResult]) -> list[CurvePlot]:
    """Return three plots per joint of captured motions: x, y and z over time."""
    bodies = [(result, result.shown.motion) for result in results if isinstance(result.shown, ViewedBody)]
    if len(bodies) < len(results):
        bodies = bodies[:1] if isinstance(results[0].shown, ViewedBody) else []
    plots, time = [], results[0].time
    for name in bodies[0][1].joint_names if bodies else ():
        for axis, letter in enumerate("XYZ"):
            traces = []
            for n, (result, motion) in enumerate(bodies):
                if name in motion.joint_names:
                    j = motion.joint_names.index(name)
                    values, sd = motion.joint_centres[:, j, axis], motion.joint_centres_sd[:, j, axis]
                    if n:
                        values, sd = (interpolated(result.time, each[:, None], time)[:, 0] for each in (values, sd))
                    colour = _SECOND[side_colour(name)] if n else side_colour(name)
                    label = f"{letter}, {result.name}" if len(bodies) > 1 else letter
                    traces.append(Trace(label=label, values=values, sd=sd, colour=colour))
            title = f"{readable(name)} {letter}"
            plots.append(CurvePlot(title=title, curves=traces, unit=" m", least=_LEAST_M, digits=3))
    return plots


def _agreement(result: ViewedResult) -> list[CurvePlot]:
    if not isinstance(result.shown, ViewedBody):
        return []
    motion = result.shown.motion
    return [
        CurvePlot(
            title=name, unit="", least=0.1, digits=2,
            curves=[Trace(label=name, values=motion.agreement[:, c], colour=COLOURS[c % len(COLOURS)])],
        )
        for c, name in enumerate(motion.camera_names)
    ]  # fmt: skip


def _forces(forces: Sequence[PlateForce]) -> list[CurvePlot]:
    return [
        CurvePlot(
            title=readable(force.name), unit=" N", least=_LEAST_N, digits=0,
            curves=[Trace(label="perpendicular force", values=force.vertical, colour=COLOURS[n % len(COLOURS)])],
        )
        for n, force in enumerate(forces)
    ]  # fmt: skip
