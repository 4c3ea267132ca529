"""Search for the place of an upright person in a room, by the colours that the cameras have in common there."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from marey.arrays import Floats, frozen
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.surface import Body
from marey.cameras.camera import Camera
from marey.fit.regions.region_search import RegionImages, RegionSearch
from marey.fit.search import placements
from marey.fit.search.hull import room_between
from marey.fit.search.search import limb_directions
from marey.fit.solver.threads import map_in_threads
from marey.geometry import rotations

UP = np.array([0.0, 0.0, 1.0])
"""(3,) the axis of the world that points up."""


@dataclass(frozen=True, kw_only=True)
class PlaceSettings:
    """Settings of the search for places.

    Fields without a source were chosen by hand; results were not measured against other values.
    """

    heights: tuple[float, ...] = (0.2, 1.0, 1.6)
    """Heights above the floor by which it is decided whether a camera has a person in view [m]."""
    in_view: int = 6
    """Least number of these heights in view at a place, added over the cameras; 6 are two cameras with all of them."""
    step: float = 0.2
    """Distance of places [m]. From the measured recipe for rooms without a plate."""
    coarse_step: float = 0.4
    """Distance of places that are tried first, and while the floor's height is searched [m]."""
    promising: float = 0.25
    """Share of the first places about which all others are tried. On four takes, the found places are those of a search
    at all places with 0.15, too; with 0.1, one of 32 differs."""
    height_step: float = 0.2
    """Distance of the floor's heights that are tried [m]."""
    height_frames: int = 8
    """Number of frames in which the floor's height is searched. With four of `jacks`, in two of which the arms are
    raised and in one nobody is present, the floor was found 0.2 m too high, and the person faced the wrong way."""
    height_share: float = 0.4
    """Share of the usual best score of these frames below which one of them is left out: it probably shows nobody. On
    four takes whose first frame is empty, its share is 0.04 to 0.16, that of the others 0.64 or more. With the empty
    frame, the floor of `reach` was found 0.2 m too low, and its joints 111 mm off."""
    below: float = 2.5
    """Largest height of the cameras' common point above the floor [m]; it is at least 0."""
    postures: tuple[int, ...] = (0, 8, 16, 32, 48)
    """Upright postures that are tried, see `whole_postures`: arms hanging, aside, level, overhead and bent."""
    headings: int = 4
    """Number of headings, evenly spaced."""
    speed: float = 4.0
    """Fastest motion of a person that is expected [m/s]."""
    slack: float = 0.3
    """Distance by which two places may lie farther apart [m]."""
    travel_cost: float = 0.3
    """Decrease of the score per distance between places in successive frames [nat m2/m]."""
    other_share: float = 0.95
    """Share of the other cameras' words in the density of a part; the rest are unknown words."""
    least_area: float = 0.02
    """Area that is added to each word of a part, so that rare parts have no sharp density [m2]."""


@dataclass(frozen=True, eq=False)
class _Standing:
    """Upright poses: every posture and heading at every place."""

    places: Floats
    """(N, 2) [m]."""
    poses: tuple[Pose, ...]
    """N times the number of postures and headings."""


def places_in_view(cameras: Sequence[Camera], settings: PlaceSettings, *, step: float, floor: float) -> Floats:
    """Return the places (N, 2) [m] of a regular grid at which two cameras at least have an upright person in view."""
    centre, reach = room_between(cameras)
    axis = np.arange(-reach, reach + step, step)
    grid = np.stack(np.meshgrid(centre[0] + axis, centre[1] + axis, indexing="ij"), axis=-1).reshape(-1, 2)
    seen = np.zeros(len(grid), int)
    for camera in cameras:
        points = [np.column_stack([grid, np.full(len(grid), floor + height)]) for height in settings.heights]
        seen += np.sum([camera.sees(camera.project(own)) for own in points], axis=0)
    return np.asarray(grid[seen >= settings.in_view])


@lru_cache(maxsize=4)
def postures_of(body: Body) -> tuple[Floats, Floats]:
    """Return postures (n, D - 6) [rad], see `whole_postures`, and heights (n,) of the pelvis above the feet [m]."""
    arm, leg = limb_directions(body)
    postures = placements.whole_postures(body.skeleton, arm, leg)
    rest = [PosedBody(body, Pose(np.zeros(3), np.eye(3), angles)) for angles in postures]
    return frozen(postures), frozen([-posed.vertices[:, 2].min() for posed in rest])


def find_places(
    search: RegionSearch, body: Body, images: Sequence[RegionImages], times: Sequence[float],
    settings: PlaceSettings | None = None, floor: float | None = None,
) -> list[Pose] | None:  # fmt: skip
    """Find the upright pose that best agrees with each of some frames, along a path that a person can walk.

    The score of a pose compares the words of each part in one camera with those in the others and with the whole image:
    the right place is the one where all cameras show the same colours, which are rare elsewhere.

    Args:
        search: The score, with the cameras.
        body: A body with few vertices.
        images: The images of N frames.
        times: Their times [s].
        settings: Settings of the search.
        floor: Height of the floor [m]; by default it is searched.

    Returns:
        N poses; None if no two cameras have a person in view at any place.
    """
    settings = settings or PlaceSettings()
    floor = _floor(search, body, images, settings) if floor is None else floor
    if floor is None:
        return None
    standing = _standing(search.cameras, body, settings, settings.step, floor)
    if not standing.poses:
        return None
    each = len(standing.poses) // len(standing.places)
    rough = replace(settings, postures=settings.postures[:2])
    first = _standing(search.cameras, body, rough, settings.coarse_step, floor)

    def scored(own: RegionImages) -> Floats:
        # The scores of all upright poses; those far from the promising places are not computed.
        found = _shared_scores(search, body, first.poses, own, settings).reshape(len(first.places), -1).max(axis=1)
        kept = first.places[np.argsort(-found)[: max(1, int(np.ceil(settings.promising * len(found))))]]
        away = np.linalg.norm(standing.places[:, None] - kept[None], axis=-1).min(axis=1)
        near = np.flatnonzero(away <= settings.coarse_step)
        tried = [pose for place in near for pose in standing.poses[place * each : (place + 1) * each]]
        scores = np.full((len(standing.places), each), -np.inf)
        scores[near] = _shared_scores(search, body, tried, own, settings).reshape(len(near), each)
        return scores

    scores = np.array(list(map_in_threads(scored, images)))
    path = _best_path(standing.places, scores.max(axis=2), times, settings)
    return [standing.poses[place * each + int(scores[k, place].argmax())] for k, place in enumerate(path)]


def _floor(search: RegionSearch, body: Body, images: Sequence[RegionImages], settings: PlaceSettings) -> float | None:
    """Return the height of the floor [m] at which an upright person agrees best with the frames that show one."""
    centre, _ = room_between(search.cameras)
    index = np.unique(np.linspace(0, len(images) - 1, settings.height_frames).astype(int))
    rough = replace(settings, postures=settings.postures[:2], headings=2)
    scores: dict[float, list[float]] = {}

    def score(floor: float) -> None:
        standing = _standing(search.cameras, body, rough, settings.coarse_step, floor)
        if standing.poses:
            found = _scores_of(search, body, standing, [images[i] for i in index], settings)
            scores[floor] = [float(each.max()) for each in found]

    # Every second height first, then those beside the best one.
    for floor in centre[2] - np.arange(0.0, settings.below + settings.height_step, 2 * settings.height_step):
        score(float(floor))
    if not scores:
        return None
    best = best_height(scores, settings.height_share)
    score(best + settings.height_step)
    score(best - settings.height_step)
    return best_height(scores, settings.height_share)


def best_height(scores: Mapping[float, Sequence[float]], share: float) -> float:
    """Return the height with the largest mean score in the frames that show a person.

    Args:
        scores: The scores of some frames at each height.
        share: Share of the median of the frames' best scores below which a frame shows nobody.
    """
    each = np.array(list(scores.values()))
    best = each.max(axis=0)
    shown = best >= share * np.median(best)
    return list(scores)[int(each[:, shown].mean(axis=1).argmax())]


def _standing(cameras: Sequence[Camera], body: Body, settings: PlaceSettings, step: float, floor: float) -> _Standing:
    places = places_in_view(cameras, settings, step=step, floor=floor)
    postures, heights = postures_of(body)
    kinds = [k for k in settings.postures if k < len(postures)] or [0]
    turns = [
        rotations.about(UP, np.asarray(turn)) for turn in np.arange(settings.headings) * 2 * np.pi / settings.headings
    ]
    poses = tuple(
        Pose(np.array([*place, floor + heights[k]]), turn, postures[k])
        for place in places for turn in turns for k in kinds
    )  # fmt: skip
    return _Standing(places, poses)


def standing_poses(cameras: Sequence[Camera], body: Body, settings: PlaceSettings, floor: float) -> tuple[Pose, ...]:
    """Return upright poses at all places that two cameras have in view: every posture and heading at every place.

    Args:
        cameras: The cameras.
        body: A body with few vertices.
        settings: Settings of the search, with the distance of the places.
        floor: Height of the floor [m].
    """
    return _standing(cameras, body, settings, settings.step, floor).poses


def _scores_of(
    search: RegionSearch, body: Body, standing: _Standing, images: Sequence[RegionImages], settings: PlaceSettings
) -> list[Floats]:
    """Return the scores of all upright poses in each of some frames."""
    return list(map_in_threads(lambda own: _shared_scores(search, body, standing.poses, own, settings), images))


def _shared_scores(
    search: RegionSearch, body: Body, poses: Sequence[Pose], images: RegionImages, settings: PlaceSettings
) -> Floats:
    """Return the scores (n,) of poses by the words that the cameras have in common, and by other evidence."""
    return search.shared_scores(
        body, poses, images, least_area=settings.least_area, other_share=settings.other_share
    )


def _best_path(places: Floats, scores: Floats, times: Sequence[float], settings: PlaceSettings) -> list[int]:
    """Return the places, one per frame, with the largest total score along a path (dynamic programming)."""
    distance = np.linalg.norm(places[:, None] - places[None], axis=-1)
    total, back = scores[0], []
    for k in range(1, len(scores)):
        reach = settings.speed * (times[k] - times[k - 1]) + settings.slack
        step = np.where(distance > reach, np.inf, settings.travel_cost * distance)
        ways = total[:, None] - step
        back.append(ways.argmax(axis=0))
        total = ways.max(axis=0) + scores[k]
    path = [int(total.argmax())]
    for last in reversed(back):
        path.append(int(last[path[-1]]))
    return path[::-1]
