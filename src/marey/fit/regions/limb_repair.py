"""Lost limbs of a refined motion, found again by the colours of the parts."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, reduce

import numpy as np

from marey.arrays import Floats, Integers
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.surface import Body
from marey.fit.progress import FrameProgress, no_progress
from marey.fit.regions.region_search import RegionImages, RegionSearch
from marey.fit.regions.region_track import ImagesOf
from marey.fit.search import placements
from marey.fit.search.placements import LimbCoordinates
from marey.fit.solver.threads import map_in_threads


@dataclass(frozen=True, kw_only=True)
class LimbRepairSettings:
    """Settings of the search for lost limbs.

    Fields without a source were chosen by hand; results were not measured against other values.
    """

    directions: int = 150
    """Number of directions in which a limb is searched. In nine frames of `market` with a lost limb, 150 find six of
    them, 80 five, and 60 two."""
    every: int = 3
    """Every how many frames the limbs are searched; what is found is then followed into the frames beside."""
    learned_every: int = 3
    """Every how many frames the colours of the parts are learned from."""
    whole_share: float = 0.05
    """Share of the words of the whole body in the density of a part."""
    settle_steps: tuple[float, ...] = (0.03, 0.02)
    """Changes of an angle with which the given pose is improved before it is compared [rad]."""
    search_steps: tuple[float, ...] = (0.1, 0.06, 0.03, 0.02)
    """Changes of an angle with which a searched limb is improved [rad]."""
    least_gain: float = 0.02
    """Least gain of the score in one frame from which a run of frames starts [nat m2]."""
    run_gain: float = 0.3
    """Least sum of the gains of successive frames in which a limb is replaced [nat m2]. In results of `office` and
    `market` after different rounds, the 13 replaced pieces have sums of 0.42 to 2.88, and all come nearer to the truth;
    in `jacks`, where no limb is lost, there is none."""
    run_drop: float = 0.3
    """Decrease of the sum of the gains, from its largest value, at which a run is followed no farther [nat m2]. In
    `office`, the errors are 36.9 mm with 0.15, and 35.9 mm with 0.3 and 0.5."""
    least_distance: float = 0.08
    """Least mean distance of the limb's joints from the given ones where it is replaced [m]: smaller differences are
    left to the outlines, which are more accurate. With 0.06, the errors in `market` are 11.7 instead of 10.8 mm."""


LIMB_REPAIR_DEFAULTS = LimbRepairSettings()
"""Default settings of the search for lost limbs."""
SCENES_KEPT = 400
"""Number of frames whose images and ratios are kept in memory while a limb is searched; 0.5 MB each."""


def searches(frames: Sequence[int], settings: LimbRepairSettings = LIMB_REPAIR_DEFAULTS) -> int:
    """Return the number of searches in a motion, for its progress."""
    return len(placements.SEARCHED_LIMBS) * len(_starts(frames, settings))


def repaired_limbs(
    search: RegionSearch, images_of: ImagesOf, body: Body, poses: Mapping[int, Pose],
    settings: LimbRepairSettings = LIMB_REPAIR_DEFAULTS, *, progress: FrameProgress = no_progress,
) -> dict[int, Pose]:  # fmt: skip
    """Search each limb along a refined motion by the colours of the parts, and replace it where it was lost.

    Silhouettes are drawn to the body; therefore they do not show a limb that the motion has lost. The colours of the
    limb on the other side of the body do: the limb's own may be those of what it was confused with. A limb that is
    found in one frame is followed into the frames beside it, and the sum of the gains along the run decides, because
    the gain in a single frame is often small.

    Args:
        search: The score, with the cameras of the reduced images.
        images_of: Returns the classes of the pixels of a frame.
        body: The body, with few vertices.
        poses: The poses by frame.
        settings: Settings of the search.
        progress: Called with each frame that was searched, `searches` times.

    Returns:
        The poses; of a repaired limb, only its own coordinates differ.
    """
    result, limbs = dict(poses), placements.limbs_of(body.skeleton)
    for name in placements.SEARCHED_LIMBS:
        if name in limbs:
            found = _LimbSearch.of(search, images_of, body, dict(result), limbs[name], settings).replaced(progress)
            result |= {frame: _with_columns(result[frame], pose, limbs[name].columns) for frame, pose in found.items()}
    return result


def _starts(frames: Sequence[int], settings: LimbRepairSettings) -> Sequence[int]:
    return frames[settings.every // 2 :: settings.every]


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
class _Alternative:
    """Another posture of a limb in one frame."""

    pose: Pose
    gain: float
    """Gain of the score over that of the given posture [nat m2]."""
    distance: float
    """Mean distance of the limb's joints from those of the given posture [m]."""


@dataclass(frozen=True, eq=False)
class _LimbSearch:
    """The search for one limb along a motion."""

    search: RegionSearch
    body: Body
    limb: LimbCoordinates
    settings: LimbRepairSettings
    frames: Sequence[int]
    scene: Callable[[int], _Scene]
    """Returns the frame of a number, from a limited store."""

    @classmethod
    def of(
        cls, search: RegionSearch, images_of: ImagesOf, body: Body, poses: Mapping[int, Pose], limb: LimbCoordinates,
        settings: LimbRepairSettings,
    ) -> "_LimbSearch":  # fmt: skip
        """Learn the colours of the parts without those of the limb."""

        def areas(frame: int) -> Floats:
            return np.asarray(search.areas(body, [poses[frame]], images_of(frame), without=limb.segments)[0])

        learned = reduce(np.add, map_in_threads(areas, list(poses)[:: settings.learned_every]))

        @lru_cache(maxsize=SCENES_KEPT)
        def scene(frame: int) -> _Scene:
            images, posed = images_of(frame), PosedBody(body, poses[frame])
            table = search.word_table(learned, posed, images, whole_share=settings.whole_share)
            score, settled = search.climb(posed, images, table, settings.settle_steps)
            return _Scene(images, table, settled, score)

        return cls(search, body, limb, settings, list(poses), scene)

    def replaced(self, progress: FrameProgress) -> dict[int, Pose]:
        """Return the poses of the frames in which the limb was lost."""

        def searched(frame: int) -> _Alternative:
            found = self.searched(frame)
            progress(frame)
            return found

        settings, starts = self.settings, _starts(self.frames, self.settings)
        found = dict(zip(starts, map_in_threads(searched, starts), strict=True))
        good = [frame for frame, each in found.items() if self.is_start(each)]
        runs = list(map_in_threads(lambda frame: self.run(frame, found[frame]), good))
        pieces = [piece for run in runs for piece in self.pieces(run)]
        result: dict[int, Pose] = {}
        for piece in sorted(pieces, key=_total_gain, reverse=True):
            rest = {frame: each for frame, each in piece.items() if frame not in result}
            if _total_gain(rest) >= settings.run_gain:
                result |= {frame: each.pose for frame, each in rest.items()}
        return result

    def pieces(self, run: Mapping[int, _Alternative]) -> list[dict[int, _Alternative]]:
        """Return the parts of a run in whose frames, one after the other, the limb is far from the given posture."""
        parts: list[dict[int, _Alternative]] = [{}]
        for frame in sorted(run):
            if run[frame].distance >= self.settings.least_distance:
                parts[-1][frame] = run[frame]
            elif parts[-1]:
                parts.append({})
        return parts

    def is_start(self, found: _Alternative) -> bool:
        """Return whether a run may start from what was found in a frame."""
        return found.gain > self.settings.least_gain and found.distance > self.settings.least_distance

    def searched(self, frame: int) -> _Alternative:
        """Search the limb in all directions."""
        scene = self.scene(frame)
        posed = PosedBody(self.body, scene.settled)
        directions = self.settings.directions
        moved = self.search.limbs(posed, scene.images, scene.table, directions=directions, only=(self.limb.name,))
        return self.improved(frame, moved)

    def improved(self, frame: int, moved: Pose) -> _Alternative:
        """Improve a posture of the limb in a frame."""
        scene, columns = self.scene(frame), self.limb.columns
        tried = PosedBody(self.body, _with_columns(scene.settled, moved, columns))
        steps, coordinates = self.settings.search_steps, 6 + columns
        score, pose = self.search.climb(tried, scene.images, scene.table, steps, coordinates=coordinates)
        away = self._ends(pose) - self._ends(scene.settled)
        return _Alternative(pose, score - scene.score, float(np.linalg.norm(away, axis=1).mean()))

    def _ends(self, pose: Pose) -> Floats:
        """Return the two joints (2, 3) beyond the limb's first segment [m]."""
        posed, skeleton = PosedBody(self.body, pose), self.body.skeleton
        return np.asarray(posed.segment_origin[[skeleton.segment(name) for name in self.limb.segments[1:3]]])

    def run(self, start: int, found: _Alternative) -> dict[int, _Alternative]:
        """Follow a posture of the limb into the frames before and after, as far as the sum of the gains grows."""
        run, place = {start: found}, self.frames.index(start)
        for frames in (self.frames[place + 1 :], self.frames[:place][::-1]):
            last, total, largest = found, 0.0, 0.0
            beyond: dict[int, _Alternative] = {}
            for frame in frames:
                last = self.improved(frame, last.pose)
                beyond[frame] = last
                total += last.gain
                if total > largest:
                    largest = total
                    run |= beyond
                    beyond = {}
                if total < largest - self.settings.run_drop:
                    break
        return run


def _total_gain(run: Mapping[int, _Alternative]) -> float:
    return sum(each.gain for each in run.values())


def _with_columns(pose: Pose, other: Pose, columns: Integers) -> Pose:
    """Return a pose with some joint coordinates of another one."""
    angles = np.array(pose.angles)
    angles[columns] = other.angles[columns]
    return replace(pose, angles=angles)
