"""The gait of a trial or of a captured body."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from marey.body.articulation.surface import Body
from marey.errors import SettingProblem
from marey.geometry.rigid import RigidTransform
from marey.motion.events.body_feet import paths_of_body
from marey.motion.events.cycles import STRIKE, GaitCycle, GaitEvent, gait_cycles
from marey.motion.events.detection import find_events
from marey.motion.events.feet import WalkPaths
from marey.motion.events.parameters import QUANTITIES, GaitMeasures, measure_gait
from marey.motion.events.summaries import ASYMMETRY, GaitSummary, summarise_gait
from marey.motion.motion import BodyMotion
from marey.wording import count_of

_LEAST_STRIDE_M = 0.3
"""Shortest stride of a captured walk [m]. A person of the take `office` who shifts the weight in place makes strides of
0.10 m; those of slow walking reach 0.6 m."""
SOURCE = "body"
"""The source of events of a captured body."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Gait:
    """The events of a walk, the cycles between them, and their spatio-temporal parameters.

    Example:
        >>> import marey
        >>> gait = marey.load_motion("walk01/marey").gait
        >>> gait.parameter("stride length", "left").value
        1.24
    """

    events: tuple[GaitEvent, ...]
    """Foot strikes and foot offs in the order of time."""
    cycles: tuple[GaitCycle, ...]
    """From each strike of a foot to its next one."""
    notes: tuple[str, ...] = ()
    """Notes for the reader."""
    plates: Mapping[str, RigidTransform] = field(default_factory=dict)
    """Frames of the force plates, laboratory from plate [m]."""
    measures: GaitMeasures | None = None
    """Parameters of each cycle; None if heels are not known."""

    @cached_property
    def parameters(self) -> tuple[GaitSummary, ...]:
        """Mean, standard deviation and interval of each quantity for the left foot, the right foot, and both."""
        return () if self.measures is None else summarise_gait(self.measures)

    def parameter(self, name: str, side: str = "both") -> GaitSummary:
        """Return one quantity.

        Args:
            name: For example `stride length` or `stride_length_asymmetry`.
            side: `left`, `right` or `both`.

        Raises:
            SettingProblem: There is no such quantity, or it was not measured on that side.
        """
        wanted = name.strip().replace(" ", "_")
        for entry in self.parameters:
            if (entry.quantity, entry.side) == (wanted, side):
                return entry
        known = sorted({entry.quantity for entry in self.parameters})
        if wanted.removesuffix(ASYMMETRY) not in QUANTITIES:
            raise SettingProblem(f"There is no quantity {name!r}. There are: {', '.join(known) or 'none'}.")
        raise SettingProblem(f"{wanted} was not measured for {side}: no cycle has the events and points for it.")


def gait_from(paths: WalkPaths | None, events: tuple[GaitEvent, ...]) -> Gait:
    """Return the gait with these events, and with parameters if the paths of the feet are known."""
    measures = None if paths is None or not events else measure_gait(paths, events)
    return Gait(events=events, cycles=gait_cycles(events), measures=measures)


def gait_of_body(motion: BodyMotion, body: Body) -> Gait | None:
    """Return the gait of a captured body.

    Args:
        motion: The motion.
        body: The body at rest.

    Returns:
        None if the motion shows no complete gait cycle with a stride.
    """
    paths = paths_of_body(motion, body)
    if paths is None:
        return None
    gait = gait_from(paths, find_events(paths, source=SOURCE))
    if gait.measures is None:
        return None
    columns = [list(QUANTITIES).index(name) for name in ("stride_length", "stance_time")]
    lengths, stances = gait.measures.values[:, columns].T
    return gait if bool(np.any((lengths > _LEAST_STRIDE_M) & (stances > 0))) else None


def count_events(gait: Gait) -> str:
    """Return the numbers of events and cycles in words."""
    strikes = sum(event.kind == STRIKE for event in gait.events)
    offs = len(gait.events) - strikes
    counts = (strikes, "foot strike"), (offs, "foot off"), (len(gait.cycles), "complete cycle")
    return ", ".join(count_of(*each) for each in counts)
