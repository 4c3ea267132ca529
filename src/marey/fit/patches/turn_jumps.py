"""Jumps of a segment's turn between two answers to the same silhouettes, undone by tracks of the surface.

A head seen from the side and one turned by 70 degrees have similar outlines: the fit may find one in a part of a take
and the other one in the rest. Tracks of the surface show how far the head really turned from frame to frame, and the
silhouettes of the whole take then decide between the answers.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.surface import Body
from marey.fit.patches.surface_tracks import SurfaceTracks
from marey.fit.search.levels import FrameLevels, SilhouetteLevel
from marey.fit.solver.pose_solver import Schedule, fit_pose
from marey.fit.solver.threads import map_in_threads
from marey.observations.correspondence import view_of
from marey.observations.observation import Observation

TURNED_BY = {"head": ("neck_rotation", "head_rotation")}
"""Coordinates that turn a segment about its axis, where a jump between two answers is undone. Forearms jump too, but
their bare skin has no tracks that last: on `stealth` no other answer was better for them."""
LEVELS = (0.05, 0.25, 0.5, 0.75, 0.95)
"""Quantiles of a segment's turn from which the whole take is continued. Chosen by hand."""
COMPARED_FRAMES = 12
"""Number of frames in which several answers are compared. Chosen by hand."""
SCHEDULE = Schedule(iterations=4, gate=(12.0, 5.0), scale=(6.0, 2.0), cosine=0.5, interior=True)
"""Schedule by which an answer is fitted before it is compared. Chosen by hand."""


@dataclass(frozen=True, kw_only=True)
class JumpSettings:
    """When other answers are tried and accepted. The defaults were chosen by hand."""

    jump: float = 0.5
    """Range of a segment's turn beyond the poses' above which other answers are tried [rad]."""
    linked: float = 0.9
    """Least share of the frames in which patches show a segment's turn since the last frame, for that."""
    clearly: float = 0.99
    """Share of the disagreement with the silhouettes below which another answer replaces the present one. On `stealth`
    the right turn of the head has 0.95, and wrong ones 1.05 and more."""


def without_jumps(
    tracks: SurfaceTracks,
    poses: Mapping[int, Pose],
    body: Body,
    disagreement: Callable[[Mapping[int, Pose]], float],
    settings: JumpSettings | None = None,
) -> dict[int, Pose]:
    """Undo jumps of a segment's turn between two answers to the same silhouettes.

    The tracks tell by how much the segment turned from frame to frame. The turn in the whole take follows from that in
    one frame; several are tried, and the one whose body agrees best with the silhouettes is returned.

    Args:
        tracks: Tracks of the surface, followed with these poses.
        poses: Poses by frame.
        body: The body.
        disagreement: Disagreement of poses by frame with the silhouettes, see `outline_disagreement`.
        settings: Limits.

    Returns:
        Poses by frame; the given ones where no segment jumps.
    """
    settings, poses = settings or JumpSettings(), dict(poses)
    segments, names = body.skeleton.segment_names, list(body.skeleton.coordinate_names)
    frames = sorted(poses)
    for segment, coordinates in TURNED_BY.items():
        at = [names.index(name) - 6 for name in coordinates if name in names]
        if segment not in segments or not at or len(frames) < 2:
            continue
        change = np.array([tracks.turns[frame][segments.index(segment)] for frame in frames[1:]])
        turn = np.append(0.0, np.cumsum(np.nan_to_num(change)))
        if np.isfinite(change).mean() < settings.linked or np.ptp(turn) < settings.jump:
            continue
        grid = 0.5 * settings.jump
        levels = np.unique(np.round(np.quantile(turn, LEVELS) / grid)) * grid
        tried = [poses, *(_turned(poses, frames, at, turn - level) for level in levels)]
        costs = [disagreement(each) for each in tried]
        best = int(np.argmin(costs))
        if costs[best] < settings.clearly * costs[0]:
            poses = tried[best]
    return poses


def _turned(
    poses: Mapping[int, Pose], frames: Sequence[int], coordinates: Sequence[int], turn: np.ndarray
) -> dict[int, Pose]:
    """Return poses with a turn added in each frame, distributed evenly over coordinates."""
    found = dict(poses)
    for frame, more in zip(frames, turn, strict=True):
        angles = np.array(poses[frame].angles)
        angles[list(coordinates)] += more / len(coordinates)
        found[frame] = replace(poses[frame], angles=angles)
    return found


def outline_disagreement(
    levels: FrameLevels, body: Body, priors: Sequence[Observation]
) -> Callable[[Mapping[int, Pose]], float]:
    """Return a function that measures how far a body in given poses differs from the silhouettes.

    The poses of a few frames are fitted to the silhouettes first, so that answers are compared at their best.

    Args:
        levels: Silhouettes.
        body: The body.
        priors: Joint limits and other priors of the fit.

    Returns:
        A function of the poses by frame: the mean number of differing pixels per frame.
    """

    def differing(posed: PosedBody, level: SilhouetteLevel) -> int:
        fitted = fit_pose(posed, level.sightings, priors, schedule=SCHEDULE).posed
        seen = zip(level.cameras, level.masks, strict=True)
        return sum(int(np.count_nonzero(view_of(fitted, camera).mask() != mask)) for camera, mask in seen)

    def disagreement(poses: Mapping[int, Pose]) -> float:
        frames = sorted(poses)
        chosen = np.unique(np.linspace(0, len(frames) - 1, min(COMPARED_FRAMES, len(frames))).astype(int))
        compared = [frames[i] for i in chosen]
        return float(
            np.mean(list(map_in_threads(lambda f: differing(PosedBody(body, poses[f]), levels.at(f)), compared)))
        )

    return disagreement
