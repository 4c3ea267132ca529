"""Start and tracking of a person by the colours of its parts, without background, silhouettes or joints.

Ours: the place is found by the colours that the cameras have in common there. In some frames the posture is then
searched, and the colours of the parts are learned, in turn; each frame is scored with the colours of the other frames.
From the best of these frames, and facing either way, the person is tracked through the take.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from marey.arrays import Floats
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.surface import Body
from marey.fit.progress import FrameProgress, no_progress
from marey.fit.recipes.track import TrackSettings, prediction_spread
from marey.fit.regions.places import UP, PlaceSettings, find_places, postures_of
from marey.fit.regions.region_search import NearAngles, RegionImages, RegionSearch, learned_areas
from marey.fit.search.search import turned_about
from marey.fit.solver.threads import map_in_threads
from marey.geometry import rotations

ImagesOf = Callable[[int], RegionImages]
"""Returns the classes of the pixels of a frame."""
IMAGES_KEPT = 150
"""Number of frames whose evidence is kept in memory, because tracks and searches of limbs use it in turn; 0.4 MB each
with four cameras. Chosen by hand."""

USUAL_QUANTILE = 0.75
"""Quantile of the scores of a track that is a usual score: also of a person who is absent half of the time. Chosen by
hand."""


@dataclass(frozen=True, kw_only=True)
class RegionTrackSettings:
    """Settings of the start and of tracking by regions.

    Fields without a source were chosen by hand; results were not measured against other values.
    """

    places: PlaceSettings = field(default_factory=PlaceSettings)
    frames: int = 8
    """Number of frames in which the posture is searched."""
    headings: int = 12
    """Number of headings in which whole postures are tried."""
    shift: float = 0.12
    """Distance from the found place of the four others that are tried [m]."""
    least_share: float = 0.4
    """Share of a usual score below which a frame probably shows nobody."""
    shifted: float = 0.1
    """Share of the postures at the found place that are tried at the others, too. On four takes, as many improved
    postures as with all of them are the same."""
    kept: int = 4
    """Number of postures of a frame that are improved."""
    alike: float = 0.4
    """Angle between headings that count as the same [rad]; at most two postures with the same one are improved."""
    whole_shares: tuple[float, ...] = (0.3, 0.15, 0.1)
    """Share of the words of the whole body in the density of a part, in each round of posture search and learning."""
    limb_directions: int = 40
    """Number of directions in which a limb is searched."""
    starts: int = 2
    """Number of frames that are compared as the start of a track."""
    window: float = 0.7
    """Time on either side of a start in which the starts are compared [s]."""
    least_rate: float = 15.0
    """Least number of frames per second that are tracked until a background is learned [Hz]."""
    fall: float = 0.15
    """Drop of the score below its running median at which limbs are searched [nat m2]."""
    search_interval: float = 0.3
    """Longest time between searches of the limbs [s]. In `office`, joints are 106 mm off after tracking without these
    searches, 90 mm with them, and 94 mm with one every 0.1 s."""
    gain: float = 0.02
    """Least gain of the score for which searched limbs are kept [nat m2]."""
    memory: int = 10
    """Number of frames of the running median."""
    learned_every: int = 5
    """Every how many frames of the take the colours of the parts are learned from."""
    surroundings_frames: int = 24
    """Number of frames from which the words of the surroundings are learned that are removed from those of the parts.
    Without this, the sizes of the body grow into the surroundings: in `reach`, from which no constant was chosen, the
    errors of the final joints are 20.9 mm instead of 9.5 mm."""
    track: TrackSettings = field(default_factory=TrackSettings)
    """Momentum and spread of the prediction."""
    shape_frames: int = 8
    """Number of frames from which the rough sizes are estimated."""
    shape_numbers: int = 2
    """Number of leading shape parameters that are estimated. With three, the width grows without limit: joints of
    `jacks` and `market` were 75 and 137 mm off."""
    shape_steps: tuple[float, ...] = (1.0, 0.5)
    """Changes of a shape parameter that are tried [standard deviations]."""
    shape_weight: float = 0.03
    """Weight of a squared shape parameter in the score of a frame [nat m2]."""


@dataclass(frozen=True, eq=False)
class RegionTrack:
    """A person tracked by regions."""

    body: Body
    poses: Mapping[int, Pose]
    scores: Mapping[int, float]
    """Score of each frame [nat m2]."""
    learned: Floats
    """(C, P, K) areas of the words in the parts [m2]."""

    @property
    def mean_score(self) -> float:
        """The mean score of the frames [nat m2]."""
        return float(np.mean(list(self.scores.values())))

    @property
    def floor(self) -> float:
        """The usual height of the lowest vertex [m]."""
        return float(np.median([PosedBody(self.body, pose).vertices[:, 2].min() for pose in self.poses.values()]))

    def least_score(self, share: float) -> float:
        """Return the score below which a frame probably does not show the person at its pose: it is positive.

        Args:
            share: Share of a usual score, which most of the frames that show the person exceed.
        """
        return max(share * float(np.quantile(list(self.scores.values()), USUAL_QUANTILE)), 0.0)

    def shown(self, share: float) -> "RegionTrack":
        """Return the frames that show the person, see `least_score`."""
        least = self.least_score(share)
        kept = [frame for frame in self.poses if self.scores[frame] >= least]
        return replace(
            self,
            poses={frame: self.poses[frame] for frame in kept},
            scores={frame: self.scores[frame] for frame in kept},
        )


@dataclass(frozen=True, eq=False)
class RegionTracker:
    """Start and tracking of one person.

    Args:
        search: The score, with the cameras of the reduced images.
        images_of: Returns the classes of the pixels of a frame.
        frames: The frames of the take that show a person, in order.
        rate: Frame rate of the take [Hz].
        settings: Settings.
        step: Distance of successive frames, in frames of the take.
    """

    search: RegionSearch
    images_of: ImagesOf
    frames: tuple[int, ...]
    rate: float
    settings: RegionTrackSettings = field(default_factory=RegionTrackSettings)
    step: int = 1

    def reduced(self, through: int | None = None) -> "RegionTracker":
        """Return the tracker of every few frames, at least `RegionTrackSettings.least_rate` of them per second.

        Until a background is learned, the track is rough, and twice as many frames do not make it better.

        Args:
            through: A frame that is to be among them; by default the first one.
        """
        step = max(1, int(self.rate / self.settings.least_rate))
        first = 0 if through is None else self.frames.index(through) % step
        return replace(self, frames=self.frames[first::step], step=self.step * step)

    def started_at(self, posed: PosedBody, frame: int) -> RegionTrack:
        """Return a start whose pose in one frame is known, with the colours of this frame.

        Args:
            posed: The body, with few vertices, in its pose.
            frame: The frame.
        """
        poses = {frame: posed.pose}
        areas = learned_areas(self.search, posed.body, poses, {frame: self.images_of(frame)})
        return RegionTrack(posed.body, poses, {frame: 0.0}, areas[frame])

    def start(
        self, body: Body, *, floor: float | None = None, progress: FrameProgress = no_progress
    ) -> RegionTrack | None:  # fmt: skip
        """Find the pose in some frames, without any prior knowledge.

        Args:
            body: A body with few vertices.
            floor: Height of the floor [m]; by default it is searched.
            progress: Called with each frame that was searched in a round.

        Returns:
            The poses and scores of these frames, and the colours; None if no person can be in view of two cameras, or
            no frame probably shows one.
        """
        placed = self.placed(body, floor=floor)
        return None if placed is None else self.postured(placed, progress=progress)

    def placed(self, body: Body, *, floor: float | None = None) -> RegionTrack | None:
        """Find the place of an upright person in some frames, without any prior knowledge.

        Args:
            body: A body with few vertices.
            floor: Height of the floor [m]; by default it is searched.

        Returns:
            The frames that probably show the person, because its colours are those of the other frames, with upright
            poses and their scores; None if no person can be in view of two cameras, or no frame probably shows one.
        """
        index = np.unique(np.linspace(0, len(self.frames) - 1, self.settings.frames).astype(int))
        frames = [self.frames[i] for i in index]
        images = {frame: self.images_of(frame) for frame in frames}
        times = [frame / self.rate for frame in frames]
        found = find_places(self.search, body, list(images.values()), times, self.settings.places, floor)
        if found is None:
            return None
        poses = dict(zip(frames, found, strict=True))
        areas = learned_areas(self.search, body, poses, images)
        total = np.sum(list(areas.values()), axis=0)
        scores = {}
        for frame, pose in poses.items():
            others, share = total - areas[frame], self.settings.whole_shares[0]
            table = self.search.word_table(others, PosedBody(body, pose), images[frame], whole_share=share)
            scores[frame] = float(self.search.scores(body, [pose], images[frame], table)[0])
        shown = RegionTrack(body, poses, scores, total).shown(self.settings.least_share)
        return shown if shown.poses else None

    def postured(self, placed: RegionTrack, *, progress: FrameProgress = no_progress) -> RegionTrack:
        """Find the posture in frames in which the place is known; each is scored with the colours of the others.

        Args:
            placed: The frames with upright poses, see `placed`.
            progress: Called with each frame that was searched in a round.

        Returns:
            The poses and scores of these frames, and the colours.
        """
        body, poses = placed.body, dict(placed.poses)
        images, scores = {frame: self.images_of(frame) for frame in poses}, dict.fromkeys(poses, 0.0)
        for number, share in enumerate(self.settings.whole_shares):
            results = map_in_threads(self._searcher(body, poses, images, share, first=number == 0), list(poses))
            for frame, (score, pose) in zip(list(poses), results, strict=True):
                poses[frame], scores[frame] = pose, score
                progress(frame)
        areas = learned_areas(self.search, body, poses, images)
        return RegionTrack(body, poses, scores, np.sum(list(areas.values()), axis=0))

    def _searcher(
        self, body: Body, poses: Mapping[int, Pose], images: Mapping[int, RegionImages], share: float, *, first: bool
    ) -> Callable[[int], tuple[float, Pose]]:
        """Return the search of the posture in a frame, with the colours of the other frames."""
        areas, before = learned_areas(self.search, body, poses, images), dict(poses)
        total = np.sum(list(areas.values()), axis=0)

        def searched(frame: int) -> tuple[float, Pose]:
            posed, own = PosedBody(body, before[frame]), images[frame]
            table = self.search.word_table(total - areas[frame], posed, own, whole_share=share)
            return self.best_posture(posed, own, table) if first else self._improved(posed, own, table)

        return searched

    def best_posture(self, posed: PosedBody, images: RegionImages, table: Floats) -> tuple[float, Pose]:
        """Return the score and the pose of the best of many postures about an upright body.

        Args:
            posed: The upright body.
            images: The images.
            table: See `RegionSearch.word_table`.
        """
        tries = self._postures(posed, images, table)
        improved = [self._improved(replace(posed, pose=pose), images, table) for pose in tries]
        return max(improved, key=lambda each: each[0])

    def _postures(self, posed: PosedBody, images: RegionImages, table: Floats) -> list[Pose]:
        """Return the most promising whole postures about an upright body."""
        settings, body, place = self.settings, posed.body, posed.pose.translation
        postures, heights = postures_of(body)
        floor = place[2] - heights[int(np.argmin(np.abs(postures - posed.pose.angles).sum(axis=1)))]
        turns = [
            rotations.about(UP, np.asarray(turn))
            for turn in np.arange(settings.headings) * 2 * np.pi / settings.headings
        ]
        tries = [
            Pose(np.array([*place[:2], floor + height]), turn, angles)
            for turn in turns
            for angles, height in zip(postures, heights, strict=True)
        ]
        scores = self.search.scores(body, tries, images, table)
        best = np.argsort(-scores)[: int(np.ceil(settings.shifted * len(tries)))]
        moved = [
            replace(tries[i], translation=tries[i].translation + settings.shift * np.array([np.cos(a), np.sin(a), 0]))
            for a in np.arange(4) * np.pi / 2
            for i in best
        ]
        scores, tries = np.append(scores, self.search.scores(body, moved, images, table)), tries + moved
        kept: list[Pose] = []
        for i in np.argsort(-scores):
            alike = [
                np.linalg.norm(rotations.turn_between(tries[i].rotation, pose.rotation)) < settings.alike
                for pose in kept
            ]
            if sum(alike) < 2:
                kept.append(tries[i])
            if len(kept) == settings.kept:
                break
        return kept

    def _improved(self, posed: PosedBody, images: RegionImages, table: Floats) -> tuple[float, Pose]:
        """Fit a pose, search its limbs, and fit it again."""
        search = self.search
        _, pose = search.fit(posed, images, table)
        pose = search.limbs(replace(posed, pose=pose), images, table, directions=self.settings.limb_directions)
        return search.fit(replace(posed, pose=pose), images, table)

    def both_facings(self, started: RegionTrack, *, progress: FrameProgress = no_progress) -> list[RegionTrack]:
        """Track the person through the take from the best frame of a start, facing as there and facing the other way.

        In the first images, a person from the front and from the back has nearly the same score.

        Args:
            started: The start.
            progress: Called with each frame that was tracked.

        Returns:
            The two tracks.
        """
        settings = self.settings
        order = sorted(started.poses, key=lambda frame: -started.scores[frame])[: settings.starts]

        def near(frame: int) -> list[RegionTrack]:
            reach = max(1, round(settings.window * self.rate))
            frames = [other for other in self.frames if abs(other - frame) <= reach]
            posed = PosedBody(started.body, started.poses[frame])
            facings = (posed.pose, turned_about(posed))
            return [self.track(replace(started, poses={frame: pose}), frames, progress=progress) for pose in facings]

        tries = {frame: near(frame) for frame in order}
        best = max(tries, key=lambda frame: max(track.mean_score for track in tries[frame]))
        return [
            self.track(replace(track, poses={best: track.poses[best]}), self.frames, progress=progress)
            for track in tries[best]
        ]

    def track(
        self, started: RegionTrack, frames: Sequence[int], *, progress: FrameProgress = no_progress
    ) -> RegionTrack:
        """Track the person through frames, forward and backward from the only frame with a pose.

        Args:
            started: The body, the frame with a pose, and the colours.
            frames: The frames, in order; the one with a pose is among them.
            progress: Called with each frame that was tracked.

        Returns:
            The poses and scores.
        """
        begin = next(iter(started.poses))
        orders = [[f for f in frames if f >= begin], [f for f in reversed(frames) if f <= begin]]

        # The first frame is found twice; the result of the sweep forward is kept.
        swept = map_in_threads(lambda order: self._swept(started, order, progress), reversed(orders))
        found = [each for sweep in swept for each in sweep]
        poses, scores = {frame: pose for frame, _, pose in found}, {frame: score for frame, score, _ in found}
        return replace(started, poses=dict(sorted(poses.items())), scores=dict(sorted(scores.items())))

    def swept_again(self, track: RegionTrack, *, progress: FrameProgress = no_progress) -> RegionTrack:
        """Track the person from both ends of a track, and keep the pose with the better score in each frame.

        A limb that was lost in some frames and found again later is followed back into them.

        Args:
            track: The track.
            progress: Called with each frame that was tracked, once in each direction.

        Returns:
            The track with the better poses.
        """
        frames = list(track.poses)

        poses, scores = dict(track.poses), dict(track.scores)
        for found in map_in_threads(lambda order: self._swept(track, order, progress), (frames, frames[::-1])):
            for frame, score, pose in found:
                if score > scores[frame]:
                    poses[frame], scores[frame] = pose, score
        return replace(track, poses=poses, scores=scores)

    def _swept(
        self, started: RegionTrack, order: Sequence[int], progress: FrameProgress
    ) -> list[tuple[int, float, Pose]]:
        """Track the person along frames in one direction, from the pose in the first one."""
        settings, body, search = self.settings, started.body, self.search
        spread = prediction_spread(body.skeleton, settings.track, rate=self.rate / self.step)[6:]
        every = max(1, round(settings.search_interval * self.rate / self.step))
        swept: list[tuple[int, float, Pose]] = []
        history: list[float] = []
        pose = started.poses[order[0]]
        step: Floats = np.zeros(len(body.skeleton))
        for frame in order:
            images, predicted = self.images_of(frame), pose.step(settings.track.momentum * step)
            table = search.word_table(
                started.learned, PosedBody(body, predicted), images, whole_share=settings.whole_shares[-1]
            )
            near = NearAngles(predicted.angles, spread)
            score, found = search.fit(PosedBody(body, predicted), images, table, near)
            fallen = history and score < np.median(history[-settings.memory :]) - settings.fall
            if fallen or len(history) % every == every - 1:
                moved = search.limbs(PosedBody(body, found), images, table, directions=settings.limb_directions)
                better, moved = search.fit(PosedBody(body, moved), images, table)
                if better > score + settings.gain:
                    score, found = better, moved
            history.append(score)
            if frame != order[0]:
                step = pose.change_to(found)
            pose = found
            swept.append((frame, score, pose))
            progress(frame)
        return swept

    def with_sizes(self, track: RegionTrack, *, progress: FrameProgress = no_progress) -> RegionTrack:
        """Estimate rough sizes of the body from some frames of a track, and track the person again with them.

        Args:
            track: The track.
            progress: Called with each frame that was tracked.

        Returns:
            The track with the new body and colours.
        """
        track = track.shown(self.settings.least_share)
        track = replace(track, learned=self._own_areas(track))
        frames = self._spread(list(track.poses), self.settings.shape_frames)
        body, poses = self._shaped(track, frames) if len(track.body.space) else (track.body, dict(track.poses))
        count = len(self.frames) * self.step // self.settings.learned_every
        seen = {frame: track.poses[frame] for frame in self._spread(list(track.poses), max(count, 1))}
        areas = learned_areas(self.search, body, seen, {frame: self.images_of(frame) for frame in seen})
        learned = self._own_areas(RegionTrack(body, seen, {}, np.sum(list(areas.values()), axis=0)))
        middle = frames[len(frames) // 2]
        return self.track(RegionTrack(body, {middle: poses[middle]}, {}, learned), self.frames, progress=progress)

    def _own_areas(self, track: RegionTrack) -> Floats:
        """Return the areas of the words in the parts of a track without what belongs to the surroundings."""
        search, settings = self.search, self.settings
        frames = self._spread(list(track.poses), settings.surroundings_frames)
        around = [search.surroundings(PosedBody(track.body, track.poses[f]), self.images_of(f)) for f in frames]
        return search.own_areas(track.learned, np.mean(around, axis=0), whole_share=settings.whole_shares[-1])

    def _spread(self, frames: Sequence[int], count: int) -> list[int]:
        return [frames[i] for i in np.unique(np.linspace(0, len(frames) - 1, count).astype(int))]

    def _shaped(self, track: RegionTrack, frames: Sequence[int]) -> tuple[Body, dict[int, Pose]]:
        """Climb along the leading shape parameters, and fit the poses of some frames, in turn."""
        settings, space = self.settings, track.body.space
        steps_of = np.linalg.inv(space.leading.T)
        sd = np.sqrt(np.diag(steps_of @ space.prior_covariance @ steps_of.T))
        count = min(settings.shape_numbers, len(space))
        images = {frame: self.images_of(frame) for frame in frames}
        tables = {
            frame: self.search.word_table(
                track.learned, PosedBody(track.body, track.poses[frame]), images[frame],
                whole_share=settings.whole_shares[-1],
            )
            for frame in frames
        }  # fmt: skip

        def fitted(steps: Floats, poses: Mapping[int, Pose]) -> tuple[float, dict[int, Pose], Body]:
            body = track.body.with_numbers(space.leading.T @ steps)

            def posed_again(frame: int) -> tuple[float, Pose]:
                posed = PosedBody(body, poses[frame])
                return self.search.fit(posed, images[frame], tables[frame])

            results = list(map_in_threads(posed_again, frames))
            unusual = ((steps - steps_of @ space.prior_mean) / sd)[:count]
            score = sum(score for score, _ in results) - len(frames) * settings.shape_weight * float(unusual @ unusual)
            return score, {frame: pose for frame, (_, pose) in zip(frames, results, strict=True)}, body

        steps: Floats = steps_of @ track.body.numbers
        score, poses, body = fitted(steps, track.poses)
        for size in settings.shape_steps:
            for i in range(count):
                for sign in (1.0, -1.0):
                    while True:
                        changed = steps + sign * size * sd[i] * np.eye(len(steps))[i]
                        tried = fitted(changed, poses)
                        if tried[0] <= score:
                            break
                        (score, poses, body), steps = tried, changed
        return body, poses
