"""Lost limbs of a refined motion, found again by the colours of the parts."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Floats
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

    directions: int = 60
    """Number of directions in which a limb is searched."""
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

    def repaired(frame: int) -> Pose:
        posed, images = PosedBody(body, poses[frame]), images_of(frame)
        table = search.word_table(learned, posed, images, whole_share=settings.whole_share)
        found = _repaired(search, posed, images, table, settings)
        progress(frame)
        return found

    return dict(zip(poses, map_in_threads(repaired, list(poses)), strict=True))


def _repaired(
    search: RegionSearch, posed: PosedBody, images: RegionImages, table: Floats, settings: LimbRepairSettings
) -> Pose:
    pose, limbs = posed.pose, placements.limbs_of(posed.body.skeleton)
    before, settled = search.climb(posed, images, table, settings.settle_steps)
    for names in SEARCHED_TOGETHER:
        own = [limbs[name].columns for name in names if name in limbs]
        if not own:
            continue
        columns = np.unique(np.concatenate(own))
        moved = search.limbs(replace(posed, pose=settled), images, table, directions=settings.directions, only=names)
        after, improved = search.climb(
            replace(posed, pose=moved), images, table, settings.search_steps, coordinates=6 + columns
        )  # fmt: skip
        if after > before + settings.gain:
            before, settled = after, improved
            angles = np.array(pose.angles)
            angles[columns] = improved.angles[columns]
            pose = replace(pose, angles=angles)
    return pose
