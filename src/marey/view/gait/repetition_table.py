"""The table of squats, sitting down and standing up, and jumps, for a page."""

import math

from marey.motion.events.repetitions import Repetitions
from marey.view.pages.curves import NumberTable
from marey.view.pages.problems import readable

_LEGEND = (
    "Depth: change of the height of the pelvis. Angles: largest value between start and end [°]. A squat goes down and "
    "up again without a pause; lowering and rising lead to and from a lowest place that is held, such as a seat."
)
"""What the table shows."""
_JUMPS = " Jump height: from the time in the air, with one standard deviation; bent knees at landing make it too large."
"""What the columns of jumps show."""


def repetition_tables(repetitions: Repetitions) -> list[NumberTable]:
    """Return the table of the repetitions; none without any.

    Args:
        repetitions: The repetitions.
    """
    if not len(repetitions):
        return []
    jumps = any(each.flight is not None for each in repetitions)
    rows = []
    for number, (each, largest) in enumerate(zip(repetitions, repetitions.largest_deg, strict=True), 1):
        flight = each.flight
        air = "" if flight is None else f"{flight.duration_s:.3f}"
        height = "" if flight is None else f"{100 * flight.height_m:.1f} ± {100 * flight.height_sd_m:.1f}"
        rows.append(
            [str(number), each.kind, f"{each.start_s:.2f}", f"{each.end_s - each.start_s:.2f}",
             f"{each.lowest_s - each.start_s:.2f}", f"{100 * each.depth_m:.1f}", *((air, height) if jumps else ()),
             *(f"{value:.0f}" if math.isfinite(value) else "" for value in largest)]
        )  # fmt: skip
    head = ["", "kind", "start [s]", "duration [s]", "to the lowest place [s]", "depth [cm]"]
    head += ["in the air [s]", "jump height [cm]"] if jumps else []
    head += map(readable, repetitions.angle_names)
    legend = _LEGEND + (_JUMPS if jumps else "")
    return [NumberTable(title="Repetitions", head=head, rows=rows, legend=legend, text_columns=(0, 1))]
