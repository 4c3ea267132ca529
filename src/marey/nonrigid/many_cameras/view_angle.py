"""How several cameras stand before a deforming object: all but one angle in closed form, that one by its evidence."""

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.optimize import minimize_scalar

from marey.arrays import Floats, Integers, Mask
from marey.errors import MareyError
from marey.nonrigid.core.alignment import mean_shape
from marey.nonrigid.core.completion import complete_tracks
from marey.nonrigid.core.deforming_model import DeformingModel, basis_cost, begin, improve
from marey.nonrigid.core.rotation_paths import steadier
from marey.nonrigid.many_cameras.view_geometry import (
    FEWEST_FRAMES,
    FEWEST_POINTS,
    ViewPair,
    pair_of,
    place_camera,
    rows_of,
)

COMPLETING_RANK = 15
ANGLES = np.deg2rad(np.arange(10.0, 171.0, 16.0))
"""Angles between two cameras' sights that are tried first."""
COARSE_ANGLE, FINEST_ANGLE = np.deg2rad(2.0), np.deg2rad(0.1)
JUDGING_NOISE = 0.01
"""Noise that is believed at least when angles are compared, as a share of the object's size: what few modes leave is
not noise, and would decide otherwise."""
SEARCHING_MODES = 6
JUDGING_MODES = (1, 2, 3, 4, 6, 8, 12)
AS_WELL = 0.025
"""Of numbers of modes whose evidence differs by less [natural logarithm a coordinate], the smallest judges the angle:
more modes explain a wrong angle as deformation."""
JUDGING_ROUNDS = 10
TOLD_APART = 9.0
"""An angle whose evidence is worse by this [natural logarithm] lies a standard deviation away: deformation that keeps
time with the turns of the object looks like another angle, and the evidence alone would be far too sure (0.5)."""
ENOUGH_FRAMES = 300
ENOUGH_POINTS = 40
NEAREST = np.deg2rad(3.0)
"""Least angle between two cameras' sights, or between one and the other's back, that is tried."""
LEAST_PARALLAX = 2.0
"""Two cameras look from the same side where what they see differently is below so many times the noise."""
STEADY = 1e8
"""Weight of the accelerations with which `steadier` gives a turn at a constant rate."""
HARDLY_MORE = 1.2
"""A turn at a constant rate is believed where it makes the object depart from its mean shape at most so many times more
than the motion from which it departs least. (Bodies before a camera that goes round: 1.0 to 1.1; skin on walking
legs, taken so: 3 to 9.)"""
FRAMES_A_MODE = 3
"""Fewer frames a mode would tell too little about it."""
LEAST_SHOWN = 1e-6
"""Share of the size below which what the cameras see differently is nothing."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Views:
    """The tracks in shares of each camera's size, centred, and what is known of two of the cameras."""

    tracks: Floats
    """(C, F, 2, P); NaN where not seen."""
    seen: Mask
    """(C, F, P)."""
    size: Floats
    """(C,)."""
    middle: Floats
    """(C, F, 2)."""
    common: Integers
    """Points that two cameras or more see, by number."""
    complete: Floats
    """(C, F, 2, N) of those, centred; NaN where a camera sees too little of a frame."""
    base: tuple[int, int]
    pair: ViewPair

    @property
    def count(self) -> int:
        """Number of coordinates seen."""
        return 2 * int(self.seen.sum())


@dataclass
class Judged:
    """How the cameras stand for one angle between two of them, and the model of the common points that goes with it."""

    angle: float
    camera_from_base: Floats
    scale: Floats
    model: DeformingModel
    cost: float


def views_of(tracks: Floats, seen: Mask) -> Views:
    """Centre and scale the tracks (C, F, 2, P), and find the two cameras to begin with.

    Raises:
        MareyError: A camera's points lie in one place, no two cameras share enough, or all look from the same side.
    """
    weight = seen.astype(float)
    middle = np.where(seen[:, :, None], tracks, 0).sum(3) / np.maximum(weight.sum(2), 1)[:, :, None]
    known = tracks - middle[..., None]
    size = np.sqrt(np.nansum(known**2, (1, 2, 3)) / np.maximum(2 * weight.sum((1, 2)), 1))
    blind = np.flatnonzero(~(size > 0))
    if len(blind):
        raise MareyError(f"In camera {blind[0]} all points lie in one place in every frame: there is nothing to see.")
    known = known / size[:, None, None, None]
    base, pair = _base(known)
    together = seen.sum(0) >= 2
    common = np.flatnonzero(together.sum(0) >= FEWEST_FRAMES)
    return Views(
        tracks=known, seen=seen, size=size, middle=middle, common=common, base=base, pair=pair,
        complete=_completed(known[..., common]),
    )  # fmt: skip


def _base(tracks: Floats) -> tuple[tuple[int, int], ViewPair]:
    """Choose the two cameras that see the most differently."""
    pairs = {ij: pair_of(tracks[ij[0]], tracks[ij[1]]) for ij in combinations(range(len(tracks)), 2)}
    known = {ij: pair for ij, pair in pairs.items() if pair is not None}
    if not known:
        raise MareyError(
            f"No two cameras see {FEWEST_POINTS} points together in {FEWEST_FRAMES} frames: how they stand to each "
            "other cannot be told."
        )
    base, pair = max(known.items(), key=lambda item: item[1].spread[1])
    if pair.spread[1] < max(LEAST_PARALLAX * pair.spread[0], LEAST_SHOWN):
        raise MareyError("All cameras look from the same side as far as the tracks tell: they gain nothing over one.")
    return base, pair


def _completed(tracks: Floats) -> Floats:
    """Fill gaps from what all cameras' tracks have in common ([Alexander2003] eq. (14): one basis for all)."""
    seen: Mask = np.asarray(np.isfinite(tracks).all(2))
    enough = seen.sum(2) >= FEWEST_POINTS
    out = np.full(tracks.shape, np.nan)
    if seen[enough].all():
        out[enough] = tracks[enough] - tracks[enough].mean(2, keepdims=True)
    else:
        out[enough] = complete_tracks(tracks[enough], seen[enough], COMPLETING_RANK)[0]
    return out


def best_angle(views: Views) -> tuple[Judged, list[Judged]]:
    """Find the angle between the two cameras' sights; give it, and answers a standard deviation to either side.

    Raises:
        MareyError: A camera shares too few points with those two.
    """
    fewer = _fewer(views)
    tried = _Tried(fewer, most_modes(SEARCHING_MODES, views))
    place = int(np.argmin([tried.cost(float(angle)) for angle in ANGLES]))
    below = ANGLES[place - 1] if place else NEAREST
    above = ANGLES[place + 1] if place + 1 < len(ANGLES) else np.pi - NEAREST
    minimize_scalar(tried.cost, bounds=(below, above), method="bounded", options={"xatol": COARSE_ANGLE})
    tried = _Tried(fewer, _simplest(fewer, tried.best))
    for angle in (below, above):
        tried.cost(float(angle))
    minimize_scalar(tried.cost, bounds=(below, above), method="bounded", options={"xatol": FINEST_ANGLE})
    others = _doubtful(tried.costs, tried.best)
    return _judged(views, tried.best, tried.modes), [_judged(views, angle, tried.modes) for angle in others]


class _Tried:
    """The angles that were tried with a number of modes, and what they cost."""

    def __init__(self, views: Views, modes: int) -> None:
        self.views, self.modes = views, modes
        self.costs: dict[float, float] = {}

    def cost(self, angle: float) -> float:
        if angle not in self.costs:
            self.costs[angle] = _judged(self.views, angle, self.modes).cost
        return self.costs[angle]

    @property
    def best(self) -> float:
        return min(self.costs, key=lambda angle: self.costs[angle])


def _simplest(views: Views, angle: float) -> int:
    """Give the smallest number of modes that explains the tracks nearly as well as the best."""
    modes = sorted({most_modes(modes, views) for modes in JUDGING_MODES})
    costs = [_judged(views, angle, each).cost for each in modes]
    enough = min(costs) + AS_WELL * views.count
    return next(each for each, cost in zip(modes, costs, strict=True) if cost <= enough)


def _fewer(views: Views) -> Views:
    """Keep as many frames and points as suffice to tell the angle."""
    step = -(-views.tracks.shape[1] // ENOUGH_FRAMES)
    points = views.common
    if len(points) > ENOUGH_POINTS:
        often = np.argsort(views.seen[..., points].sum((0, 1)), kind="stable")[::-1]
        points = np.sort(points[often[:ENOUGH_POINTS]])
    tracks = views.tracks[:, ::step][..., points]
    return replace(
        views, tracks=tracks, seen=views.seen[:, ::step][..., points], middle=views.middle[:, ::step],
        common=np.arange(len(points)), complete=views.complete[:, ::step][..., np.isin(views.common, points)],
    )  # fmt: skip


def _doubtful(tried: dict[float, float], best: float) -> list[float]:
    """Give the angles nearest to the best, below and above, whose evidence is worse by a standard deviation."""
    angles = sorted(tried)
    place = angles.index(best)
    found = []
    for side in (angles[:place][::-1], angles[place + 1 :]):
        # the root of the loss is linear in the angle where the loss is quadratic
        last, lost = best, 0.0
        for angle in side:
            loss = np.sqrt(tried[angle] - tried[best])
            if loss >= np.sqrt(TOLD_APART):
                last += (np.sqrt(TOLD_APART) - lost) / (loss - lost) * (angle - last)
                break
            last, lost = angle, loss
        found.append(float(last))
    return found


def _judged(views: Views, angle: float, modes: int) -> Judged:
    camera_from_base, scale, points = _arranged(views, angle)
    common = views.common
    _, rotation, _ = mean_shape(points, np.ones(points.shape[:2], bool))
    shapes = np.swapaxes(points @ rotation, 1, 2)
    tracks, seen = stacked(views.tracks[..., common], np.ones(len(scale)))
    model = begin(tracks, seen, rotation, shapes, modes, JUDGING_NOISE, rows_of(camera_from_base, scale))
    improve(model, tracks, seen, JUDGING_ROUNDS, JUDGING_NOISE)
    return Judged(angle, camera_from_base, scale, model, model.cost + basis_cost(model))


def most_modes(modes: int, views: Views) -> int:
    """Lower a number of modes to what the frames can tell of."""
    return max(1, min(modes, views.tracks.shape[1] // FRAMES_A_MODE))


def stacked(tracks: Floats, noise: Floats) -> tuple[Floats, Floats]:
    """Give tracks (F, 2C, P) over each camera's noise, 0 where not seen, and what is seen (F, C, P)."""
    cameras, frames, _, points = tracks.shape
    rows = (tracks / noise[:, None, None, None]).transpose(1, 0, 2, 3).reshape(frames, 2 * cameras, points)
    seen = np.isfinite(tracks).all(2).astype(float)
    return np.nan_to_num(rows), seen.transpose(1, 0, 2)


def _arranged(views: Views, angle: float) -> tuple[Floats, Floats, Floats]:
    """Place all cameras for an angle between two, and lift the common points.

    Returns:
        Camera from the base's first (C, 3, 3), scales (C,) and points (F, N, 3) in the axes of the base's first camera.
    """
    cameras = len(views.tracks)
    placed = {views.base[0]: (np.eye(3), 1.0), views.base[1]: (views.pair.second_from_first(angle), views.pair.scale)}
    shapes = _lifted(views.complete, placed)
    for camera in set(range(cameras)) - set(views.base):
        place = place_camera(views.tracks[camera][..., views.common], shapes)
        if place is None:
            raise MareyError(
                f"Camera {camera} sees too few of the points that cameras {views.base[0]} and {views.base[1]} both see."
            )
        placed[camera] = place
    shapes = _lifted(views.complete, placed)
    rotation, scale = (np.array([placed[camera][k] for camera in range(cameras)]) for k in (0, 1))
    return rotation, scale, np.swapaxes(_bridged(shapes), 1, 2)


def _lifted(complete: Floats, placed: dict[int, tuple[Floats, float]]) -> Floats:
    """Find points (F, 3, N) by least squares in frames that two cameras see or more; NaN in others."""
    out = np.full((complete.shape[1], 3, complete.shape[3]), np.nan)
    cameras = sorted(placed)
    whole: Mask = np.asarray(np.isfinite(complete[cameras]).all((2, 3)))
    for pattern in np.unique(whole.T, axis=0):
        used = [camera for camera, there in zip(cameras, pattern, strict=True) if there]
        if len(used) < 2:
            continue
        rows = rows_of(np.array([placed[c][0] for c in used]), np.array([placed[c][1] for c in used]))
        frames = (pattern == whole.T).all(1)
        both = complete[used][:, frames].transpose(1, 0, 2, 3).reshape(int(frames.sum()), len(rows), -1)
        out[frames] = np.linalg.pinv(rows) @ both
    return out


def _bridged(shapes: Floats) -> Floats:
    """Fill frames without points from their neighbours in time: a start, no answer."""
    known = np.isfinite(shapes).all((1, 2))
    time = np.arange(len(shapes))
    flat = shapes.reshape(len(shapes), -1)
    filled = np.stack([np.interp(time, time[known], column[known]) for column in flat.T], 1)
    return np.asarray(filled.reshape(shapes.shape))


def path_of(best: Judged) -> tuple[Floats, Floats, bool]:
    """Give rotations and shapes to begin with, and whether a turn at a constant rate is believed (`HARDLY_MORE`)."""
    shapes = best.model.shapes
    steady = steadier(best.model.rotation, STEADY)
    turned = np.swapaxes(steady, 1, 2) @ best.model.rotation @ shapes
    if _departure(turned) <= HARDLY_MORE * _departure(shapes):
        return steady, turned, True
    return best.model.rotation, shapes, False


def _departure(shapes: Floats) -> float:
    return float(np.sqrt(np.mean((shapes - shapes.mean(0)) ** 2)))
