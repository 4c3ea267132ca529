"""From frame to frame: predict, fit, and where the agreement falls start from several poses and look for limbs."""

from collections.abc import Callable, Iterable, MutableMapping
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from marey.arrays import Floats
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.skeleton import Skeleton
from marey.body.articulation.surface import Body
from marey.fit.search.levels import FrameLevels, Level
from marey.fit.search.multi_start import SampleSettings, best_of_samples
from marey.fit.search.search import Candidate, Search, StartSettings
from marey.fit.solver.pose_solver import Schedule, fit_pose
from marey.fit.solver.side_by_side import side_by_side
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
    """Agreement below which the person is not found."""
    longest_hole: float = 0.5
    """Time without the person over which a pose predicts another [s]."""
    gain: float = 0.002
    """Agreement by which a sampled start must be better than the prediction."""
    samples: SampleSettings = field(default_factory=SampleSettings)


def prediction_spread(skeleton: Skeleton, settings: TrackSettings, *, rate: float) -> Floats:
    """Give the spread (D,) of each coordinate about its prediction: wider where frames lie farther apart."""
    turns = [settings.trunk_turn if c.segment in TRUNK else settings.limb_turn for c in skeleton.coordinates]
    root = [settings.root_shift] * 3 + [settings.root_turn] * 3
    return np.array(root + turns) * float(np.clip(30.0 / rate, 0.25, 3.0))


@dataclass(eq=False)
class _Trail:
    """Where a track has come to, and what was usual on its way."""

    pose: Pose
    """Where the person was last."""
    step: Floats
    """(D,) how it came there from the frame before; zero where that is unknown."""
    frame: int | None = None
    """The last frame in which the person was found; None before the first."""
    found: dict[int, Candidate] = field(default_factory=dict)
    bare: dict[int, float] = field(default_factory=dict)
    """Share of the silhouettes that the body left uncovered."""

    def gap(self, frame: int) -> int:
        """Count the frames from the last one to this one."""
        return 1 if self.frame is None else abs(frame - self.frame)

    def add(self, frame: int, candidate: Candidate) -> None:
        """Go on to a frame in which the person was found; a motion across a hole is no motion to repeat."""
        pose = candidate.posed.pose
        self.step = self.pose.change_to(pose) if self.gap(frame) == 1 else np.zeros(len(self.step))
        self.pose, self.frame = pose, frame
        self.found[frame] = candidate

    def usual_score(self, otherwise: float) -> float:
        """Give the median of the last scores."""
        return float(np.median([c.score for c in list(self.found.values())[-15:]] or [otherwise]))

    def usual_bare(self, levels: FrameLevels) -> float:
        """Give what is left uncovered where all is well: the lower quartile of the last frames."""
        last = list(self.found)[-30:]
        for frame in last:
            # Frames of an interrupted run come without.
            if frame not in self.bare:
                self.bare[frame] = unexplained(self.found[frame].posed, levels.at(frame))
        return float(np.quantile([self.bare[frame] for frame in last], 0.25)) if last else 0.0


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

    Where the person is lost or nobody is seen for a moment, the prediction waits and widens; it does not repeat the
    motion from before. After a longer hole it knows nothing any more, and the track ends.

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
        A candidate for each frame in which the person was found.
    """
    settings = settings or TrackSettings()
    memory = {} if memory is None else memory
    trail = _Trail(start, np.zeros(len(body.skeleton)))
    longest = max(1.0, settings.longest_hole * rate)
    for frame in levels.ahead(frames):
        if trail.gap(frame) > longest:
            break
        if frame not in memory:
            memory[frame] = _next(trail, frame, body, coarse or body, levels, rough, rate, settings)
        candidate = memory[frame]
        done(frame)
        if candidate.score >= settings.lost:
            trail.add(frame, candidate)
        elif trail.frame is None:
            break
    return trail.found


def _next(
    trail: _Trail,
    frame: int,
    body: Body,
    coarse: Body,
    levels: FrameLevels,
    rough: FrameLevels,
    rate: float,
    settings: TrackSettings,
) -> Candidate:
    """Follow the person into the next frame; where that explains it poorly, sample starts and search limbs."""
    gap = trail.gap(frame)
    spread = prediction_spread(body.skeleton, settings, rate=rate / gap)
    step = trail.step if gap == 1 else np.zeros(len(spread))
    candidate = _follow(PosedBody(body, trail.pose.step(settings.momentum * step)), levels, frame, spread, settings)
    usual = trail.usual_score(candidate.score)

    bare = unexplained(candidate.posed, levels.at(frame))
    seen = sum(bool(mask.any()) for mask in levels.at(frame).masks) >= 2
    if seen and (candidate.score < usual - settings.fall or bare > trail.usual_bare(levels) + settings.unexplained):
        sampled = best_of_samples(
            body, trail.pose, step, spread, levels.at(frame), rough.at(frame), coarse=coarse, settings=settings.samples
        )
        if sampled.score > candidate.score + settings.gain:
            candidate = sampled
        candidate = _search_limbs(candidate, coarse, levels, rough, frame)
        bare = unexplained(candidate.posed, levels.at(frame))
    trail.bare[frame] = bare
    return candidate


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


def repair(
    found: dict[int, Candidate],
    levels: FrameLevels,
    rough: FrameLevels,
    *,
    coarse: Body,
    rate: float,
    settings: TrackSettings | None = None,
    roughness: float = 0.0015,
    done: Callable[[int], None] = lambda frame: None,
    memory: MutableMapping[tuple[int, int], Candidate] | None = None,
) -> dict[int, Candidate]:
    """Mend frames that agree worse, explain less, or move more roughly than their neighbours.

    Each such frame tries its neighbours' poses, the pose midway between them, a search of its limbs, and where
    that is not enough starts sampled about the neighbour that was mended before it; agreement decides, less the
    distance (in degrees) from that neighbour. One sweep goes forward and one back, so that a run of bad frames is
    mended from both its ends. A memory, by way (1 or -1) and frame, takes every mended frame as soon as it is found;
    what it holds already is not sought again.
    """
    settings = settings or TrackSettings()
    memory = {} if memory is None else memory
    found = dict(found)
    suspects = _suspects(found, levels, settings)
    if not suspects:
        return found
    spread = prediction_spread(coarse.skeleton, settings, rate=rate)
    for order, step in ((suspects, 1), (suspects[::-1], -1)):
        for frame in order:
            if (step, frame) not in memory:
                memory[step, frame] = _mend(frame, step, found, levels, rough, coarse, spread, roughness, settings)
            found[frame] = memory[step, frame]
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
    # Copies, so that the skin of thousands of frames does not stay in memory.
    seen = ((replace(found[f].posed), levels.at(f)) for f in frames)
    bare = dict(zip(frames, side_by_side(lambda task: unexplained(*task), seen), strict=True))
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
    spread: Floats,
    weight: float,
    settings: TrackSettings,
) -> Candidate:
    last, other = found[frame - step].posed.pose, found[frame + step].posed.pose
    current = found[frame]
    search = Search(levels.at(frame), StartSettings())
    tries = [current]
    for pose in (last, other, last.between(other, 0.5)):
        tries.append(search.fit(replace(current.posed, pose=pose), numbers=0, iterations=6, gate=(16.0, 5.0)))
    tries.append(_search_limbs(current, coarse, levels, rough, frame))
    if max(c.score for c in tries) < found[frame - step].score - settings.fall:
        # The neighbour is right and this frame is not: the motion between them is larger than a fit can follow.
        before = found.get(frame - 2 * step)
        change = np.zeros(len(spread)) if before is None else before.posed.pose.change_to(last)
        tries.append(
            best_of_samples(
                current.posed.body, last, change, spread, levels.at(frame), rough.at(frame), coarse=coarse,
                settings=settings.samples,
            )
        )  # fmt: skip
    return max(tries, key=lambda c: c.score - weight * _apart(c.posed.pose, last))
