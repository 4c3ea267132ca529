"""Frame-to-frame tracking: prediction and fit, with sampled starts and a search of the limbs where agreement drops."""

from collections.abc import Iterable, MutableMapping
from contextlib import closing
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from marey.arrays import Floats
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.skeleton import Skeleton
from marey.body.articulation.surface import Body
from marey.fit.progress import FrameProgress, no_progress
from marey.fit.search.levels import FrameLevels, SilhouetteLevel
from marey.fit.search.multi_start import SampleSettings, best_of_samples
from marey.fit.search.search import Candidate, Search, StartSettings
from marey.fit.solver.pose_solver import Schedule, fit_pose
from marey.fit.solver.processes import map_in_processes
from marey.fit.solver.threads import map_in_threads
from marey.observations.correspondence import view_of
from marey.observations.prior import Habit, JointLimits, NearPose

TRUNK_SEGMENTS = ("abdomen", "thorax", "neck", "head", "left_clavicle", "right_clavicle")
"""Segments whose joints move as slowly as those of the trunk; see `TrackSettings` and `SequenceSettings`."""


@dataclass(frozen=True, kw_only=True)
class TrackSettings:
    """Settings of frame-to-frame tracking.

    "Study" marks values of the preliminary study on rendered takes with the true silhouettes, which worked there and
    were not compared with others; its scripts were not kept. The other defaults were chosen by hand; results were not
    measured against other values.
    """

    schedule: Schedule = field(default_factory=lambda: Schedule(iterations=6, gate=(20.0, 5.0), scale=(8.0, 3.0)))
    """Iterations of each frame's fit; their number is from the study."""
    momentum: float = 0.7
    """Share of the last frame's motion that the prediction repeats. Study."""
    limb_turn: float = float(np.deg2rad(12.0))
    """Standard deviation of a limb's angle from its prediction over 1/30 s [rad]. Study."""
    trunk_turn: float = float(np.deg2rad(5.0))
    """Standard deviation of a trunk angle from its prediction over 1/30 s [rad]. Study."""
    root_turn: float = float(np.deg2rad(10.0))
    """Standard deviation of the pelvis' rotation from its prediction over 1/30 s, per axis [rad]."""
    root_shift: float = 0.06
    """Standard deviation of the pelvis' position from its prediction over 1/30 s, per axis [m]."""
    habit: float = 0.1
    """Weight of the usual joint angles in each frame, as a number of observations."""
    fall: float = 0.012
    """Drop of agreement below the running median at which limbs are searched for again. Study."""
    uncovered_share: float = 0.008
    """Share of the silhouettes, without thin edges, that the body may leave uncovered above the usual share."""
    lost: float = 0.45
    """Agreement below which the person counts as lost."""
    longest_hole: float = 0.5
    """Longest gap over which a pose predicts the next one [s]."""
    gain: float = 0.002
    """Least gain of agreement for which a sampled start replaces the prediction."""
    samples: SampleSettings = field(default_factory=SampleSettings)
    """Settings of the sampled starts."""


def prediction_spread(skeleton: Skeleton, settings: TrackSettings, *, rate: float) -> Floats:
    """Return the standard deviation (D,) of each coordinate from its prediction, larger at a lower frame rate."""
    turns = [settings.trunk_turn if c.segment in TRUNK_SEGMENTS else settings.limb_turn for c in skeleton.coordinates]
    root = [settings.root_shift] * 3 + [settings.root_turn] * 3
    return np.array(root + turns) * float(np.clip(30.0 / rate, 0.25, 3.0))


@dataclass(eq=False)
class _TrackState:
    """Current state of a track, and statistics of its frames so far."""

    pose: Pose
    """Last known pose."""
    step: Floats
    """(D,) change to it from the frame before; zero where that is unknown."""
    frame: int | None = None
    """Last frame in which the person was found; None before the first."""
    found: dict[int, Candidate] = field(default_factory=dict)
    """Candidates by frame."""
    uncovered: dict[int, float] = field(default_factory=dict)
    """Share of the silhouettes that the body left uncovered, by frame."""

    def gap(self, frame: int) -> int:
        """Return the distance from the last frame to this one, in frames."""
        return 1 if self.frame is None else abs(frame - self.frame)

    def add(self, frame: int, candidate: Candidate) -> None:
        """Add a frame in which the person was found; the motion across a gap is not repeated."""
        pose = candidate.posed.pose
        self.step = self.pose.change_to(pose) if self.gap(frame) == 1 else np.zeros(len(self.step))
        self.pose, self.frame = pose, frame
        self.found[frame] = candidate

    def usual_score(self, otherwise: float) -> float:
        """Return the median of the last scores."""
        return float(np.median([c.score for c in list(self.found.values())[-15:]] or [otherwise]))

    def usual_uncovered(self, levels: FrameLevels) -> float:
        """Return the usual uncovered share: the lower quartile of the last frames."""
        last = list(self.found)[-30:]
        for frame in last:
            # Frames from a checkpoint have no value yet.
            if frame not in self.uncovered:
                self.uncovered[frame] = uncovered_share(self.found[frame].posed, levels.at(frame))
        return float(np.quantile([self.uncovered[frame] for frame in last], 0.25)) if last else 0.0


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
    progress: FrameProgress = no_progress,
    checkpoint: MutableMapping[int, Candidate] | None = None,
) -> dict[int, Candidate]:
    """Track a person from a known pose through frames in either direction.

    While the person is lost or not detected, the last pose is the prediction, with a growing uncertainty; the motion
    before the gap is not repeated. The track ends after a gap longer than `TrackSettings.longest_hole`.

    Args:
        body: Body of fixed shape.
        start: Pose just before the first of the frames.
        frames: Frames in the order in which they are visited.
        levels: Silhouettes for the fit.
        rough: Smaller silhouettes for the search of lost limbs.
        rate: Frame rate [Hz].
        settings: Settings of the tracking.
        coarse: The same body with few vertices, for the search; the body itself if None.
        progress: Called with each frame that is finished.
        checkpoint: Receives every candidate as soon as it is found; candidates that it already holds are reused.

    Returns:
        A candidate for each frame in which the person was found.
    """
    settings = settings or TrackSettings()
    checkpoint = {} if checkpoint is None else checkpoint
    trail = _TrackState(start, np.zeros(len(body.skeleton)))
    longest = max(1.0, settings.longest_hole * rate)
    for frame in levels.ahead(frames):
        if trail.gap(frame) > longest:
            break
        if frame not in checkpoint:
            checkpoint[frame] = _next(trail, frame, body, coarse or body, levels, rough, rate, settings)
        candidate = checkpoint[frame]
        progress(frame)
        if candidate.score >= settings.lost:
            trail.add(frame, candidate)
        elif trail.frame is None:
            break
    return trail.found


def _next(
    trail: _TrackState,
    frame: int,
    body: Body,
    coarse: Body,
    levels: FrameLevels,
    rough: FrameLevels,
    rate: float,
    settings: TrackSettings,
) -> Candidate:
    """Fit the next frame from its prediction; where the agreement is poor, sample starts and search the limbs."""
    gap = trail.gap(frame)
    spread = prediction_spread(body.skeleton, settings, rate=rate / gap)
    step = trail.step if gap == 1 else np.zeros(len(spread))
    candidate = _fit_prediction(
        PosedBody(body, trail.pose.step(settings.momentum * step)), levels, frame, spread, settings
    )
    usual = trail.usual_score(candidate.score)

    uncovered = uncovered_share(candidate.posed, levels.at(frame))
    seen = sum(bool(mask.any()) for mask in levels.at(frame).masks) >= 2
    if seen and (
        candidate.score < usual - settings.fall or uncovered > trail.usual_uncovered(levels) + settings.uncovered_share
    ):
        sampled = best_of_samples(
            body, trail.pose, step, spread, levels.at(frame), rough.at(frame), coarse=coarse, settings=settings.samples
        )
        if sampled.score > candidate.score + settings.gain:
            candidate = sampled
        candidate = _search_limbs(candidate, coarse, levels, rough, frame)
        uncovered = uncovered_share(candidate.posed, levels.at(frame))
    trail.uncovered[frame] = uncovered
    return candidate


def _fit_prediction(
    predicted: PosedBody, levels: FrameLevels, frame: int, spread: Floats, settings: TrackSettings
) -> Candidate:
    level = levels.at(frame)
    others = (JointLimits(), Habit(share=settings.habit), NearPose(pose=predicted.pose, spread=spread))
    fitted = fit_pose(predicted, level.sightings, others, schedule=settings.schedule)
    return Search(level, StartSettings()).judge(fitted.posed)


def _search_limbs(candidate: Candidate, coarse: Body, levels: FrameLevels, rough: FrameLevels, frame: int) -> Candidate:
    """Search for every limb at the rough level, then fit again at the fine one."""
    body = candidate.posed.body
    small = Search(rough.at(frame), StartSettings())
    searched = small.limbs(small.judge(replace(candidate.posed, body=coarse)), numbers=0)
    fine = Search(levels.at(frame), StartSettings())
    again = fine.fit(replace(searched.posed, body=body), numbers=0, iterations=6, gate=(16.0, 5.0))
    return max(candidate, again, key=lambda c: c.score)


def uncovered_share(posed: PosedBody, level: SilhouetteLevel) -> float:
    """Return the share of the silhouettes that the body leaves uncovered, without thin edges; the mean over cameras."""
    shares = []
    for camera, mask in zip(level.cameras, level.masks, strict=True):
        area = int(np.count_nonzero(mask))
        if area:
            uncovered = (mask & ~view_of(posed, camera).mask()).astype(np.uint8)
            shares.append(np.count_nonzero(cv2.erode(uncovered, np.ones((3, 3), np.uint8))) / area)
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
    progress: FrameProgress = no_progress,
    checkpoint: MutableMapping[tuple[int, int], Candidate] | None = None,
) -> dict[int, Candidate]:
    """Repair frames that agree worse, cover less, or move less smoothly than their neighbours.

    Each such frame is fitted from its neighbours' poses, from the pose midway between them, by a search of its limbs,
    and, if that is not enough, from starts sampled about the neighbour that was repaired before it. The candidate of
    best agreement, less a cost of the distance from that neighbour, is kept. One sweep goes forward and one backward,
    so that a run of bad frames is repaired from both ends.

    Args:
        found: Candidates by frame.
        levels: Silhouettes for the fit.
        rough: Smaller silhouettes for the search of limbs.
        coarse: The same body with few vertices.
        rate: Frame rate [Hz].
        settings: Settings of the tracking.
        roughness: Cost of the distance from the neighbour, as agreement per degree.
        progress: Called with each frame that was repaired.
        checkpoint: Receives every repaired frame, by direction of the sweep (1 or -1) and frame, as soon as it is
            found; frames that it already holds are reused.

    Returns:
        All candidates by frame.
    """
    settings = settings or TrackSettings()
    checkpoint = {} if checkpoint is None else checkpoint
    found = dict(found)
    suspects = _suspects(found, levels, settings)
    if not suspects:
        return found
    spread = prediction_spread(coarse.skeleton, settings, rate=rate)
    first, limbs = dict(found), dict[int, tuple[Pose, float]]()
    wanted = [frame for frame in suspects if (-1, frame) not in checkpoint]
    with closing(map_in_processes(lambda f: _limbs_of(first[f], coarse, levels, rough, f), wanted)) as stream:

        def searched(frame: int) -> Candidate:
            """Return the result of the search of the limbs; that of a frame as it was at first is in the stream."""
            if found[frame] is not first[frame]:
                return _search_limbs(found[frame], coarse, levels, rough, frame)
            while frame not in limbs:
                limbs[wanted[len(limbs)]] = next(stream)
            pose, score = limbs[frame]
            return Candidate(replace(found[frame].posed, pose=pose), score)

        for order, step in ((suspects, 1), (suspects[::-1], -1)):
            for frame in order:
                if (step, frame) in checkpoint:
                    found[frame] = checkpoint[step, frame]
                else:
                    best = _repair_frame(
                        frame, step, found, searched(frame), levels, rough, coarse, spread, roughness, settings
                    )
                    checkpoint[step, frame] = best
                    found[frame] = best if best is found[frame] else checkpoint[step, frame]
                progress(frame)
    return found


def _limbs_of(
    candidate: Candidate, coarse: Body, levels: FrameLevels, rough: FrameLevels, frame: int
) -> tuple[Pose, float]:  # fmt: skip
    """Return pose and score of `_search_limbs`, which need little memory."""
    again = _search_limbs(candidate, coarse, levels, rough, frame)
    return again.posed.pose, again.score


def _roughness(pose: Pose, before: Pose, after: Pose) -> float:
    return _rms_turn(pose, before.between(after, 0.5))


def _rms_turn(pose: Pose, other: Pose) -> float:
    """Return the root mean square of the rotations between two poses [degrees]."""
    return float(np.degrees(np.sqrt(np.mean(other.change_to(pose)[3:] ** 2))))


def _suspects(found: dict[int, Candidate], levels: FrameLevels, settings: TrackSettings) -> list[int]:
    frames = [f for f in sorted(found) if f - 1 in found and f + 1 in found]
    if len(frames) < 5:
        return []
    rough = {f: _roughness(*(found[f + k].posed.pose for k in (0, -1, 1))) for f in frames}
    # Copies are posed, so that the skin of thousands of frames is not kept in memory.
    shares = map_in_threads(lambda f: uncovered_share(replace(found[f].posed), levels.at(f)), frames)
    uncovered = dict(zip(frames, shares, strict=True))
    usual, clean = float(np.median(list(rough.values()))), float(np.quantile(list(uncovered.values()), 0.25))
    suspects = []
    for f in frames:
        near = [found[g].score for g in range(f - 8, f + 9) if g in found]
        low = found[f].score < np.median(near) - 0.01
        if low or rough[f] > 3 * usual or uncovered[f] > clean + settings.uncovered_share:
            suspects.append(f)
    return suspects


def _repair_frame(
    frame: int,
    step: int,
    found: dict[int, Candidate],
    limbs: Candidate,
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
    tries.append(limbs)
    if max(c.score for c in tries) < found[frame - step].score - settings.fall:
        # The neighbour fits and this frame does not: the motion between them is too large for a single fit.
        before = found.get(frame - 2 * step)
        change = np.zeros(len(spread)) if before is None else before.posed.pose.change_to(last)
        tries.append(
            best_of_samples(
                current.posed.body, last, change, spread, levels.at(frame), rough.at(frame), coarse=coarse,
                settings=settings.samples,
            )
        )  # fmt: skip
    return max(tries, key=lambda c: c.score - weight * _rms_turn(c.posed.pose, last))
