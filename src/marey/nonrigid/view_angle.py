"""How several cameras stand before a deforming object: all but one angle in closed form, that one by its evidence."""

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.errors import MareyError
from marey.nonrigid.alignment import mean_shape
from marey.nonrigid.completion import complete_tracks
from marey.nonrigid.deforming_model import DeformingModel, basis_cost, begin, improve
from marey.nonrigid.rotation_paths import steadier
from marey.nonrigid.view_geometry import FEWEST_FRAMES, FEWEST_POINTS, ViewPair, pair_of, place_camera, rows_of

COMPLETING_RANK = 15
ANGLES = np.deg2rad(np.arange(10.0, 171.0, 16.0))
"""Angles between two cameras' sights that are tried first."""
FINEST_ANGLE = np.deg2rad(0.5)
JUDGING_NOISE = 0.01
"""Noise that is believed at least when angles are compared, as a share of the object's size: what few modes leave is
not noise, and would decide otherwise."""
JUDGING_MODES = 12
JUDGING_ROUNDS = 10
TOLD_APART = 0.001
"""An angle whose evidence is worse by this, in natural logarithms a coordinate of the tracks, lies a standard deviation
away: deformation that keeps time with the turn of the object looks like another angle, and the evidence
alone would be far too sure."""
LEAST_PARALLAX = 2.0
"""Two cameras look from the same side where what they see differently is below so many times the noise."""
STEADY = 1e8
"""Weight of the accelerations with which `steadier` gives a turn at a constant rate."""
HARDLY_MORE = 1.2
"""A turn at a constant rate is believed where it makes the object depart from its mean shape at most so many times more
than the motion from which it departs least. (Bodies before a camera that goes round: 1.0 to 1.1; skin on walking
legs, taken so: 3 to 9.)"""
FRAMES_A_MODE = 8
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
    tried = {float(angle): _judged(views, float(angle)) for angle in ANGLES}
    while True:
        angles = sorted(tried)
        place = min(range(len(angles)), key=lambda i: tried[angles[i]].cost)
        below = angles[place - 1] if place else 0.0
        above = angles[place + 1] if place + 1 < len(angles) else np.pi
        middle = angles[place]
        if max(above - middle, middle - below) < 2 * FINEST_ANGLE:
            break
        for angle in (0.5 * (below + middle), 0.5 * (middle + above)):
            tried[angle] = _judged(views, angle)
    best = tried[angles[place]]
    return best, [_judged(views, angle) for angle in _doubtful(tried, best, views.count)]


def _doubtful(tried: dict[float, Judged], best: Judged, count: int) -> list[float]:
    """Give the angles nearest to the best, below and above, whose evidence is worse by a standard deviation."""
    worse = best.cost + TOLD_APART * count
    angles = sorted(tried)
    found = []
    for side in (angles[: angles.index(best.angle)][::-1], angles[angles.index(best.angle) + 1 :]):
        last = best
        for angle in side:
            this = tried[angle]
            if this.cost >= worse:
                share = (worse - last.cost) / (this.cost - last.cost)
                found.append(last.angle + share * (angle - last.angle))
                break
            last = this
        else:
            found.append(last.angle)
    return found


def _judged(views: Views, angle: float) -> Judged:
    camera_from_base, scale, points = _arranged(views, angle)
    common = views.common
    _, rotation, _ = mean_shape(points, np.ones(points.shape[:2], bool))
    shapes = np.swapaxes(points @ rotation, 1, 2)
    tracks, seen = stacked(views.tracks[..., common], np.ones(len(scale)))
    modes = most_modes(JUDGING_MODES, views)
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
        stacked = complete[used][:, frames].transpose(1, 0, 2, 3).reshape(int(frames.sum()), len(rows), -1)
        out[frames] = np.linalg.pinv(rows) @ stacked
    return out


def _bridged(shapes: Floats) -> Floats:
    """Fill frames without points from their neighbours in time: a start, no answer."""
    known = np.isfinite(shapes).all((1, 2))
    time = np.arange(len(shapes))
    flat = shapes.reshape(len(shapes), -1)
    filled = np.stack([np.interp(time, time[known], column[known]) for column in flat.T], 1)
    return np.asarray(filled.reshape(shapes.shape))


def path_of(best: Judged) -> tuple[Floats, Floats]:
    """Give the rotations and shapes to begin with: a turn at constant rate where that explains the motion as well."""
    shapes = best.model.shapes
    steady = steadier(best.model.rotation, STEADY)
    turned = np.swapaxes(steady, 1, 2) @ best.model.rotation @ shapes
    if _departure(turned) <= HARDLY_MORE * _departure(shapes):
        return steady, turned
    return best.model.rotation, shapes


def _departure(shapes: Floats) -> float:
    return float(np.sqrt(np.mean((shapes - shapes.mean(0)) ** 2)))
