"""From frame to frame: predict, fit, and look for limbs again where the agreement falls."""

from collections.abc import Callable, Iterable, MutableMapping
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from marey.arrays import Floats
from marey.body.pose import Pose, PosedBody
from marey.body.skeleton import Skeleton
from marey.body.surface import Body
from marey.fit.levels import FrameLevels, Level
from marey.fit.pose_solver import Schedule, fit_pose
from marey.fit.search import Candidate, Search, StartSettings
from marey.observations.correspondence import view_of
from marey.observations.prior import Habit, JointLimits, NearPose

TRUNK = ("abdomen", "thorax", "neck", "head", "left_clavicle", "right_clavicle")


@dataclass(frozen=True, kw_only=True)
class TrackSettings:
    """How a person is followed."""

    schedule: Schedule = field(default_factory=lambda: Schedule(iterations=6, gate=(20.0, 5.0), scale=(8.0, 3.0)))
    momentum: float = 0.7
    """Share of the last frame's motion that the prediction repeats."""
    limb_turn: float = float(np.deg2rad(12.0))
    """Spread of a limb's angle about its prediction over a thirtieth of a second [rad]."""
    trunk_turn: float = float(np.deg2rad(5.0))
    root_turn: float = float(np.deg2rad(10.0))
    root_shift: float = 0.06
    """Spread of the pelvis about its prediction over a thirtieth of a second [m]."""
    habit: float = 0.1
    fall: float = 0.012
    """Loss of agreement, against the running median, at which limbs are searched again."""
    unexplained: float = 0.008
    """Share of the silhouettes, thin edges apart, that the body may leave uncovered beyond what is usual."""
    lost: float = 0.45
    """Agreement below which nobody is followed any more."""


def prediction_spread(skeleton: Skeleton, settings: TrackSettings, *, rate: float) -> Floats:
    """Give the spread (D,) of each coordinate about its prediction: wider where frames lie farther apart."""
    turns = [settings.trunk_turn if c.segment in TRUNK else settings.limb_turn for c in skeleton.coordinates]
    root = [settings.root_shift] * 3 + [settings.root_turn] * 3
    return np.array(root + turns) * float(np.clip(30.0 / rate, 0.25, 3.0))


def track(
    body: Body,
    start: Pose,
    frames: Iterable[int],
    levels: FrameLevels,
    rough: FrameLevels,
    *,
    rate: float,
    settings: TrackSettings | None = None,
    coarse: Body | None = None,
    done: Callable[[int], None] = lambda frame: None,
    memory: MutableMapping[int, Candidate] | None = None,
) -> dict[int, Candidate]:
    """Follow a person from a known pose through frames in either direction.

    Args:
        body: whose shape stays as it is.
        start: the pose just before the first of the frames.
        frames: in the order in which they are visited.
        levels: silhouettes for the fit.
        rough: silhouettes, smaller, for the search of lost limbs.
        rate: frames in a second.
        settings: how the person is followed.
        coarse: the same body with few vertices, for the search; the body itself when missing.
        done: told of every frame that is finished.
        memory: takes every candidate as soon as it is found; what it holds already is not sought again.

    Returns:
        A candidate for each frame until the person was lost.
    """
    settings = settings or TrackSettings()
    memory = {} if memory is None else memory
    spread = prediction_spread(body.skeleton, settings, rate=rate)
    last, before = start, start
    found: dict[int, Candidate] = {}
    bare: list[float] = []
    for frame in frames:
        if frame not in memory:
            predicted = last.step(settings.momentum * before.change_to(last))
            candidate = _follow(PosedBody(body, predicted), levels, frame, spread, settings)
            usual = float(np.median([c.score for c in list(found.values())[-15:]] or [candidate.score]))
            left_over = unexplained(candidate.posed, levels.at(frame))
            if candidate.score < usual - settings.fall or left_over > _usual(bare) + settings.unexplained:
                candidate = _search_limbs(candidate, coarse or body, levels, rough, frame)
                left_over = unexplained(candidate.posed, levels.at(frame))
            bare.append(left_over)
            memory[frame] = candidate
        candidate = memory[frame]
        done(frame)
        if candidate.score < settings.lost:
            break
        found[frame] = candidate
        before, last = last, candidate.posed.pose
    return found


def _follow(
    predicted: PosedBody, levels: FrameLevels, frame: int, spread: Floats, settings: TrackSettings
) -> Candidate:
    level = levels.at(frame)
    others = (JointLimits(), Habit(share=settings.habit), NearPose(pose=predicted.pose, spread=spread))
    fitted = fit_pose(predicted, level.sightings, others, schedule=settings.schedule)
    return Search(level, StartSettings()).judge(fitted.posed)


def _search_limbs(candidate: Candidate, coarse: Body, levels: FrameLevels, rough: FrameLevels, frame: int) -> Candidate:
    """Look for every limb anew at the rough level, then fit again at the fine one."""
    body = candidate.posed.body
    small = Search(rough.at(frame), StartSettings())
    searched = small.limbs(small.judge(replace(candidate.posed, body=coarse)), numbers=0)
    fine = Search(levels.at(frame), StartSettings())
    again = fine.fit(replace(searched.posed, body=body), numbers=0, iterations=6, gate=(16.0, 5.0))
    return max(candidate, again, key=lambda c: c.score)


def unexplained(posed: PosedBody, level: Level) -> float:
    """Give the share of the silhouettes that the body leaves uncovered but for thin edges; mean of the cameras."""
    shares = []
    for camera, mask in zip(level.cameras, level.masks, strict=True):
        area = int(np.count_nonzero(mask))
        if area:
            bare = (mask & ~view_of(posed, camera).mask()).astype(np.uint8)
            shares.append(np.count_nonzero(cv2.erode(bare, np.ones((3, 3), np.uint8))) / area)
    return float(np.mean(shares)) if shares else 0.0


def _usual(values: list[float]) -> float:
    return float(np.quantile(values[-30:], 0.25)) if values else 0.0


def repair(
    found: dict[int, Candidate],
    levels: FrameLevels,
    rough: FrameLevels,
    *,
    coarse: Body,
    settings: TrackSettings | None = None,
    roughness: float = 0.0015,
    done: Callable[[int], None] = lambda frame: None,
) -> dict[int, Candidate]:
    """Mend frames that agree worse, explain less, or move more roughly than their neighbours.

    Each such frame tries its neighbours' poses, the pose midway between them, and a search of its limbs;
    agreement decides, less the distance (in degrees) from the neighbour that was mended before it. One
    sweep goes forward and one back, so that a run of bad frames is mended from both its ends.
    """
    settings = settings or TrackSettings()
    found = dict(found)
    suspects = _suspects(found, levels, settings)
    for order, step in ((suspects, 1), (suspects[::-1], -1)):
        for frame in order:
            found[frame] = _mend(frame, step, found, levels, rough, coarse, roughness)
            done(frame)
    return found


def _roughness(pose: Pose, before: Pose, after: Pose) -> float:
    return _apart(pose, before.between(after, 0.5))


def _apart(pose: Pose, other: Pose) -> float:
    """Give the root mean square of the turns between two poses [degrees]."""
    return float(np.degrees(np.sqrt(np.mean(other.change_to(pose)[3:] ** 2))))


def _suspects(found: dict[int, Candidate], levels: FrameLevels, settings: TrackSettings) -> list[int]:
    frames = [f for f in sorted(found) if f - 1 in found and f + 1 in found]
    if len(frames) < 5:
        return []
    rough = {f: _roughness(*(found[f + k].posed.pose for k in (0, -1, 1))) for f in frames}
    bare = {f: unexplained(found[f].posed, levels.at(f)) for f in frames}
    usual, clean = float(np.median(list(rough.values()))), float(np.quantile(list(bare.values()), 0.25))
    suspects = []
    for f in frames:
        near = [found[g].score for g in range(f - 8, f + 9) if g in found]
        low = found[f].score < np.median(near) - 0.01
        if low or rough[f] > 3 * usual or bare[f] > clean + settings.unexplained:
            suspects.append(f)
    return suspects


def _mend(
    frame: int,
    step: int,
    found: dict[int, Candidate],
    levels: FrameLevels,
    rough: FrameLevels,
    coarse: Body,
    weight: float,
) -> Candidate:
    last, other = found[frame - step].posed.pose, found[frame + step].posed.pose
    current = found[frame]
    search = Search(levels.at(frame), StartSettings())
    tries = [current]
    for pose in (last, other, last.between(other, 0.5)):
        tries.append(search.fit(replace(current.posed, pose=pose), numbers=0, iterations=6, gate=(16.0, 5.0)))
    tries.append(_search_limbs(current, coarse, levels, rough, frame))
    return max(tries, key=lambda c: c.score - weight * _apart(c.posed.pose, last))
