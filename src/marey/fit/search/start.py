"""The start without clicks: the pose and the rough shape of a person in one frame, whatever the posture."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from marey.arrays import Floats, Mask
from marey.body.articulation.surface import Body
from marey.cameras.camera import Camera
from marey.fit.search.hull import visual_hull
from marey.fit.search.levels import Level, level_factor
from marey.fit.search.search import Candidate, Search, StartSettings, about_face, standing_ways
from marey.fit.solver.side_by_side import side_by_side


def find_start(
    cameras: Sequence[Camera], masks: Sequence[Mask], coarse: Body, fine: Body, settings: StartSettings | None = None
) -> Candidate | None:
    """Find a person's pose and rough shape from the silhouettes of one frame.

    Ours: many coarse poses are compared with the silhouettes, the best are fitted, each limb is
    searched on its own, and at last the winner is compared with itself facing the other way.

    Args:
        cameras: those that see the person.
        masks: (height, width) one a camera.
        coarse: the body with few vertices, at its prior's mean.
        fine: the same body with more vertices.
        settings: how thorough the search is.

    Returns:
        The best candidate with the fine body, or None where the silhouettes have nothing in common.
    """
    settings = settings or StartSettings()
    hull = visual_hull(cameras, masks)
    if len(hull) == 0:
        return None
    found = _search(cameras, masks, hull, coarse, fine, settings, standing_ways(hull))
    if found.score >= settings.doubtful:
        return found
    # Nobody explains the silhouettes well: perhaps the person hangs, or the world stands on its head.
    hanging = _search(cameras, masks, hull, coarse, fine, settings, [np.diag([1.0, -1.0, -1.0])])
    return max(found, hanging, key=lambda candidate: candidate.score)


def _search(
    cameras: Sequence[Camera], masks: Sequence[Mask], hull: Floats, coarse: Body, fine: Body,
    settings: StartSettings, ways: Sequence[Floats],
) -> Candidate:  # fmt: skip
    """Search among bodies that stand in the given ways, see `standing_ways`."""
    rough = Level.of(cameras, masks, level_factor(masks, settings.coarse_height))
    medium = Level.of(cameras, masks, level_factor(masks, settings.fine_height))
    search = Search(rough, settings)
    first = search.coarse_poses(coarse, hull, ways)
    fitted = list(side_by_side(lambda posed: search.fit(posed, numbers=3, iterations=10, gate=(25.0, 8.0)), first))
    kept = _best(fitted, settings.kept, apart=2)
    searched = list(side_by_side(lambda candidate: search.limbs(candidate, numbers=4), kept))
    return _finish(searched, rough, medium, fine, settings)


def _finish(searched: list[Candidate], rough: Level, medium: Level, fine: Body, settings: StartSettings) -> Candidate:
    search, last = Search(rough, settings), Search(medium, settings)

    def polish(candidate: Candidate) -> Candidate:
        for _ in range(2):
            candidate = search.limbs(candidate, numbers=6)
        posed = replace(candidate.posed, body=_on(candidate.posed.body, fine))
        return last.fit(posed, numbers=8, iterations=12, gate=(16.0, 5.0))

    polished = list(side_by_side(polish, _best(searched, settings.finalists, apart=2)))
    winner = max(polished, key=lambda candidate: candidate.score)
    turned = polish(
        search.judge(
            replace(winner.posed, body=_on(winner.posed.body, searched[0].posed.body), pose=about_face(winner.posed))
        )
    )
    return max(winner, turned, key=lambda candidate: candidate.score)


def _on(body: Body, other: Body) -> Body:
    """Give another level's body the shape numbers of this one."""
    return other.with_numbers(body.numbers)


def _best(candidates: list[Candidate], count: int, *, apart: int) -> list[Candidate]:
    """Keep the best candidates, at most so many that face the same way (within an eighth of a turn)."""
    kept: list[Candidate] = []
    for candidate in sorted(candidates, key=lambda c: -c.score):
        facing = candidate.posed.pose.rotation[:, 1]
        alike = sum(float(facing @ other.posed.pose.rotation[:, 1]) > np.cos(np.pi / 8) for other in kept)
        if alike < apart:
            kept.append(candidate)
        if len(kept) == count:
            break
    return kept
