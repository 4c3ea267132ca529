"""Repetitions of a person who stays in place: squats, sitting down and standing up, and jumps."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np
from scipy.constants import g as gravity
from scipy.interpolate import CubicSpline

from marey.arrays import Floats, Mask, freeze_fields, true_runs
from marey.motion.events.curves import without_side
from marey.motion.events.feet import WalkPaths, noise_of_path, smooth_path
from marey.motion.events.methods import reversals

RepetitionKind = Literal["squat", "lowering", "rising", "jump"]
"""The kinds of repetitions."""
_FINE_HZ = 240.0
"""Smallest rate at which instants are searched [Hz], as for gait events."""
_SHORTEST_S = 0.3
"""Shortest section without gaps that is searched [s]; a quick jump takes longer."""
_FLOOR_SHARE = 0.1
"""Quantile of the heights of a foot that is taken as the floor beneath it: robust to the noise of the lowest frames."""
_CLEAR_M = 0.025
"""Height of heel and toe above the floor from which on a foot is in the air [m]. In captured jumping jacks the lower of
heel and toe of a standing foot varies by up to 0.03 m, and reaches 0.08 to 0.13 m in the air. A flight requires in
addition that both feet are in the air and that the body falls. The instants are extrapolated to the floor from here."""
_LONGEST_EXTRAPOLATION_S = 0.08
"""Longest time by which an instant is extrapolated [s]: 0.025 m at 0.3 m/s."""
_FREE_FALL = 0.5
"""Mean downward acceleration of the body in the air, relative to that of gravity, from which on both feet in the air
are a flight; chosen by hand between that of the pelvis in six captured jumping jacks (1.00 to 1.06; the script was not
kept) and that of a person who hangs or is carried (0)."""
_SHORTEST_FLIGHT_S = 0.05
"""Shortest flight [s]: a jump of 3 mm."""
_FLEXIONS = ("hip_flexion", "knee_flexion", "knee_angle", "ankle_dorsiflexion", "ankle_angle")
"""Angles whose largest values describe a repetition, by their names without side: ours and those of OpenSim's
models."""


@dataclass(frozen=True, kw_only=True)
class RepetitionSettings:
    """Settings of the search for repetitions."""

    cutoff_hz: float = 6.0
    """Cut-off of the low-pass filter for the height of the body [Hz], as for walking ([Winter2009])."""
    least_depth_m: float = 0.05
    """Smallest change of the height of the body [m]; in walking it is 0.03 to 0.05 m, in breathing and swaying 0.01."""
    edge_share: float = 0.05
    """Share of the depth by which the body has moved at the start of a repetition, and is still to move at its end."""
    bottom_share: float = 0.15
    """Share of the depth above the lowest place within which the body is at the bottom."""
    held_share: float = 0.4
    """Share of the time of a repetition at the bottom from which on it is held there, as on a seat: a sine is there for
    0.25 of the time."""
    held_s: float = 0.5
    """Shortest time at the bottom that is held [s]."""
    largest_step_m: float = 0.15
    """Largest horizontal distance of a heel, at the start or the end of a repetition in place, from its place at the
    lowest instant [m]: about half of a foot."""


REPETITION_DEFAULTS = RepetitionSettings()
"""Default settings of the search for repetitions."""


@dataclass(frozen=True, kw_only=True)
class Flight:
    """The time in which both feet are in the air."""

    takeoff_s: float
    """Instant at which the last foot leaves the floor [s]."""
    landing_s: float
    """Instant at which the first foot reaches it [s]."""
    sd_s: float
    """Standard deviation of either instant [s]."""

    @property
    def duration_s(self) -> float:
        """Time in the air [s]."""
        return self.landing_s - self.takeoff_s

    @property
    def height_m(self) -> float:
        """Rise of the centre of mass from take-off to the apex that follows from the time in the air [m].

        It assumes that the body lands in the posture of the take-off; bent knees at landing make it too large.
        """
        return float(gravity * self.duration_s**2 / 8)

    @property
    def height_sd_m(self) -> float:
        """Standard deviation of the height that follows from that of the instants [m]."""
        return float(gravity * self.duration_s / 4 * math.sqrt(2) * self.sd_s)


@dataclass(frozen=True, kw_only=True)
class Repetition:
    """One repetition."""

    kind: RepetitionKind
    """`squat`: down and up again; `lowering`, `rising`: to a lowest place that is held, such as a seat, and from it;
    `jump`: from the start of the countermovement to the landing."""
    start_s: float
    """Instant at which the body starts to move; of a jump that follows a jump, its landing [s]."""
    lowest_s: float
    """Instant of the lowest place [s]."""
    end_s: float
    """Instant at which the body is at rest again; of a jump, its landing [s]."""
    depth_m: float
    """Height between the start, or of `rising` the end, and the lowest place [m]."""
    depth_sd_m: float
    """Standard deviation of the depth from the noise of the body's path [m]."""
    flight: Flight | None = None
    """The flight of a jump."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Repetitions:
    """All repetitions of a motion, with the largest flexion of the joints of the legs in each.

    Example:
        >>> import marey
        >>> repetitions = marey.load_motion("walk01").repetitions
        >>> len(repetitions), [each.kind for each in repetitions]
        (0, [])
    """

    entries: tuple[Repetition, ...] = ()
    """N repetitions in the order of time."""
    angle_names: tuple[str, ...] = ()
    """K angles of hips, knees and ankles."""
    largest_deg: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    """(N, K) largest value of each angle between start and end [degrees]; NaN where it is unknown."""

    def __post_init__(self) -> None:
        freeze_fields(self, "largest_deg")

    def __len__(self) -> int:
        """Return the number of repetitions."""
        return len(self.entries)

    def __iter__(self) -> Iterator[Repetition]:
        """Return the repetitions one after the other."""
        return iter(self.entries)


def with_largest_angles(
    entries: Sequence[Repetition], names: Sequence[str], values: Floats, time: Floats
) -> Repetitions:  # fmt: skip
    """Add the largest flexion of the joints of the legs in each repetition.

    Args:
        entries: N repetitions.
        names: Names of angles without units.
        values: (F, len(names)) angles [degrees]; NaN where unknown.
        time: (F,) [s].
    """
    columns = [k for k, name in enumerate(names) if without_side(name) in _FLEXIONS]
    largest = np.full((len(entries), len(columns)), np.nan)
    for n, each in enumerate(entries):
        part = values[(time >= each.start_s) & (time <= each.end_s)][:, columns]
        known = np.isfinite(part).any(0)
        largest[n, known] = np.nanmax(part[:, known], 0)
    return Repetitions(entries=tuple(entries), angle_names=tuple(names[k] for k in columns), largest_deg=largest)


class _Course(NamedTuple):
    """Body and feet over a section without gaps, at N instants of a fine time base."""

    time: Floats
    """(N,) [s]."""
    height: Floats
    """(N,) of the body [m]."""
    lifts: Floats
    """(K, N) height of the lower one of heel and toe of each foot above its floor [m]."""
    places: Floats
    """(K, N, 2) horizontal place of each heel [m]."""
    noise_m: float
    """Standard deviation of the noise of the body's height [m]."""
    lift_noise_m: Floats
    """(K,) standard deviation of the noise of each foot's height, the larger one of heel and toe [m]."""
    frame_s: float
    """Time between two frames [s]."""


def find_repetitions(paths: WalkPaths, *, settings: RepetitionSettings = REPETITION_DEFAULTS) -> tuple[Repetition, ...]:
    """Find squats, sitting down, standing up and jumps from the height of the body and the feet.

    A person who walks or runs has none of them: the caller leaves such motions out.

    Args:
        paths: Paths of both feet and of the body, Z up.
        settings: Settings of the search.

    Returns:
        The repetitions in the order of time.
    """
    found = [each for course in _courses(paths, settings) for each in _of_course(course, settings)]
    return tuple(sorted(found, key=lambda each: each.start_s))


def _courses(paths: WalkPaths, settings: RepetitionSettings) -> Iterator[_Course]:
    """Yield the sections in which the body and all feet are known."""
    toes = [foot.heel if foot.toe is None else foot.toe for foot in paths.feet]
    heels = [foot.heel for foot in paths.feet]
    known: Mask = np.asarray(np.isfinite(np.concatenate([paths.body, *heels, *toes], 1)).all(1))
    lowest = [np.minimum(heel[:, 2], toe[:, 2]) for heel, toe in zip(heels, toes, strict=True)]
    for start, end in true_runs(known):
        if end - start < max(4, _SHORTEST_S * paths.rate):
            continue
        frames, time = slice(start, end), paths.time[start:end]
        fine = np.linspace(time[0], time[-1], (len(time) - 1) * int(np.ceil(_FINE_HZ / paths.rate)) + 1)
        body = smooth_path(paths.body[frames], paths.rate, settings.cutoff_hz)
        above = [each[frames] - np.quantile(each[frames], _FLOOR_SHARE) for each in lowest]
        yield _Course(
            time=fine, height=CubicSpline(time, body[:, 2])(fine),
            lifts=np.stack([CubicSpline(time, each)(fine) for each in above]),
            places=np.stack([CubicSpline(time, heel[frames, :2])(fine) for heel in heels]),
            noise_m=noise_of_path(paths.body[frames]), frame_s=1 / paths.rate,
            lift_noise_m=np.array([
                max(noise_of_path(heel[frames]), noise_of_path(toe[frames]))
                for heel, toe in zip(heels, toes, strict=True)
            ]),
        )  # fmt: skip


def _of_course(course: _Course, settings: RepetitionSettings) -> Iterator[Repetition]:
    flights = list(_flights(course))
    extremes = reversals(course.height, settings.least_depth_m)
    for n, (low, is_top) in enumerate(extremes):
        if is_top:
            continue
        before = extremes[n - 1][0] if n else None
        after = extremes[n + 1][0] if n + 1 < len(extremes) else None
        since = course.time[low if before is None else before]
        until = course.time[low if after is None else after]
        rise = next((each for each in flights if course.time[low] < each.takeoff_s <= until), None)
        fall = next((each for each in flights if since <= each.landing_s < course.time[low]), None)
        if rise is not None:
            yield _jump(course, low, before, rise, fall, settings)
        elif fall is None:
            yield from _in_place(course, low, before, after, settings)


def _flights(course: _Course) -> Iterator[Flight]:
    """Yield the times in which both feet are in the air and the body falls freely."""
    step = course.time[1] - course.time[0]
    speeds = np.gradient(course.lifts, step, axis=1)
    fall = -np.gradient(np.gradient(course.height, step), step)
    for start, end in true_runs(np.asarray(course.lifts.min(0) > _CLEAR_M)):
        cut_off = start == 0 or end == len(course.time)
        if cut_off or fall[start:end].mean() < _FREE_FALL * gravity:
            continue
        takeoff, takeoff_noise_s = _crossing(course, speeds, start)
        landing, landing_noise_s = _crossing(course, speeds, end - 1)
        sd = float(np.hypot(course.frame_s / np.sqrt(12), max(takeoff_noise_s, landing_noise_s)))
        if landing - takeoff > _SHORTEST_FLIGHT_S:
            yield Flight(takeoff_s=takeoff, landing_s=landing, sd_s=sd)


def _crossing(course: _Course, speeds: Floats, k: int) -> tuple[float, float]:
    """Return when the lower foot is on the floor, extrapolated from an instant in the air, and the noise of this [s].

    The noise is that of the foot's height over its speed.
    """
    foot = int(np.argmin(course.lifts[:, k]))
    speed = speeds[foot, k]
    reach = _LONGEST_EXTRAPOLATION_S
    shift = course.lifts[foot, k] / speed if abs(speed) * reach > course.lifts[foot, k] else np.sign(speed) * reach
    slowest = _CLEAR_M / _LONGEST_EXTRAPOLATION_S
    return float(course.time[k] - shift), float(course.lift_noise_m[foot] / max(abs(speed), slowest))


def _jump(
    course: _Course, low: int, before: int | None, rise: Flight, fall: Flight | None, settings: RepetitionSettings
) -> Repetition:  # fmt: skip
    """Return a jump with its countermovement, which starts with the landing of a jump before it."""
    if fall is not None:
        start = int(np.searchsorted(course.time, fall.landing_s))
    else:
        start = low if before is None else _leaving(course.height, before, low, settings.edge_share)
    return Repetition(
        kind="jump", start_s=float(course.time[start]), lowest_s=float(course.time[low]), end_s=rise.landing_s,
        depth_m=float(course.height[start] - course.height[low]), depth_sd_m=float(np.sqrt(2) * course.noise_m),
        flight=rise,
    )  # fmt: skip


def _in_place(
    course: _Course, low: int, before: int | None, after: int | None, settings: RepetitionSettings
) -> Iterator[Repetition]:
    """Yield the squat, or the lowering and the rising, about a lowest place; none if a foot is elsewhere afterwards."""
    height, share = course.height, settings.edge_share
    last = len(height) - 1
    start = None if before is None else _leaving(height, before, low, share)
    end = None if after is None else last - _leaving(height[::-1], last - after, last - low, share)
    ends = [k for k in (start, low, end) if k is not None]
    moved = np.linalg.norm(course.places[:, ends] - course.places[:, [low]], axis=-1).max()
    if len(ends) < 2 or moved > settings.largest_step_m:
        return
    depth = min(height[k] for k in (before, after) if k is not None) - height[low]
    first, final = ends[0], ends[-1]
    at, away = _at_bottom(height, first, final, settings.bottom_share * depth)
    held_s = course.time[away] - course.time[at]
    held = held_s > max(settings.held_s, settings.held_share * (course.time[final] - course.time[first]))
    reached, left = _at_bottom(height, first, final, share * depth) if held else (low, low)
    if start is not None and end is not None and not held:
        yield _repetition(course, "squat", (start, low, end), height[start] - height[low])
        return
    if start is not None:
        yield _repetition(course, "lowering", (start, reached, reached), height[start] - height[low])
    if end is not None:
        yield _repetition(course, "rising", (left, left, end), height[end] - height[low])


def _at_bottom(height: Floats, first: int, last: int, within: float) -> tuple[int, int]:
    """Return the first and the last index at which the height is near the lowest one between two indices."""
    part = height[first : last + 1]
    near = np.flatnonzero(part <= part.min() + within) + first
    return int(near[0]), int(near[-1])


def _repetition(course: _Course, kind: RepetitionKind, instants: tuple[int, int, int], depth: float) -> Repetition:
    start_s, lowest_s, end_s = (float(course.time[k]) for k in instants)
    return Repetition(
        kind=kind, start_s=start_s, lowest_s=lowest_s, end_s=end_s, depth_m=float(depth),
        depth_sd_m=float(np.sqrt(2) * course.noise_m),
    )  # fmt: skip


def _leaving(height: Floats, top: int, low: int, share: float) -> int:
    """Return the last index between a top and the lowest place at which the height is nearly that of the top."""
    limit = height[top] - share * (height[top] - height[low])
    return top + int(np.flatnonzero(height[top : low + 1] >= limit)[-1])
