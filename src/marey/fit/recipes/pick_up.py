"""Recovery of a lost track by new starts in the frames without a pose."""

from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Mask
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.surface import Body
from marey.cameras.camera import Camera
from marey.fit.search.levels import FrameLevels
from marey.fit.search.search import Candidate, Search, StartSettings
from marey.fit.search.start import find_start

Follow = Callable[[int, Pose, Sequence[int]], Mapping[int, Candidate]]
"""Tracks the person from a start (frame and pose) through frames; returns those in which the person was found."""


@dataclass(frozen=True, kw_only=True)
class PickUpSettings:
    """Settings of the new starts after a lost track. Chosen by hand; other values were not measured."""

    every: float = 0.5
    """Time between frames in which a start is tried [s]."""
    most: int = 6
    """Number of failed starts after which a stretch is abandoned."""
    shortest: float = 0.1
    """Shorter gaps between tracked frames are left to interpolation [s]."""
    worse: float = 0.1
    """Largest amount by which the score of an accepted new start may lie below the usual score."""
    shown: float = 0.5
    """Least visible size of the person in a frame that is tried, as a share of the usual size."""
    weak: float = 0.08
    """Amount by which the score of a stretch lies below the usual score if it is tracked again."""


def runs_between(frames: Sequence[int], found: Container[int], *, hole: float = 1.0) -> list[list[int]]:
    """List the stretches of frames without a pose.

    Args:
        frames: Frames in which a person was detected, in order.
        found: Frames that have a pose.
        hole: Largest difference between successive frame numbers of one stretch.
    """
    runs: list[list[int]] = []
    last = None
    for frame in frames:
        if frame in found:
            last = None
            continue
        if last is not None and frame - last <= hole:
            runs[-1].append(frame)
        else:
            runs.append([frame])
        last = frame
    return runs


def weak_frames(found: Mapping[int, Candidate], *, rate: float, settings: PickUpSettings) -> set[int]:
    """Return the frames of stretches that score much worse than usual, for longer than a repair can bridge."""
    usual = float(np.median([c.score for c in found.values()])) if found else 0.0
    good = [frame for frame, c in found.items() if c.score >= usual - settings.weak]
    runs = runs_between(sorted(found), set(good))
    return {frame for run in runs if len(run) > max(1.0, settings.shortest * rate) for frame in run}


def best_per_frame(
    old: Mapping[int, Candidate], new: Mapping[int, Candidate], *, gain: float = 0.01
) -> dict[int, Candidate]:
    """Keep for each frame the old candidate, or the new one if its score is higher by `gain` or it is the only one."""
    both = dict(new) | {f: c for f, c in old.items() if f not in new or new[f].score < c.score + gain}
    return dict(sorted(both.items()))


def pick_up(
    found: Mapping[int, Candidate],
    frames: Sequence[int],
    merit: Callable[[int], float],
    start: Callable[[int], Candidate | None],
    follow: Follow,
    *,
    rate: float,
    settings: PickUpSettings | None = None,
) -> dict[int, Candidate]:
    """Search for new starts in the stretches without a pose, and track the person from there in both directions.

    Args:
        found: Known candidates by frame.
        frames: Frames in which a person was detected, in order.
        merit: Rates how well a frame shows the person; the best frame of a stretch is tried first.
        start: Searches for a start in a frame.
        follow: Tracks the person from a start.
        rate: Frame rate [Hz].
        settings: Settings of the new starts.

    Returns:
        The known and the new candidates by frame.
    """
    settings = settings or PickUpSettings()
    known = dict(found)
    tried: dict[int, bool] = {}
    usual = float(np.median([c.score for c in known.values()])) if known else 1.0
    sample = list(known)[:: max(1, len(known) // 40)]
    least = settings.shown * float(np.median([merit(frame) for frame in sample])) if known else 0.0
    while (frame := _next_try(frames, known, merit, least, tried, rate, settings)) is not None:
        begun = start(frame)
        tried[frame] = begun is not None and begun.score >= usual - settings.worse
        if begun is None or not tried[frame]:
            continue
        run = next(run for run in _runs(frames, known, rate, settings) if frame in run)
        at = run.index(frame)
        for way in (run[at:], run[:at][::-1]):
            known |= follow(frame, begun.posed.pose, way)
    return dict(sorted(known.items()))


def _runs(
    frames: Sequence[int], known: Mapping[int, Candidate], rate: float, settings: PickUpSettings
) -> list[list[int]]:
    return runs_between(frames, known, hole=max(1.0, settings.every * rate))


def _next_try(
    frames: Sequence[int],
    known: Mapping[int, Candidate],
    merit: Callable[[int], float],
    least: float,
    tried: Mapping[int, bool],
    rate: float,
    settings: PickUpSettings,
) -> int | None:
    """Choose the frame in which a start is tried next: the best one that is not close to an earlier attempt."""
    apart = max(1.0, settings.every * rate)
    for run in _runs(frames, known, rate, settings):
        within = run[0] - 1 in known and run[-1] + 1 in known
        failed = [frame for frame in tried if run[0] <= frame <= run[-1]]
        if (within and len(run) < settings.shortest * rate) or len(failed) >= settings.most:
            continue
        free = [frame for frame in run if all(abs(frame - other) >= apart for other in tried)]
        best = max(free[:: max(1, round(apart / 2))], key=merit, default=None)
        if best is not None and merit(best) >= least:
            return best
    return None


def restart(
    cameras: Sequence[Camera], masks: Sequence[Mask], body: Body, coarse: Body, levels: FrameLevels, frame: int,
    settings: StartSettings,
) -> Candidate | None:  # fmt: skip
    """Search for the pose in a frame without a prediction, for a body whose shape is known."""
    found = find_start(cameras, masks, with_fixed_shape(coarse), with_fixed_shape(body), settings)
    if found is None:
        return None
    return Search(levels.at(frame), settings).judge(PosedBody(body, found.posed.pose))


def with_fixed_shape(body: Body) -> Body:
    """Return the same body without shape parameters, so that a search keeps its shape."""
    space = replace(body.space, prior_mean=body.numbers).keep(range(0))
    return replace(body, space=space, numbers=np.zeros(0), numbers_covariance=None)
