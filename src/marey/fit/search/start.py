"""Search for the pose and rough shape of a person in one frame, in any posture, without clicked points."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from marey.arrays import Floats, Mask
from marey.body.articulation.surface import Body
from marey.cameras.camera import Camera
from marey.fit.search.hull import visual_hull
from marey.fit.search.levels import SilhouetteLevel, level_factor
from marey.fit.search.search import Candidate, Search, StartSettings, standing_ways, turned_about
from marey.fit.solver.processes import map_in_processes


def find_start(
    cameras: Sequence[Camera], masks: Sequence[Mask], coarse: Body, fine: Body, settings: StartSettings | None = None
) -> Candidate | None:
    """Find a person's pose and rough shape from the silhouettes of one frame.

    The arguments are those of `find_both_ways`.

    Returns:
        The best candidate with the fine body, or None if the silhouettes have no point in common.
    """
    found = find_both_ways(cameras, masks, coarse, fine, settings)
    return found[0] if found else None


def find_both_ways(
    cameras: Sequence[Camera], masks: Sequence[Mask], coarse: Body, fine: Body, settings: StartSettings | None = None
) -> list[Candidate]:
    """Find a person's pose and rough shape from the silhouettes of one frame, and the best one facing the other way.

    Ours: many coarse poses are compared with the silhouettes, the best are fitted, each limb is searched on its own,
    and at last the winner is compared with itself facing the other way.

    Args:
        cameras: Cameras with the person in view.
        masks: (height, width) one per camera.
        coarse: Body with few vertices, at its prior's mean.
        fine: The same body with more vertices.
        settings: Extent of the search.

    Returns:
        The best candidate with the fine body, and the best one of those that face away from its direction, if there is
        one; nothing if the silhouettes have no point in common.
    """
    settings = settings or StartSettings()
    hull = visual_hull(cameras, masks)
    if len(hull) == 0:
        return []
    found = _search(cameras, masks, hull, coarse, fine, settings, standing_ways(hull))
    if found[0].score >= settings.upside_down_below:
        return found
    # No candidate agrees well: the person may hang head down, or the world's Z axis may point down.
    hanging = _search(cameras, masks, hull, coarse, fine, settings, [np.diag([1.0, -1.0, -1.0])])
    return max(found, hanging, key=lambda candidates: candidates[0].score)


def _search(
    cameras: Sequence[Camera], masks: Sequence[Mask], hull: Floats, coarse: Body, fine: Body,
    settings: StartSettings, ways: Sequence[Floats],
) -> list[Candidate]:  # fmt: skip
    """Search among bodies that stand in the given directions, see `standing_ways`."""
    rough = SilhouetteLevel.of(cameras, masks, level_factor(masks, settings.coarse_height))
    medium = SilhouetteLevel.of(cameras, masks, level_factor(masks, settings.fine_height))
    search = Search(rough, settings)
    first = search.coarse_poses(coarse, hull, ways)
    fitted = list(map_in_processes(lambda posed: search.fit(posed, numbers=3, iterations=10, gate=(25.0, 8.0)), first))
    kept = _best(fitted, settings.kept, apart=2)
    searched = list(map_in_processes(lambda candidate: search.limbs(candidate, numbers=4), kept))
    return _finish(searched, rough, medium, fine, settings)


def _finish(
    searched: list[Candidate], rough: SilhouetteLevel, medium: SilhouetteLevel, fine: Body, settings: StartSettings
) -> list[Candidate]:
    search, last = Search(rough, settings), Search(medium, settings)

    def polish(candidate: Candidate) -> Candidate:
        candidate = search.limbs(candidate, numbers=6, passes=2)
        posed = replace(candidate.posed, body=_with_numbers_of(candidate.posed.body, fine))
        return last.fit(posed, numbers=8, iterations=12, gate=(16.0, 5.0))

    polished = list(map_in_processes(polish, _best(searched, settings.finalists, apart=2)))
    winner = max(polished, key=lambda candidate: candidate.score)
    turned = polish(
        search.judge(
            replace(
                winner.posed,
                body=_with_numbers_of(winner.posed.body, searched[0].posed.body),
                pose=turned_about(winner.posed),
            )
        )
    )
    ranked = sorted([*polished, turned], key=lambda candidate: -candidate.score)
    facing = ranked[0].posed.pose.rotation[:, 1]
    return [ranked[0], *[other for other in ranked if facing @ other.posed.pose.rotation[:, 1] < 0.0][:1]]


def _with_numbers_of(body: Body, other: Body) -> Body:
    """Return the other body, of another level of detail, with the shape parameters of the first one."""
    return other.with_numbers(body.numbers)


def _best(candidates: list[Candidate], count: int, *, apart: int) -> list[Candidate]:
    """Return the best candidates, at most `apart` of which face the same way (within an eighth of a turn)."""
    kept: list[Candidate] = []
    for candidate in sorted(candidates, key=lambda c: -c.score):
        facing = candidate.posed.pose.rotation[:, 1]
        alike = sum(float(facing @ other.posed.pose.rotation[:, 1]) > np.cos(np.pi / 8) for other in kept)
        if alike < apart:
            kept.append(candidate)
        if len(kept) == count:
            break
    return kept
