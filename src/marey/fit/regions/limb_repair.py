"""Lost limbs of a refined motion, found again by the colours of the parts."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Floats, Integers
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.surface import Body
from marey.fit.progress import FrameProgress, no_progress
from marey.fit.regions.region_search import RegionImages, RegionSearch, learned_areas
from marey.fit.regions.region_track import ImagesOf
from marey.fit.search import placements
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
    """Every how many frames the limbs are searched; a repaired limb is then carried into the frames beside."""
    learned_every: int = 3
    """Every how many frames the colours of the parts are learned from."""
    whole_share: float = 0.05
    """Share of the words of the whole body in the density of a part."""
    settle_steps: tuple[float, ...] = (0.03, 0.02)
    """Changes of an angle with which the given pose is improved before it is compared [rad]."""
    search_steps: tuple[float, ...] = (0.1, 0.06, 0.03, 0.02)
    """Changes of an angle with which a searched limb is improved [rad]."""
    gain: float = 0.1
    """Least gain of the score for which a searched limb replaces the given one [nat m2]. In `market`, where 16 of 33
    frames have a lost limb, the gain is 0.07 to 0.56."""


SEARCHED_TOGETHER = (
    ("left_arm",), ("right_arm",), ("left_leg",), ("right_leg",), ("left_leg", "right_leg", "left_leg"),
    ("left_arm", "right_arm", "left_arm"),
)  # fmt: skip
"""Limbs that are searched together, one after the other: each alone, and pairs that may have been exchanged, the first
once more when the second has moved away."""
LIMB_REPAIR_DEFAULTS = LimbRepairSettings()
"""Default settings of the search for lost limbs."""


def repaired_limbs(
    search: RegionSearch, images_of: ImagesOf, body: Body, poses: Mapping[int, Pose],
    settings: LimbRepairSettings = LIMB_REPAIR_DEFAULTS, *, progress: FrameProgress = no_progress,
) -> dict[int, Pose]:  # fmt: skip
    """Search each limb in every frame, with the colours that a refined motion has learned, and replace the lost ones.

    Silhouettes are drawn to the body; therefore they do not show a limb that the motion has lost. The colours of its
    other frames do.

    Args:
        search: The score, with the cameras of the reduced images.
        images_of: Returns the classes of the pixels of a frame.
        body: The body, with few vertices.
        poses: The poses by frame.
        settings: Settings of the search.
        progress: Called with each frame that was searched.

    Returns:
        The poses; of a repaired limb, only its own coordinates differ.
    """
    some = list(poses)[:: settings.learned_every]
    areas = learned_areas(search, body, {f: poses[f] for f in some}, {f: images_of(f) for f in some})
    learned = np.sum(list(areas.values()), axis=0)
    frames, result = list(poses), dict(poses)

    def scene(frame: int) -> _Scene:
        images = images_of(frame)
        table = search.word_table(
            learned, PosedBody(body, poses[frame]), images, whole_share=settings.whole_share
        )  # fmt: skip
        score, settled = search.climb(PosedBody(body, result[frame]), images, table, settings.settle_steps)
        return _Scene(search, body, images, table, settings, result[frame], settled, score)

    def searched(frame: int) -> tuple[_Scene, list[tuple[str, ...]]]:
        found = _searched(scene(frame))
        progress(frame)
        return found

    starts = frames[settings.every // 2 :: settings.every]
    for start, (found, limbs) in zip(starts, map_in_threads(searched, starts), strict=True):
        result[start] = found.pose if limbs else result[start]
        for names in limbs:
            for step in (1, -1):
                _carry(result, frames, start, step, names, scene)
    return result


@dataclass(frozen=True, eq=False)
class _Scene:
    """A frame whose limbs are searched."""

    search: RegionSearch
    body: Body
    images: RegionImages
    table: Floats
    settings: LimbRepairSettings
    pose: Pose
    """The pose, of which only the coordinates of repaired limbs change."""
    settled: Pose
    """The pose, improved in the reduced images."""
    score: float
    """Its score [nat m2]."""

    def columns(self, names: Sequence[str]) -> Integers:
        """Return the joint coordinates of limbs."""
        limbs = placements.limbs_of(self.body.skeleton)
        own = [limbs[name].columns for name in names if name in limbs]
        return np.unique(np.concatenate(own)) if own else np.zeros(0, np.int64)

    def with_limbs(self, names: Sequence[str], moved: Pose) -> "_Scene | None":
        """Return the frame with limbs as in another pose, improved; None if the score does not gain enough."""
        columns, settings = self.columns(names), self.settings
        tried = _with_columns(self.settled, moved, columns)
        score, improved = self.search.climb(
            PosedBody(self.body, tried), self.images, self.table, settings.search_steps, coordinates=6 + columns
        )  # fmt: skip
        if score <= self.score + settings.gain:
            return None
        return replace(self, pose=_with_columns(self.pose, improved, columns), settled=improved, score=score)


def _with_columns(pose: Pose, other: Pose, columns: Integers) -> Pose:
    """Return a pose with some joint coordinates of another one."""
    angles = np.array(pose.angles)
    angles[columns] = other.angles[columns]
    return replace(pose, angles=angles)


def _searched(scene: _Scene) -> tuple[_Scene, list[tuple[str, ...]]]:
    """Search the limbs of a frame; return it with the repaired ones, and their names."""
    repaired: list[tuple[str, ...]] = []
    for names in SEARCHED_TOGETHER:
        if not len(scene.columns(names)):
            continue
        posed = PosedBody(scene.body, scene.settled)
        moved = scene.search.limbs(
            posed, scene.images, scene.table, directions=scene.settings.directions, only=names
        )  # fmt: skip
        found = scene.with_limbs(names, moved)
        if found is not None:
            scene = found
            repaired.append(names)
    return scene, repaired


def _carry(
    poses: dict[int, Pose], frames: Sequence[int], start: int, step: int, names: Sequence[str],
    scene: Callable[[int], _Scene],
) -> None:  # fmt: skip
    """Carry repaired limbs of a frame into those before or after it, as long as their scores gain."""
    place = frames.index(start)
    for frame in frames[place + 1 :] if step > 0 else frames[:place][::-1]:
        found = scene(frame).with_limbs(names, poses[frames[frames.index(frame) - step]])
        if found is None:
            return
        poses[frame] = found.pose
