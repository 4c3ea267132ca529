"""Limbs of a refined motion searched by the colours of the parts: lost ones are replaced, uncertain ones recognised.

In some frames a limb is placed in all directions. The best postures are followed into the frames beside. With the given
motion, they form paths through the take; the most probable path replaces the given one where it is far from it, and
the other postures remain as alternatives as far as all paths together make them probable.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, reduce
from itertools import pairwise

import numpy as np

from marey.arrays import Floats
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.surface import Body
from marey.fit.progress import FrameProgress, no_progress
from marey.fit.recipes.hypotheses import Alternative, OtherPostures
from marey.fit.regions.posture_paths import PosturePaths
from marey.fit.regions.region_search import NearAngles, RegionImages, RegionSearch
from marey.fit.regions.region_track import ImagesOf
from marey.fit.search import placements
from marey.fit.search.placements import LimbCoordinates
from marey.fit.solver.threads import map_in_threads


@dataclass(frozen=True, kw_only=True)
class LimbRepairSettings:
    """Settings of the search for lost limbs.

    Fields without a source were chosen by hand; results were not measured against other values.
    """

    directions: int = 40
    """Number of directions in which a limb is searched. After tracking of `office`, whose joints are 106 mm off, a
    search with 28, 40 and 80 leaves 84, 80 and 82 mm."""
    tried: int = 3
    """Number of placements of a limb that are improved in a frame. With five, the same search leaves 80 instead of 81
    mm in 1.2 times the time."""
    interval: float = 0.1
    """Time between the frames in which the limbs are searched [s]."""
    followed: float = 0.4
    """Longest time for which a posture is followed into the frames beside the one where it was found [s]."""
    learned_every: int = 3
    """Every how many frames the colours of the parts are learned from."""
    whole_share: float = 0.05
    """Share of the words of the whole body in the density of a part."""
    settle_reaches: tuple[int, ...] = (2, 2)
    """Half lengths of the lines with which the given pose is fitted before it is compared [px]."""
    settle_spread: float = 0.05
    """Standard deviation of a change of an angle in this fit [rad]."""
    search_steps: tuple[float, ...] = (0.1, 0.06, 0.03, 0.02)
    """Changes of an angle with which a searched limb is improved [rad]."""
    follow_steps: tuple[float, ...] = (0.06, 0.03)
    """Changes of an angle with which a posture is followed into the next frame [rad]."""
    least_gain: float = -0.15
    """Least gain of the score from the given posture to another one that is kept [nat m2]."""
    alike: float = 0.03
    """Mean distance of the limb's joints below which two postures are the same [m]."""
    evidence: float = 300.0
    """Log-likelihood of a gain that lasts, per its size and time [1/(nat m2 s)]. Neighbouring pixels and frames are not
    independent; a frame at 30 Hz counts as 10 nat per nat m2."""
    usual_path: float = 0.05
    """Mean length of the path of the limb's joints that is e times less probable than no motion [m]."""
    possible: float = 0.05
    """Least probability of an alternative, as in `HypothesisSettings`."""
    least_distance: float = 0.08
    """Least mean distance of the limb's joints from the given ones where it is replaced, and of an alternative [m]:
    smaller differences are left to the outlines, which are more accurate. With 0.06, the errors in `market` are 11.7
    instead of 10.8 mm."""
    joined: float = 0.2
    """Longest time without an alternative between two runs of frames that count as one [s]."""


LIMB_REPAIR_DEFAULTS = LimbRepairSettings()
"""Default settings of the search for lost limbs."""
SCENES_KEPT = 400
"""Number of frames whose images and ratios are kept in memory while a limb is searched; 0.5 MB each."""


def searches(
    frames: Sequence[int], rate: float, settings: LimbRepairSettings = LIMB_REPAIR_DEFAULTS, *,
    only: Collection[str] = placements.SEARCHED_LIMBS,
) -> int:  # fmt: skip
    """Return the number of searches in a motion, for its progress."""
    return len(only) * len(_searched_frames(frames, rate, settings))


def uncertain_limbs(found: OtherPostures) -> tuple[str, ...]:
    """Return the limbs that a next search may place differently.

    These are the limbs that a search has replaced or left uncertain, and their opposites, which have the same colours.
    """
    kinds = {other.name.split()[-1] for other in (*found.replaced, *found.alternatives)}
    return tuple(name for name in placements.SEARCHED_LIMBS if name.split("_")[-1] in kinds)


def repaired_limbs(
    search: RegionSearch, images_of: ImagesOf, body: Body, poses: Mapping[int, Pose], rate: float,
    settings: LimbRepairSettings = LIMB_REPAIR_DEFAULTS, *, only: Collection[str] = placements.SEARCHED_LIMBS,
    progress: FrameProgress = no_progress,
) -> OtherPostures:  # fmt: skip
    """Search each limb along a refined motion by the colours of the parts, and replace it where it was lost.

    Silhouettes are drawn to the body; therefore they do not show a limb that the motion has lost. The colours of the
    limb on the other side of the body do: the limb's own may be those of what it was confused with.

    Args:
        search: The score, with the cameras of the reduced images.
        images_of: Returns the classes of the pixels of a frame.
        body: The body, with few vertices.
        poses: The poses by frame.
        rate: Frame rate [Hz].
        settings: Settings of the search.
        only: Names of the limbs that are searched.
        progress: Called with each frame that was searched, `searches` times.

    Returns:
        The poses, of which only the coordinates of replaced limbs differ; and the other postures of limbs that the
        frames do not exclude.
    """
    result, limbs = dict(poses), placements.limbs_of(body.skeleton)
    alternatives: list[Alternative] = []
    replaced: list[Alternative] = []
    for name in placements.SEARCHED_LIMBS:
        if name in limbs and name in only:
            found = _LimbSearch.of(search, images_of, body, result, limbs[name], rate, settings).decided(progress)
            result |= found.poses
            alternatives += found.alternatives
            replaced += found.replaced
    return OtherPostures(result, alternatives, replaced)


Support = Callable[[int, Pose], float]
"""Returns the log-likelihood of a pose in a frame by what is known beside the colours, except a constant [nat]."""


def undetermined_postures(
    search: RegionSearch, images_of: ImagesOf, body: Body, poses: Mapping[int, Pose], rate: float,
    open_frames: Mapping[str, Sequence[Sequence[int]]], settings: LimbRepairSettings = LIMB_REPAIR_DEFAULTS, *,
    support: Support = lambda frame, pose: 0.0, progress: FrameProgress = no_progress,
) -> list[Alternative]:  # fmt: skip
    """Search other postures of limbs in those frames in which nothing but outlines and colours determines them.

    The given motion is kept. A path through the frames begins and ends with the given posture if there are further
    frames before and after, in which it is determined.

    Args:
        search: The score, with the cameras of the reduced images.
        images_of: Returns the classes of the pixels of a frame.
        body: The body, with few vertices.
        poses: The poses by frame.
        rate: Frame rate [Hz].
        open_frames: Runs of successive frames with a pose, by limb of `SEARCHED_LIMBS`.
        settings: Settings of the search.
        support: What is known beside the colours.
        progress: Called with each frame that was searched.

    Returns:
        The other postures that all paths together make probable.
    """
    found: list[Alternative] = []
    limbs = placements.limbs_of(body.skeleton)
    for name, runs in open_frames.items():
        if name in limbs and runs:
            own = _LimbSearch.of(search, images_of, body, poses, limbs[name], rate, settings)
            for run in runs:
                found += own.possible(run, support, progress)
    return found


def _searched_frames(frames: Sequence[int], rate: float, settings: LimbRepairSettings) -> Sequence[int]:
    every = max(1, round(settings.interval * rate))
    return frames[every // 2 :: every]


@dataclass(frozen=True, eq=False)
class _Scene:
    """A frame in which a limb is searched."""

    images: RegionImages
    table: Floats
    settled: Pose
    """The given pose, improved in the reduced images."""
    score: float
    """Its score [nat m2]."""


@dataclass(frozen=True, eq=False)
class _Posture:
    """A posture of a limb in one frame."""

    pose: Pose
    gain: float
    """Gain of the score over that of the given posture [nat m2]."""
    ends: Floats
    """(2, 3) the joints beyond the limb's first segment [m]."""

    def away(self, other: "_Posture") -> float:
        """Return the mean distance of the limb's joints from those of another posture [m]."""
        return float(np.linalg.norm(self.ends - other.ends, axis=1).mean())


@dataclass(frozen=True, eq=False)
class _LimbSearch:
    """The search for one limb along a motion."""

    search: RegionSearch
    body: Body
    limb: LimbCoordinates
    rate: float
    settings: LimbRepairSettings
    poses: Mapping[int, Pose]
    scene: Callable[[int], _Scene]
    """Returns the frame of a number, from a limited store."""

    @classmethod
    def of(
        cls, search: RegionSearch, images_of: ImagesOf, body: Body, poses: Mapping[int, Pose], limb: LimbCoordinates,
        rate: float, settings: LimbRepairSettings,
    ) -> "_LimbSearch":  # fmt: skip
        """Learn the colours of the parts without those of the limb."""
        given = dict(poses)

        def areas(frame: int) -> Floats:
            return np.asarray(search.areas(body, [given[frame]], images_of(frame), without=limb.segments)[0])

        learned = reduce(np.add, map_in_threads(areas, list(given)[:: settings.learned_every]))

        @lru_cache(maxsize=SCENES_KEPT)
        def scene(frame: int) -> _Scene:
            images, posed = images_of(frame), PosedBody(body, given[frame])
            table = search.word_table(learned, posed, images, whole_share=settings.whole_share)
            near = NearAngles(given[frame].angles, np.full(len(given[frame].angles), settings.settle_spread))
            _, settled = search.fit(posed, images, table, near, reaches=settings.settle_reaches)
            score = float(search.scores(body, [settled], images, table)[0])
            return _Scene(images, table, settled, score)

        return cls(search, body, limb, rate, settings, given, scene)

    def postures(self, frames: Sequence[int], progress: FrameProgress) -> dict[int, list[_Posture]]:
        """Return the given posture and others of successive frames."""

        def searched(frame: int) -> list[_Posture]:
            found = self.searched(frame)
            progress(frame)
            return found

        starts = _searched_frames(frames, self.rate, self.settings)
        seeds = dict(zip(starts, map_in_threads(searched, starts), strict=True))
        sweeps = map_in_threads(lambda order: self.followed(seeds, order), (frames, frames[::-1]))
        others = self.joined(seeds, *sweeps)
        return {frame: [self.settled(frame), *others.get(frame, [])] for frame in frames}

    def decided(self, progress: FrameProgress) -> OtherPostures:
        """Return the poses of the frames in which the limb was lost, and the postures that remain possible."""
        frames = list(self.poses)
        postures = self.postures(frames, progress)
        paths = self.paths(list(postures.values()))
        best, probabilities = paths.best(), dict(zip(frames, paths.probabilities(), strict=True))
        chosen = {frame: postures[frame][i] for frame, i in zip(frames, best, strict=True)}
        lost = [f for f in frames if chosen[f].away(postures[f][0]) >= self.settings.least_distance]
        former = {frame: (self.poses[frame], float(probabilities[frame][0])) for frame in lost}
        possible: dict[int, tuple[Pose, float]] = {}
        for frame in frames:
            now = chosen[frame] if frame in former else postures[frame][0]
            rest = self.most_probable_beside(now, postures[frame], probabilities[frame])
            possible |= {} if rest is None else {frame: rest}
        return OtherPostures(
            {frame: self.with_limb_of(self.poses[frame], chosen[frame].pose) for frame in lost},
            self.alternatives(possible, frames), self.alternatives(former, frames),
        )  # fmt: skip

    def possible(self, run: Sequence[int], support: Support, progress: FrameProgress) -> list[Alternative]:
        """Return other postures in successive frames between which and the given ones nothing else decides."""
        inner = self.postures(run, progress)
        beside = [frame for frame in (run[0] - 1, run[-1] + 1) if frame in self.poses]
        postures = dict(sorted((inner | {frame: [self.settled(frame)] for frame in beside}).items()))
        known = [np.array([support(f, each.pose) for each in own]) for f, own in postures.items()]
        paths = self.paths(list(postures.values()), known)
        probabilities = dict(zip(postures, paths.probabilities(), strict=True))
        rest = {f: self.most_probable_beside(inner[f][0], inner[f], probabilities[f]) for f in run}
        return self.alternatives({f: other for f, other in rest.items() if other is not None}, run)

    def settled(self, frame: int) -> _Posture:
        """Return the given posture, improved in the reduced images."""
        return _Posture(self.scene(frame).settled, 0.0, self.ends(self.scene(frame).settled))

    def ends(self, pose: Pose) -> Floats:
        """Return the two joints (2, 3) beyond the limb's first segment [m]."""
        posed, skeleton = PosedBody(self.body, pose), self.body.skeleton
        return np.asarray(posed.segment_origin[[skeleton.segment(name) for name in self.limb.segments[1:3]]])

    def with_limb_of(self, pose: Pose, other: Pose) -> Pose:
        """Return a pose with the limb's coordinates of another one."""
        angles = np.array(pose.angles)
        angles[self.limb.columns] = other.angles[self.limb.columns]
        return replace(pose, angles=angles)

    def searched(self, frame: int) -> list[_Posture]:
        """Return the best postures of a frame in all directions that are neither the given one nor alike."""
        settings, scene, found = self.settings, self.scene(frame), [self.settled(frame)]
        posed = PosedBody(self.body, scene.settled)
        tries, scores = self.search.limb_tries(
            posed, scene.images, scene.table, directions=settings.directions, limb=self.limb
        )
        for i in np.argsort(-scores):
            pose = replace(scene.settled, angles=tries[i])
            placed = _Posture(pose, float(scores[i]) - scene.score, self.ends(pose))
            if all(placed.away(other) >= settings.least_distance for other in found):
                found.append(placed)
            if len(found) > settings.tried:
                break
        improved = [self.improved(frame, placed.pose, settings.search_steps) for placed in found[1:]]
        return [each for each in improved if self.is_other(frame, each)]

    def improved(self, frame: int, moved: Pose, steps: Sequence[float]) -> _Posture:
        """Improve a posture of the limb in a frame by changes of given sizes [rad]."""
        scene = self.scene(frame)
        tried = PosedBody(self.body, self.with_limb_of(scene.settled, moved))
        score, pose = self.search.climb(tried, scene.images, scene.table, steps, 6 + self.limb.columns)
        return _Posture(pose, score - scene.score, self.ends(pose))

    def is_other(self, frame: int, posture: _Posture) -> bool:
        """Return whether a posture is not much worse than the given one, and another one."""
        settings = self.settings
        return posture.gain >= settings.least_gain and posture.away(self.settled(frame)) >= settings.alike

    def followed(self, seeds: Mapping[int, Sequence[_Posture]], order: Sequence[int]) -> dict[int, list[_Posture]]:
        """Follow postures from the frames where they were found along frames in one direction.

        Args:
            seeds: The postures by frame.
            order: The frames.

        Returns:
            The followed postures by frame.
        """
        longest, steps = max(1, round(self.settings.followed * self.rate)), self.settings.follow_steps
        swept: dict[int, list[_Posture]] = {}
        carried: list[tuple[_Posture, int]] = []
        for frame in order:
            moved = [(self.improved(frame, posture.pose, steps), left - 1) for posture, left in carried if left > 0]
            kept = [(seed, longest) for seed in seeds.get(frame, ())]
            for posture, left in moved:
                if self.is_other(frame, posture) and not self.is_known(posture, [each for each, _ in kept]):
                    kept.append((posture, left))
            swept[frame] = [posture for posture, _ in kept]
            carried = kept
        return swept

    def is_known(self, posture: _Posture, others: Sequence[_Posture]) -> bool:
        """Return whether a posture is like one of some others."""
        return any(posture.away(other) < self.settings.alike for other in others)

    def joined(self, *found: Mapping[int, Sequence[_Posture]]) -> dict[int, list[_Posture]]:
        """Return the postures of several searches by frame; of those that are alike, the one with the best score."""
        result: dict[int, list[_Posture]] = {}
        for frame in {frame for each in found for frame in each}:
            every = [posture for each in found for posture in each.get(frame, ())]
            kept = result.setdefault(frame, [])
            for posture in sorted(every, key=lambda each: -each.gain):
                if not self.is_known(posture, kept):
                    kept.append(posture)
        return result

    def paths(self, postures: Sequence[Sequence[_Posture]], known: Sequence[Floats] | None = None) -> PosturePaths:
        """Return all paths through the postures of successive frames; log-likelihoods of these may be known beside."""
        weight = self.settings.evidence / self.rate
        known = known or [np.zeros(len(own)) for own in postures]
        ends = [np.array([posture.ends for posture in own]) for own in postures]
        lengths = [np.linalg.norm(own[:, None] - after, axis=-1).mean(axis=-1) for own, after in pairwise(ends)]
        return PosturePaths(
            [
                weight * np.array([posture.gain for posture in own]) + more
                for own, more in zip(postures, known, strict=True)
            ],
            [-length / self.settings.usual_path for length in lengths],
        )

    def most_probable_beside(
        self, chosen: _Posture, postures: Sequence[_Posture], probabilities: Floats
    ) -> tuple[Pose, float] | None:
        """Return the most probable posture far from the chosen one, with its probability; None if none is possible."""
        far = [i for i, each in enumerate(postures) if each.away(chosen) >= self.settings.least_distance]
        best = max(far, key=lambda i: float(probabilities[i]), default=None)
        if best is None or probabilities[best] < self.settings.possible:
            return None
        return postures[best].pose, float(probabilities[best])

    def alternatives(self, found: Mapping[int, tuple[Pose, float]], frames: Sequence[int]) -> list[Alternative]:
        """Return postures with probabilities by frame as one alternative for each run of frames."""
        longest, place = max(1, round(self.settings.joined * self.rate)), {f: i for i, f in enumerate(frames)}
        runs: list[list[int]] = []
        for frame in found:
            if runs and place[frame] - place[runs[-1][-1]] <= longest:
                runs[-1].append(frame)
            else:
                runs.append([frame])
        return [
            Alternative(
                self.limb.name.replace("_", " "), 6 + self.limb.columns, {frame: found[frame][0] for frame in run},
                float(np.mean([found[frame][1] for frame in run])),
            )
            for run in runs
        ]  # fmt: skip
