"""Foot strikes and foot offs of a walk from the motion of heels and toes, each with its standard deviation."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from marey.motion.events.cycles import OFF, STRIKE, GaitEvent
from marey.motion.events.feet import FineFoot, WalkPaths, fine_feet
from marey.motion.events.methods import OFF_METHODS, STRIKE_METHODS, Placement, Swing, find_extremes, landing_point


@dataclass(frozen=True, kw_only=True)
class PlacedBy:
    """A method with what it is off on average, and how much its corrected times err."""

    method: Placement
    """Places the event."""
    late_s: float
    """Mean of its time minus the true one over the walks of the benchmark, which is subtracted [s]."""
    sd_s: float
    """Root mean square error of the corrected time, with the correction of the other walks [s]."""


STRIKES = (
    PlacedBy(method=STRIKE_METHODS["hreljac"], late_s=0.003, sd_s=0.008),
    PlacedBy(method=STRIKE_METHODS["lowest heel"], late_s=0.005, sd_s=0.014),
)
"""Methods for strikes, the best first. Corrections and errors: docs/accuracy/markers.md ("markers/gait_events"); each
of the three walks with force plates or true feet has the same weight."""
OFFS = (
    PlacedBy(method=OFF_METHODS["onset"], late_s=-0.045, sd_s=0.008),
    PlacedBy(method=OFF_METHODS["ghoussayni"], late_s=-0.015, sd_s=0.021),
)
"""Methods for offs, the best first; measured in the same way."""
_FARTHEST_S = 0.035
"""Largest difference between the two methods of an event [s]; beyond it the second one counts, because the acceleration
of smoothed or noisy paths has maxima elsewhere in the swing. The largest one in the three walks is 0.025 s."""
_DISAGREEMENT_SHARE = 0.25
"""Share of the difference between the two methods that adds to the standard deviation. Chosen so that 95 % of the
errors of the benchmark lie within 1.96 standard deviations while those of agreeing methods keep the standard deviation
of the better one."""
_SECONDS_PER_METRE = 6.0
"""Standard deviation of an event by that of the noise of the points along one axis [s/m]: white noise of 1 to 6 mm that
was added to the three walks at 30 to 120 Hz scatters strikes by 3 to 12 ms/mm and offs by 2 to 7 ms/mm."""
_ALONE_S = 0.02
"""Standard deviation that is added where one method finds an event and the other does not [s]: that of the difference
between the two."""


@dataclass(frozen=True, kw_only=True)
class EventSettings:
    """Settings of the detection of strikes and offs from heels and toes."""

    cutoff_hz: float = 20.0
    """Cut-off of the low-pass filter for heel and toe [Hz]: the impact of the heel lasts about 30 ms."""
    shortest_step_s: float = 0.25
    """Shortest time between two events of the same kind of one foot [s]; in fast running it is 0.5 s."""


EVENT_DEFAULTS = EventSettings()
"""Default settings of the detection of events."""


def find_events(
    paths: WalkPaths, *, settings: EventSettings = EVENT_DEFAULTS, source: str = "markers"
) -> tuple[GaitEvent, ...]:
    """Find the strikes and offs of all feet, over ground or on a treadmill, also in turns.

    The strike is the impact of the heel, where its upward acceleration is largest ([Hreljac2000]), or of the toe where
    that lands first; the off is the onset of the toe's motion ([Ghoussayni2004] with two thresholds). A second method
    for each confirms the time; its difference enters the standard deviation. Both are corrected by what they are off on
    average.

    Args:
        paths: The feet and the body. Feet without a toe have no offs.
        settings: Filter and shortest step.
        source: What the paths come from, for the events.

    Returns:
        The events in chronological order; none of feet that do not swing, and none that lie outside the paths.
    """
    found: list[GaitEvent] = []
    for foot in fine_feet(paths, cutoff_hz=settings.cutoff_hz):
        extremes = find_extremes(foot)
        kinds = [(STRIKE, extremes.strikes, STRIKES)]
        kinds += [] if foot.toe is None else [(OFF, extremes.offs, OFFS)]
        for kind, swings, methods in kinds:
            last = -np.inf
            for swing in swings:
                lands = landing_point(foot, swing) if kind == STRIKE else foot
                placed = _place(lands, swing, methods, 1 / paths.rate)
                if placed is None or placed[0] - last < settings.shortest_step_s:
                    continue
                last, sd = placed
                if foot.time[0] <= last <= foot.time[-1]:
                    found.append(GaitEvent(kind=kind, side=foot.side, time=last, source=source, sd_s=sd))
    return tuple(sorted(found, key=lambda event: event.time))


def _place(
    foot: FineFoot, swing: Swing, methods: Sequence[PlacedBy], frame_s: float
) -> tuple[float, float] | None:  # fmt: skip
    """Place one event: its time and standard deviation [s]; None if no method finds it."""
    first, second = methods
    one, other = (each.method(foot, swing) - each.late_s for each in methods)
    apart = one - other
    sampling = float(np.hypot(frame_s / np.sqrt(12), _SECONDS_PER_METRE * foot.noise_m))
    if abs(apart) <= _FARTHEST_S:
        return float(one), float(np.sqrt(first.sd_s**2 + sampling**2 + (_DISAGREEMENT_SHARE * apart) ** 2))
    if np.isfinite(other):
        spread = _DISAGREEMENT_SHARE * apart if np.isfinite(apart) else _ALONE_S
        return float(other), float(np.sqrt(second.sd_s**2 + sampling**2 + spread**2))
    if np.isfinite(one):
        return float(one), float(np.sqrt(first.sd_s**2 + sampling**2 + _ALONE_S**2))
    return None
