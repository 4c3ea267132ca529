"""The files of a gait, and its part of a page."""

from collections.abc import Sequence
from pathlib import Path

from marey.geometry.continuity import continuous_angles
from marey.io.results.gait import (
    write_cycle_csv,
    write_event_table,
    write_events,
    write_gait_csv,
    write_gait_cycles_csv,
)
from marey.motion.events.curves import CycleCurves, average_over_cycles, cycle_marks
from marey.motion.motion import BodyMotion
from marey.pipelines.gait.walk import Gait
from marey.view.gait.cycle_plots import cycle_plots, gait_table
from marey.view.pages.curves import NumberTable, PlotGroup

FILES = {
    "gait.csv, gait_cycles.csv": "spatio-temporal parameters: means with intervals, and each cycle",
    "cycles.csv, events.csv, events.mot": "angles over the gait cycle; foot strikes and foot offs",
    "repetitions.csv": "squats, sitting down and standing up, and jumps",
}
"""Files of a gait and what they contain, for a page."""


def write_gait(folder: Path, gait: Gait, curves: CycleCurves | None) -> None:
    """Write events and, if there are complete cycles, the parameters of the steps and the curves over the cycle.

    Args:
        folder: The folder.
        gait: The gait; one without events writes nothing.
        curves: Angles over the cycle, if there are any.
    """
    if gait.events:
        write_events(folder / "events.csv", gait.events)
        write_event_table(folder / "events.mot", gait.events)
    if gait.measures is not None and gait.parameters:
        write_gait_csv(folder / "gait.csv", gait.parameters)
        write_gait_cycles_csv(folder / "gait_cycles.csv", gait.measures)
    if curves is not None:
        write_cycle_csv(folder / "cycles.csv", curves.names, curves.mean, curves.spread)


def gait_tables(gait: Gait | None) -> list[NumberTable]:
    """Return the tables of a page."""
    return [gait_table(gait.parameters)] if gait is not None and gait.parameters else []


def cycle_group(gait: Gait, methods: Sequence[tuple[str, CycleCurves | None]]) -> list[PlotGroup]:
    """Return the plots over the cycle; none if the first method has no complete cycle."""
    if not methods or methods[0][1] is None:
        return []
    named = [(name, curves) for name, curves in methods if curves is not None]
    return [cycle_plots(named, cycle_marks(gait.cycles, gait.events))]


def body_curves(gait: Gait, motion: BodyMotion) -> CycleCurves | None:
    """Average the anatomical angles of a captured body over the gait cycles; None if no cycle is complete."""
    names = [f"{name}_deg" for name in motion.angle_names]
    return average_over_cycles(
        names, continuous_angles(motion.angles_deg, period=360.0, centred=True), motion.time, gait.cycles
    )
