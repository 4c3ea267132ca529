"""Estimation of one person's motion and shape from the silhouettes of a take."""

from collections.abc import Callable, Container, Iterable, Iterator, Mapping, MutableMapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise

import numpy as np

from marey.arrays import Mask
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.surface import Body
from marey.body.metaballs.metaball_person import reshaped
from marey.cameras.camera import Camera
from marey.fit.progress import FrameProgress, no_progress
from marey.fit.recipes.facing import better_followed, facing_as, is_ambiguous
from marey.fit.recipes.pick_up import PickUpSettings, best_per_frame, pick_up, restart, weak_frames
from marey.fit.recipes.sequence import (
    RefineCheckpoint,
    SequenceFit,
    SequenceSettings,
    refine_in_pieces,
    refine_without_covariances,
)
from marey.fit.recipes.sequence_equations import FrameTermsFactory
from marey.fit.recipes.track import TrackSettings, repair, track
from marey.fit.search.levels import FrameLevels, level_factor
from marey.fit.search.search import Candidate, Search, StartSettings
from marey.fit.search.start import find_both_ways
from marey.fit.solver.camera_terms import CameraUnknowns
from marey.fit.solver.picture_times import PictureTimes
from marey.fit.solver.threads import map_in_threads
from marey.images.silhouettes.interior import InteriorEdges


@dataclass(frozen=True, kw_only=True)
class PersonSettings:
    """Settings of a person's capture.

    Fields without a source were chosen by hand; results were not measured against other values. The preliminary study
    used rendered takes with the true silhouettes; its scripts were not kept.
    """

    start: StartSettings = field(default_factory=StartSettings)
    track: TrackSettings = field(default_factory=TrackSettings)
    sequence: SequenceSettings = field(default_factory=SequenceSettings)
    pick_up: PickUpSettings = field(default_factory=PickUpSettings)
    bridge: float = 0.2
    """Longest gap without a pose that is filled by interpolation [s]."""
    start_frames: int = 3
    """Number of frames in which a start is tried. In the preliminary study the best of 1, 2, 3 and 5 frames was right
    in 89, 97, 99 and 100 % of 55 starts, and in 79, 86, 83 and 100 % of 28 others."""
    shape_frames: int = 25
    """Number of frames from which the shape is estimated. In the preliminary study the joint errors on `reach` and
    `walk` were 5.0 and 6.0 mm with 3 frames, 5.0 and 5.4 mm with 8, and 5.1 and 5.3 mm with 50."""
    track_height: float = 160.0
    """Height of the person in the images used for tracking [px]."""
    rough_height: float = 80.0
    """Height of the person in the images used to search for limbs during tracking [px]."""
    fine_height: float = 420.0
    """Height of the person in the images used for the final refinement of the sequence [px]."""


@dataclass(frozen=True, eq=False)
class SilhouetteTake:
    """The input of a fit: cameras, and silhouettes by frame."""

    cameras: tuple[Camera, ...]
    """C cameras."""
    masks_of: Callable[[int], Sequence[Mask]]
    """Returns the silhouettes of a frame: one mask (height, width) per camera."""
    frames: tuple[int, ...]
    """Frames in which a person was detected, in order."""
    rate: float
    """Frame rate [Hz]."""
    edges_of: Callable[[int], Sequence[InteriorEdges] | None] = lambda frame: None
    """Returns the edges inside a frame's silhouettes, one set per camera; None where they were not extracted."""
    hidden_of: Callable[[int], Sequence[Mask] | None] = lambda frame: None
    """Returns the regions in which something hides the person, one per camera; None where they are not known."""
    times: PictureTimes | None = None
    """When the cameras have taken their pictures; None if that is at the instants of the frames."""
    _levels: dict[float, FrameLevels] = field(default_factory=dict, init=False, repr=False)
    """Levels by factor."""
    _factors: dict[float, float] = field(default_factory=dict, init=False, repr=False)
    """Factors by height of the person [px]."""

    def levels(self, height: float) -> FrameLevels:
        """Return the frames scaled so that the person is about `height` pixels tall; calls for one size share them.

        In small images, several heights lead to the same size.
        """
        if height not in self._factors:
            self._factors[height] = self._factor(height)
        factor = self._factors[height]
        if factor not in self._levels:
            self._levels[factor] = FrameLevels(self.cameras, self.masks_of, factor, self.edges_of, self.hidden_of)
        return self._levels[factor]

    def forget(self, *, keep: float | None = None) -> None:
        """Release the memory of all levels but those of one height of the person [px], before work that needs it."""
        kept = None if keep is None else self.levels(keep)
        for levels in self._levels.values():
            if levels is not kept:
                levels.forget()

    def _factor(self, height: float) -> float:
        sample = self.frames[:: max(1, len(self.frames) // 5)][:5]
        return level_factor([mask for frame in sample for mask in self.masks_of(frame)], height)


@dataclass(frozen=True, eq=False)
class TrackCheckpoint:
    """Intermediate results of `track_person`; each mapping receives a candidate as soon as it is found."""

    followed: MutableMapping[tuple[int, int], Candidate] = field(default_factory=dict)
    """Tracked candidates, by the frame of their start and the frame."""
    starts: MutableMapping[int, Candidate] = field(default_factory=dict)
    """Further starts, by frame."""
    repaired: MutableMapping[tuple[int, int], Candidate] = field(default_factory=dict)
    """Repaired candidates, by the direction of the sweep (1 or -1) and the frame."""


class CandidatesOfStart(MutableMapping[int, Candidate]):
    """View of the tracked candidates that belong to one start.

    Args:
        every: Candidates by start and frame.
        start: Frame of the start.
    """

    def __init__(self, every: MutableMapping[tuple[int, int], Candidate], start: int):
        self._every, self._start = every, start

    def __getitem__(self, frame: int) -> Candidate:
        return self._every[self._start, frame]

    def __contains__(self, frame: object) -> bool:
        return (self._start, frame) in self._every

    def __setitem__(self, frame: int, candidate: Candidate) -> None:
        self._every[self._start, frame] = candidate

    def __delitem__(self, frame: int) -> None:
        del self._every[self._start, frame]

    def __iter__(self) -> Iterator[int]:
        return (frame for start, frame in self._every if start == self._start)

    def __len__(self) -> int:
        """Return the number of frames."""
        return sum(1 for _ in self)


def promising_frames(take: SilhouetteTake, count: int) -> list[int]:
    """Choose the frames that show the person best: in every camera, large, and not cut by the border.

    Args:
        take: Cameras and silhouettes.
        count: Number of frames; they are spread over time.
    """
    stride = max(1, len(take.frames) // 40)
    frames = list(take.frames[::stride])
    shown = np.array([[_shown(mask) for mask in take.masks_of(frame)] for frame in frames])
    usual = np.maximum(np.median(shown[:, :, 0], 0), 1.0)
    merit = np.minimum(shown[:, :, 0] / usual, 1.1).mean(1) - 4.0 * shown[:, :, 1].mean(1)
    merit -= 1.0 * (shown[:, :, 0] < 0.3 * usual).mean(1)
    chosen: list[int] = []
    apart = max(1, len(frames) // (2 * count))
    for i in np.argsort(-merit):
        if all(abs(i - other) >= apart for other in chosen):
            chosen.append(int(i))
        if len(chosen) == count:
            break
    return [frames[i] for i in chosen]


def _shown(mask: Mask) -> tuple[float, float]:
    """Return a silhouette's area [px] and the share of its extent that lies at the image's border."""
    area = float(np.count_nonzero(mask))
    if area == 0:
        return 0.0, 1.0
    border = float(sum(np.count_nonzero(edge) for edge in (mask[0], mask[-1], mask[:, 0], mask[:, -1])))
    return area, border / np.sqrt(area)


def start_person(
    take: SilhouetteTake,
    coarse: Body,
    fine: Body,
    settings: PersonSettings,
    *,
    progress: FrameProgress = no_progress,
    checkpoint: MutableMapping[int, Candidate] | None = None,
    opposite: MutableMapping[int, Candidate] | None = None,
    whole: Callable[[], tuple[Body, Body]] | None = None,
) -> tuple[int, Candidate] | None:
    """Find the pose and rough shape in the most promising frames, and return the candidate with the best score.

    The search stops early at a frame whose score reaches `StartSettings.good`. Where a candidate that faces the other
    way agrees nearly as well in the same frame, the frames around it decide, see `facing.better_followed`. If the
    body is a limb, and a whole person agrees better with the silhouettes of the frame, the limb faces as this person.

    Args:
        take: Cameras and silhouettes.
        coarse: Body with few vertices.
        fine: Body with all vertices.
        settings: Settings of the capture.
        progress: Called with each frame that was tried.
        checkpoint: Receives every candidate as soon as it is found; candidates that it already holds are reused.
        opposite: Receives those that face the other way; for frames that `checkpoint` holds, they are reused, too.
        whole: Returns the body of a whole person with few and with all vertices, if the body is a limb.

    Returns:
        The frame and its candidate, or None if no frame has a candidate.
    """
    checkpoint, opposite = {} if checkpoint is None else checkpoint, {} if opposite is None else opposite
    found: list[tuple[int, Candidate]] = []
    for frame in promising_frames(take, settings.start_frames):
        if frame not in checkpoint:
            candidates = find_both_ways(take.cameras, take.masks_of(frame), coarse, fine, settings.start)
            # The second one first: a frame in the checkpoint is finished.
            if len(candidates) > 1:
                opposite[frame] = candidates[1]
            if candidates:
                checkpoint[frame] = candidates[0]
        if frame in checkpoint:
            found.append((frame, checkpoint[frame]))
        progress(frame)
        if found and found[-1][1].score >= settings.start.good:
            break
    if not found:
        return None
    frame, best = max(found, key=lambda pair: pair[1].score)
    other = opposite.get(frame)
    if other is None or not is_ambiguous(best, other):
        return frame, best
    levels, rough = take.levels(settings.track_height), take.levels(settings.rough_height)
    follow = partial(
        better_followed, frame=frame, frames=take.frames, levels=levels, rough=rough, rate=take.rate,
        settings=settings.track,
    )  # fmt: skip
    if whole is not None:
        few, many = whole()
        persons = find_both_ways(take.cameras, take.masks_of(frame), few, many, settings.start)
        # Where the silhouettes show more than the limb, head and further limbs show the direction better.
        if persons and persons[0].score > best.score:
            ambiguous = len(persons) > 1 and is_ambiguous(persons[0], persons[1])
            person = follow(persons, coarse=few) if ambiguous else persons[0]
            return frame, facing_as(person, (best, other))
    return frame, follow((best, other), coarse=coarse)


def track_person(
    take: SilhouetteTake,
    body: Body,
    coarse: Body,
    start: tuple[int, Pose],
    settings: PersonSettings,
    *,
    progress: FrameProgress = no_progress,
    checkpoint: TrackCheckpoint | None = None,
) -> dict[int, Candidate]:
    """Track the person from the start to both ends of the take, with new starts and repairs where tracking failed.

    If the person is lost, or leaves and returns, new starts are searched for. A stretch with a much lower score than
    the rest is tracked again in the same way. The body's shape is kept.

    Args:
        take: Cameras and silhouettes.
        body: Body of fixed shape.
        coarse: The same body with few vertices.
        start: Frame and pose of the start.
        settings: Settings of the capture.
        progress: Called once with each frame.
        checkpoint: Results of an interrupted run, which are reused; receives every new result.

    Returns:
        A candidate for each frame in which the person was found.
    """
    checkpoint = checkpoint or TrackCheckpoint()
    levels, rough = take.levels(settings.track_height), take.levels(settings.rough_height)
    report = _once(progress)

    def follow(begun: int, pose: Pose, frames: Sequence[int]) -> dict[int, Candidate]:
        return track(
            body, pose, frames, levels, rough, rate=take.rate, settings=settings.track, coarse=coarse, progress=report,
            checkpoint=CandidatesOfStart(checkpoint.followed, begun),
        )  # fmt: skip

    def restart_at(frame: int) -> Candidate | None:
        if frame not in checkpoint.starts:
            masks = take.masks_of(frame)
            candidate = restart(take.cameras, masks, body, coarse, levels, frame, settings.start)
            if candidate is None:
                return None
            checkpoint.starts[frame] = candidate
        return checkpoint.starts[frame]

    frame, pose = start
    ahead, behind = [f for f in take.frames if f >= frame], [f for f in reversed(take.frames) if f < frame]
    found = follow(frame, pose, ahead) | follow(frame, pose, behind)
    weak = weak_frames(found, rate=take.rate, settings=settings.pick_up)
    again = pick_up(
        {f: c for f, c in found.items() if f not in weak}, take.frames, _merits(take), restart_at, follow,
        rate=take.rate, settings=settings.pick_up,
    )  # fmt: skip
    found = best_per_frame(found, again)
    for frame in take.frames:
        report(frame)
    return repair(
        found, levels, rough, coarse=coarse, rate=take.rate, settings=settings.track, checkpoint=checkpoint.repaired
    )  # fmt: skip


def _once(progress: FrameProgress) -> FrameProgress:
    """Return a progress function that passes each frame on only once."""
    finished: set[int] = set()

    def report(frame: int) -> None:
        if frame not in finished:
            finished.add(frame)
            progress(frame)

    return report


def _merits(take: SilhouetteTake) -> Callable[[int], float]:
    """Return a function that rates how well a frame shows the person: silhouette size, less what the borders cut."""

    def merit(frame: int) -> float:
        shown = [_shown(mask) for mask in take.masks_of(frame)]
        return float(np.mean([np.sqrt(area) * max(1.0 - 4.0 * cut, 0.0) for area, cut in shown]))

    return merit


def repair_person(
    take: SilhouetteTake,
    body: Body,
    coarse: Body,
    poses: Mapping[int, Pose],
    settings: PersonSettings,
    *,
    progress: FrameProgress = no_progress,
    checkpoint: MutableMapping[tuple[int, int], Candidate] | None = None,
) -> dict[int, Pose]:
    """Repair single frames of a sequence, given a better estimate of the body and better silhouettes.

    Args:
        take: Cameras and silhouettes.
        body: Body of fixed shape.
        coarse: The same body with few vertices.
        poses: Poses by frame.
        settings: Settings of the capture.
        progress: Called with each frame that was repaired.
        checkpoint: Receives every repaired frame as soon as it is found; frames that it already holds are reused.

    Returns:
        All poses by frame.
    """
    levels, rough = take.levels(settings.track_height), take.levels(settings.rough_height)
    scored = map_in_threads(lambda f: Search(levels.at(f), settings.start).judge(PosedBody(body, poses[f])), poses)
    judged = dict(zip(poses, scored, strict=True))
    repaired = repair(
        judged,
        levels,
        rough,
        coarse=coarse,
        rate=take.rate,
        settings=settings.track,
        progress=progress,
        checkpoint=checkpoint,
    )
    return {f: candidate.posed.pose for f, candidate in repaired.items()}


def interpolated_poses(poses: Mapping[int, Pose], *, longest: float) -> dict[int, Pose]:
    """Interpolate poses in short gaps.

    Args:
        poses: Known poses by frame.
        longest: Longest gap that is filled, in frames.

    Returns:
        The interpolated poses by frame.
    """
    filled = {}
    for before, after in pairwise(sorted(poses)):
        if 1 < after - before <= longest + 1:
            for frame in range(before + 1, after):
                filled[frame] = poses[before].between(poses[after], (frame - before) / (after - before))
    return filled


def unsupported_frames(
    take: SilhouetteTake,
    body: Body,
    poses: Mapping[int, Pose],
    frames: Iterable[int],
    settings: PersonSettings,
    *,
    usual: float,
) -> set[int]:
    """Return the frames whose interpolated poses agree with the silhouettes much worse than usual.

    Args:
        take: Cameras and silhouettes.
        body: Body of the poses.
        poses: Poses by frame.
        frames: Frames whose poses were interpolated.
        settings: Settings of the capture.
        usual: Usual score of the measured frames.
    """
    levels = take.levels(settings.track_height)
    scores = pose_scores(levels, body, {f: poses[f] for f in frames}, settings.start)
    return {f for f, score in scores.items() if score < usual - settings.pick_up.worse}


def pose_scores(
    levels: FrameLevels, body: Body, poses: Mapping[int, Pose], settings: StartSettings
) -> dict[int, float]:  # fmt: skip
    """Return how well a body in given poses agrees with the silhouettes, by frame.

    Args:
        levels: Silhouettes.
        body: The body.
        poses: Poses by frame.
        settings: Settings of the score.
    """
    scores = map_in_threads(lambda f: Search(levels.at(f), settings).judge(PosedBody(body, poses[f])).score, poses)
    return dict(zip(poses, scores, strict=True))


def shape_frames(agreements: Mapping[int, float], count: int) -> list[int]:
    """Choose `count` frames for the estimate of the shape, evenly spaced among the best 70 % by agreement."""
    scores = np.array(list(agreements.values()))
    good = [f for f, s in zip(agreements, scores, strict=True) if s >= np.quantile(scores, 0.3)]
    index = np.unique(np.linspace(0, len(good) - 1, min(count, len(good))).astype(int))
    return [good[i] for i in index]


def refine_person(
    take: SilhouetteTake,
    body: Body,
    poses: Mapping[int, Pose],
    for_shape: Sequence[int],
    settings: PersonSettings,
    *,
    height: float,
    rounds: int,
    ignored_frames: Container[int] = (),
    extra_terms: FrameTermsFactory | None = None,
    cameras: CameraUnknowns | None = None,
    progress: FrameProgress = no_progress,
    checkpoint: RefineCheckpoint | None = None,
) -> Iterator[SequenceFit]:
    """Refine motion and shape together at one size of the images, and yield the result window by window.

    Args:
        take: Cameras and silhouettes.
        body: Body whose shape is refined with the poses.
        poses: Poses by frame.
        for_shape: Frames from which the shape is estimated; without any it is kept.
        settings: Settings of the capture.
        height: Height of the person in the images [px].
        rounds: Number of iterations.
        ignored_frames: Frames whose silhouettes are ignored; their poses follow from their neighbours.
        extra_terms: Further observations, for example of surface points.
        cameras: Errors of the cameras, see `refine_in_pieces`.
        progress: Called with each frame in each round.
        checkpoint: Results of an interrupted run, which are reused; receives every new result.
    """
    return refine_in_pieces(
        list(poses), list(poses.values()), body, take.levels(height), rate=take.rate, rounds=rounds,
        shape_frames=for_shape, settings=settings.sequence, ignored_frames=ignored_frames, extra_terms=extra_terms,
        times=take.times, cameras=cameras, progress=progress, checkpoint=checkpoint,
    )  # fmt: skip


def refined_poses(
    take: SilhouetteTake, body: Body, poses: Mapping[int, Pose], for_shape: Sequence[int], settings: PersonSettings, *,
    height: float, rounds: int, extra_terms: FrameTermsFactory | None = None, progress: FrameProgress = no_progress,
    checkpoint: RefineCheckpoint | None = None,
) -> tuple[dict[int, Pose], Body]:  # fmt: skip
    """Refine as `refine_person` does, for poses that are refined once more: their covariances are not computed.

    The arguments are those of `refine_person`.

    Returns:
        The poses by frame, and the body with the refined shape.
    """
    found, body = refine_without_covariances(
        list(poses), list(poses.values()), body, take.levels(height), rate=take.rate, rounds=rounds,
        shape_frames=for_shape, settings=settings.sequence, extra_terms=extra_terms, times=take.times,
        progress=progress, checkpoint=checkpoint,
    )  # fmt: skip
    return dict(zip(poses, found, strict=True)), body


def with_shape(body: Body, other: Body) -> Body:
    """Return the other body, of another level of detail, with the shape parameters of the first one."""
    return replace(reshaped(other, body.numbers), numbers_covariance=body.numbers_covariance)
