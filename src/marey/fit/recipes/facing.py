"""Whether a person faces one way or the other, decided by the motion where the silhouettes of one frame do not."""

from collections.abc import Sequence
from functools import partial

import numpy as np

from marey.body.articulation.surface import Body
from marey.body.metaballs.metaball_person import reshaped
from marey.fit.recipes.track import TrackSettings, track
from marey.fit.search.levels import FrameLevels
from marey.fit.search.search import Candidate
from marey.fit.solver.processes import map_in_processes

AMBIGUOUS_BELOW = 0.05
"""Difference of the scores of two starts that face opposite ways below which one frame does not decide between them.
On `arm3`, seen by three cameras from the front, and on its mirror image it is 0.002 and 0.001; on `balancing`, 0.069,
and on `walk`, `reach`, `stealth` and `jacks` 0.10 to 0.22 (the scripts were not kept)."""
FOLLOWED_S = 2.0
"""Time before and after the start for which both are followed [s]. Chosen by hand. Every frame is used: with 15 instead
of 25 frames per second, the right one of both starts of `arm3` is lost in a fast motion, and has the lower score."""


def is_ambiguous(best: Candidate, other: Candidate) -> bool:
    """Return whether a start does not agree clearly better with the silhouettes of its frame than another one.

    Args:
        best: The start.
        other: The best start that faces the other way.
    """
    return best.score - other.score < AMBIGUOUS_BELOW


def facing_as(person: Candidate, starts: Sequence[Candidate]) -> Candidate:
    """Return the start whose direction is nearest to that of another body.

    Args:
        person: The other body.
        starts: Starts that face different ways.
    """
    rotation = person.posed.pose.rotation
    return max(starts, key=lambda start: float(np.trace(rotation.T @ start.posed.pose.rotation)))


def better_followed(
    starts: Sequence[Candidate], frame: int, frames: Sequence[int], levels: FrameLevels, rough: FrameLevels,
    coarse: Body, *, rate: float, settings: TrackSettings,
) -> Candidate:  # fmt: skip
    """Follow the person from several starts of a frame; return the one whose track agrees best with the silhouettes.

    Elbows and knees bend to one side only, so that a motion that is seen from the front differs from one from behind
    although its silhouettes in single frames do not.

    Args:
        starts: The starts; with equal agreement the first of them is returned.
        frame: Frame of the starts.
        frames: Frames in which the person was detected, in order.
        levels: Silhouettes for the fit.
        rough: Smaller silhouettes for the search of lost limbs.
        coarse: The body with few vertices.
        rate: Frame rate [Hz].
        settings: Settings of the tracking.
    """
    reach = FOLLOWED_S * rate
    ahead = [f for f in frames if 0 <= f - frame <= reach]
    behind = [f for f in reversed(frames) if 0 < frame - f <= reach]
    follow = partial(
        _followed_score, ahead=ahead, behind=behind, levels=levels, rough=rough, coarse=coarse, rate=rate,
        settings=settings,
    )  # fmt: skip
    scores = map_in_processes(follow, starts)
    return max(zip(scores, starts, strict=True), key=lambda scored: scored[0])[1]


def _followed_score(
    start: Candidate, ahead: Sequence[int], behind: Sequence[int], levels: FrameLevels, rough: FrameLevels,
    coarse: Body, rate: float, settings: TrackSettings,
) -> float:  # fmt: skip
    """Return the mean score of a person who is followed from a start, zero where the track has ended."""
    body, scores = start.posed.body, list[float]()
    few = reshaped(coarse, body.numbers)
    for frames in (ahead, behind):
        found = track(body, start.posed.pose, frames, levels, rough, rate=rate, coarse=few, settings=settings)
        scores += [found[f].score if f in found else 0.0 for f in frames]
    return sum(scores) / len(scores)
