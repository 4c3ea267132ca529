"""Picking up a person who was lost, or who left and came back: new starts in the frames without an answer."""

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
"""Follows the person from a start (its frame and pose) through frames; gives those in which the person was found."""


@dataclass(frozen=True, kw_only=True)
class PickUpSettings:
    """Where new starts are tried, and when they are believed."""

    every: float = 0.5
    """Time between the frames that are tried [s]."""
    most: int = 6
    """Failed starts after which a stretch without an answer is given up."""
    shortest: float = 0.1
    """A shorter stretch within a motion that was followed is left to its neighbours [s]."""
    worse: float = 0.1
    """How much worse than usual a new start may explain the silhouettes."""
    shown: float = 0.5
    """Share of what is usually shown of the person that a frame must show; a foot at the border is not enough."""
    weak: float = 0.08
    """How much worse than usual a stretch is followed that is tried anew."""


def runs_between(frames: Sequence[int], found: Container[int], *, hole: float = 1.0) -> list[list[int]]:
    """List the stretches of frames without an answer.

    Args:
        frames: those that show somebody, in order.
        found: those that have an answer.
        hole: how many frame numbers a stretch may leave out.
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
    """List frames in stretches that were followed much worse than usual, for longer than a mending reaches."""
    usual = float(np.median([c.score for c in found.values()])) if found else 0.0
    good = [frame for frame, c in found.items() if c.score >= usual - settings.weak]
    runs = runs_between(sorted(found), set(good))
    return {frame for run in runs if len(run) > max(1.0, settings.shortest * rate) for frame in run}


def better_of(
    old: Mapping[int, Candidate], new: Mapping[int, Candidate], *, gain: float = 0.01
) -> dict[int, Candidate]:
    """Take for each frame the old answer, or the new one where that is better by a gain or the only one."""
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
    """Start anew in stretches of frames without an answer, and follow the person from there both ways.

    Args:
        found: what is known already.
        frames: those that show somebody, in order.
        merit: how well a frame shows the person; the best of a stretch is tried first.
        start: tries a start in a frame.
        follow: follows from a start.
        rate: frames in a second.
        settings: where starts are tried, and when they are believed.

    Returns:
        What was known and what was picked up.
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
    """Choose the frame in which a start is tried next: the best that lies apart from those that were tried."""
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


def start_again(
    cameras: Sequence[Camera], masks: Sequence[Mask], body: Body, coarse: Body, levels: FrameLevels, frame: int,
    settings: StartSettings,
) -> Candidate | None:  # fmt: skip
    """Find the pose in a frame from scratch for a body whose shape is known."""
    found = find_start(cameras, masks, of_one_shape(coarse), of_one_shape(body), settings)
    if found is None:
        return None
    return Search(levels.at(frame), settings).judge(PosedBody(body, found.posed.pose))


def of_one_shape(body: Body) -> Body:
    """Give the same body without shape numbers, as a scan has none: a search then leaves its shape alone."""
    space = replace(body.space, prior_mean=body.numbers).keep(range(0))
    return replace(body, space=space, numbers=np.zeros(0), numbers_covariance=None)
