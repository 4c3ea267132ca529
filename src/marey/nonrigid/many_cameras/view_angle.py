"""Arrangement of several cameras before a deforming object: closed form for all but one angle, chosen by evidence."""

from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np
from scipy.optimize import minimize_scalar

from marey.arrays import Floats, Integers, Mask, freeze_fields
from marey.errors import MareyError
from marey.nonrigid.core.alignment import mean_shape
from marey.nonrigid.core.completion import COMPLETION_RANK, complete_tracks
from marey.nonrigid.core.deforming_model import (
    DeformingModel,
    DeformingModelSettings,
    basis_cost,
    initial_model,
    refine,
)
from marey.nonrigid.core.refinement import COMPARISON_NOISE, FEWEST_FRAMES
from marey.nonrigid.core.rotation_paths import smoothed_path
from marey.nonrigid.core.track_checks import FEWEST_POINTS
from marey.nonrigid.many_cameras.view_geometry import (
    ViewPair,
    ViewPairSettings,
    place_camera,
    rows_of,
    view_pair,
)


@dataclass(frozen=True, kw_only=True)
class ViewAngleSettings:
    """Settings of the search for the angle between two cameras.

    Where nothing else is stated, defaults were chosen by hand, and results were not measured against other values.
    """

    completion_rank: int = COMPLETION_RANK
    """Rank, beside the translation, of the completed tracks."""
    angles_deg: tuple[float, ...] = (10.0, 26.0, 42.0, 58.0, 74.0, 90.0, 106.0, 122.0, 138.0, 154.0, 170.0)
    """Angles between the lines of sight that are tried first [degrees]."""
    least_angle_deg: float = 3.0
    """Least angle between two lines of sight, or between one and the reverse of the other [degrees]."""
    coarse_tolerance_deg: float = 2.0
    """Tolerance of the first search for the angle [degrees]."""
    fine_tolerance_deg: float = 0.1
    """Tolerance of the second search for the angle [degrees]."""
    search_modes: int = 6
    """Number of modes in the first search."""
    mode_counts: tuple[int, ...] = (1, 2, 3, 4, 6, 8, 12)
    """Numbers of modes of which one is chosen for the second search. With 12 always, angles on the thigh of
    `lmam_treadmill_walking` are wrong by up to 3 degrees, with 6 by 1 (docs/explanation/nonrigid.md)."""
    equal_evidence: float = 0.025
    """Of numbers of modes whose evidence is within this of the best [natural logarithm per coordinate], the smallest is
    chosen; more modes explain a wrong angle as deformation."""
    comparison_noise: float = COMPARISON_NOISE
    """Least standard deviation of the noise when angles are compared, as a fraction of the object's size."""
    comparison_rounds: int = 10
    """Number of rounds of expectation maximisation with which angles are compared."""
    sd_evidence: float = 9.0
    """Loss of evidence [natural logarithm] of an angle one standard deviation away. The theoretical value is 0.5, but
    deformation that is synchronous with rotations looks like another angle; with 9, stated intervals contain the true
    angle on real skin (docs/explanation/nonrigid.md)."""
    most_frames: int = 300
    """Largest number of frames with which angles are compared."""
    most_points: int = 40
    """Largest number of points with which angles are compared."""
    least_parallax: float = 2.0
    """Two cameras look from the same side where their parallax is less than this times the noise."""
    least_difference: float = 1e-6
    """Parallax below this fraction of the size counts as none; a numerical threshold."""
    steady_weight: float = 1e8
    """Weight of the accelerations with which `smoothed_path` yields a rotation of constant rate."""
    steady_departure: float = 1.2
    """A rotation of constant rate is chosen where the object departs from its mean shape by at most this times as much
    as under the motion of least departure. Bodies before a camera that goes round them: 1.0 to 1.1; skin on walking
    legs: 3 to 9 (docs/explanation/nonrigid.md)."""
    frames_per_mode: int = 3
    """Least number of frames per mode."""
    model: DeformingModelSettings = field(default_factory=DeformingModelSettings)
    """Settings of the Gaussian model."""
    pair: ViewPairSettings = field(default_factory=ViewPairSettings)
    """Settings of the relative geometry of two cameras."""


@dataclass(frozen=True, eq=False, kw_only=True)
class NormalisedViews:
    """Centred tracks in units of each camera's size, and the relative geometry of two of the cameras."""

    tracks: Floats
    """(C, F, 2, P); NaN where not seen."""
    seen: Mask
    """(C, F, P) mask of the places seen."""
    size: Floats
    """(C,) root mean square coordinate in each camera."""
    middle: Floats
    """(C, F, 2) centre of the points seen."""
    common: Integers
    """(N,) indices of the points that two or more cameras see."""
    complete: Floats
    """(C, F, 2, N) completed tracks of those, centred; NaN where a camera sees too little of a frame."""
    base: tuple[int, int]
    """Indices of the two cameras with the largest parallax."""
    pair: ViewPair
    """Relative geometry of these two cameras."""

    def __post_init__(self) -> None:
        freeze_fields(self, "tracks", "size", "middle", "complete")
        freeze_fields(self, "seen", dtype=bool)
        freeze_fields(self, "common", dtype=np.int64)

    @property
    def count(self) -> int:
        """Number of coordinates seen."""
        return 2 * int(self.seen.sum())


@dataclass
class CameraArrangement:
    """Arrangement of the cameras for one angle between two of them, with the model of the common points."""

    angle: float
    """Angle between the lines of sight of the base cameras [rad]."""
    camera_from_base: Floats
    """(C, 3, 3) each camera from the first of the base."""
    scale: Floats
    """(C,) scale of each camera over that of the first of the base."""
    model: DeformingModel
    """Gaussian model of the common points."""
    cost: float
    """Minus the log-probability of the tracks, plus the cost of the modes."""


def normalised_views(tracks: Floats, seen: Mask, settings: ViewAngleSettings) -> NormalisedViews:
    """Centre and scale tracks, and select the two cameras with the largest parallax.

    Args:
        tracks: (C, F, 2, P); NaN where not seen.
        seen: (C, F, P).
        settings: Tuned constants.

    Raises:
        MareyError: The points of a camera coincide, no two cameras share enough points, or all cameras look from the
            same side.
    """
    weight = seen.astype(float)
    middle = np.where(seen[:, :, None], tracks, 0).sum(3) / np.maximum(weight.sum(2), 1)[:, :, None]
    known = tracks - middle[..., None]
    size = np.sqrt(np.nansum(known**2, (1, 2, 3)) / np.maximum(2 * weight.sum((1, 2)), 1))
    blind = np.flatnonzero(~(size > 0))
    if len(blind):
        raise MareyError(f"In camera {blind[0]} all points coincide in every frame: there is no shape to estimate.")
    known = known / size[:, None, None, None]
    base, pair = _base(known, settings)
    together = seen.sum(0) >= 2
    common = np.flatnonzero(together.sum(0) >= FEWEST_FRAMES)
    return NormalisedViews(
        tracks=known, seen=seen, size=size, middle=middle, common=common, base=base, pair=pair,
        complete=_completed(known[..., common], settings.completion_rank),
    )  # fmt: skip


def _base(tracks: Floats, settings: ViewAngleSettings) -> tuple[tuple[int, int], ViewPair]:
    """Select the two cameras with the largest parallax."""
    indices = combinations(range(len(tracks)), 2)
    pairs = {(i, j): view_pair(tracks[i], tracks[j], settings.pair) for i, j in indices}
    known = {ij: pair for ij, pair in pairs.items() if pair is not None}
    if not known:
        raise MareyError(
            f"No two cameras see {FEWEST_POINTS} points together in {FEWEST_FRAMES} frames: their relative orientation "
            "cannot be determined."
        )
    base, pair = max(known.items(), key=lambda item: item[1].spread[1])
    if pair.spread[1] < max(settings.least_parallax * pair.spread[0], settings.least_difference):
        raise MareyError(
            "All cameras look from the same side as far as the tracks show; give the tracks of one camera."
        )
    return base, pair


def _completed(tracks: Floats, rank: int) -> Floats:
    """Fill gaps by the common low rank of all cameras' tracks ([Alexander2003] eq. (14): one basis for all)."""
    seen: Mask = np.asarray(np.isfinite(tracks).all(2))
    enough = seen.sum(2) >= FEWEST_POINTS
    out = np.full(tracks.shape, np.nan)
    if seen[enough].all():
        out[enough] = tracks[enough] - tracks[enough].mean(2, keepdims=True)
    else:
        out[enough] = complete_tracks(tracks[enough], seen[enough], rank)[0]
    return out


def best_angle(
    views: NormalisedViews, settings: ViewAngleSettings
) -> tuple[CameraArrangement, list[CameraArrangement]]:
    """Estimate the angle between the lines of sight of the base cameras.

    Args:
        views: Tracks and relative geometry.
        settings: Tuned constants.

    Returns:
        The arrangement for that angle, and those for the angles one standard deviation to either side.

    Raises:
        MareyError: A camera shares too few points with the base cameras.
    """
    subset, angles = _subset(views, settings), np.deg2rad(settings.angles_deg)
    nearest = np.deg2rad(settings.least_angle_deg)
    search = _AngleSearch(subset, most_modes(settings.search_modes, views, settings), settings)
    place = int(np.argmin([search.cost(float(angle)) for angle in angles]))
    below = angles[place - 1] if place else nearest
    above = angles[place + 1] if place + 1 < len(angles) else np.pi - nearest
    tolerance = np.deg2rad(settings.coarse_tolerance_deg)
    minimize_scalar(search.cost, bounds=(below, above), method="bounded", options={"xatol": tolerance})
    search = _AngleSearch(subset, _simplest(subset, search.best, settings), settings)
    for angle in (below, above):
        search.cost(float(angle))
    tolerance = np.deg2rad(settings.fine_tolerance_deg)
    minimize_scalar(search.cost, bounds=(below, above), method="bounded", options={"xatol": tolerance})
    others = _angles_at_one_sd(search.costs, search.best, settings.sd_evidence)
    best = _arrangement(views, search.best, search.modes, settings)
    return best, [_arrangement(views, angle, search.modes, settings) for angle in others]


class _AngleSearch:
    """Costs of the angles tried so far with a given number of modes."""

    def __init__(self, views: NormalisedViews, modes: int, settings: ViewAngleSettings) -> None:
        self.views, self.modes, self.settings = views, modes, settings
        self.costs: dict[float, float] = {}

    def cost(self, angle: float) -> float:
        if angle not in self.costs:
            self.costs[angle] = _arrangement(self.views, angle, self.modes, self.settings).cost
        return self.costs[angle]

    @property
    def best(self) -> float:
        return min(self.costs, key=lambda angle: self.costs[angle])


def _simplest(views: NormalisedViews, angle: float, settings: ViewAngleSettings) -> int:
    """Select the smallest number of modes that explains the tracks nearly as well as the best."""
    modes = sorted({most_modes(modes, views, settings) for modes in settings.mode_counts})
    costs = [_arrangement(views, angle, each, settings).cost for each in modes]
    enough = min(costs) + settings.equal_evidence * views.count
    return next(each for each, cost in zip(modes, costs, strict=True) if cost <= enough)


def _subset(views: NormalisedViews, settings: ViewAngleSettings) -> NormalisedViews:
    """Select as many frames and points as suffice to determine the angle."""
    step = -(-views.tracks.shape[1] // settings.most_frames)
    points = views.common
    if len(points) > settings.most_points:
        often = np.argsort(views.seen[..., points].sum((0, 1)), kind="stable")[::-1]
        points = np.sort(points[often[: settings.most_points]])
    tracks = views.tracks[:, ::step][..., points]
    return replace(
        views, tracks=tracks, seen=views.seen[:, ::step][..., points], middle=views.middle[:, ::step],
        common=np.arange(len(points)), complete=views.complete[:, ::step][..., np.isin(views.common, points)],
    )  # fmt: skip


def _angles_at_one_sd(tried: dict[float, float], best: float, evidence: float) -> list[float]:
    """Find the angles nearest to the best, below and above, whose cost is higher by the given evidence."""
    angles = sorted(tried)
    place = angles.index(best)
    found = []
    for side in (angles[:place][::-1], angles[place + 1 :]):
        # the root of the loss is linear in the angle where the loss is quadratic
        last, lost = best, 0.0
        for angle in side:
            loss = np.sqrt(tried[angle] - tried[best])
            if loss >= np.sqrt(evidence):
                last += (np.sqrt(evidence) - lost) / (loss - lost) * (angle - last)
                break
            last, lost = angle, loss
        found.append(float(last))
    return found


def _arrangement(views: NormalisedViews, angle: float, modes: int, settings: ViewAngleSettings) -> CameraArrangement:
    """Place the cameras for an angle [rad], and fit the model to the common points."""
    camera_from_base, scale, points = _placed_cameras(views, angle)
    common = views.common
    _, rotation, _ = mean_shape(points, np.ones(points.shape[:2], bool))
    shapes = np.swapaxes(points @ rotation, 1, 2)
    tracks, seen = stacked(views.tracks[..., common], np.ones(len(scale)))
    noise, projection = settings.comparison_noise, rows_of(camera_from_base, scale)
    model = initial_model(tracks, seen, rotation, shapes, modes, noise, projection, settings.model)
    refine(model, tracks, seen, settings.comparison_rounds, noise)
    return CameraArrangement(angle, camera_from_base, scale, model, model.cost + basis_cost(model))


def most_modes(modes: int, views: NormalisedViews, settings: ViewAngleSettings) -> int:
    """Limit a number of modes to what the number of frames permits."""
    return int(max(1, min(modes, views.tracks.shape[1] // settings.frames_per_mode)))


def stacked(tracks: Floats, noise: Floats) -> tuple[Floats, Floats]:
    """Stack tracks (C, F, 2, P) over each camera's noise to (F, 2C, P), 0 where not seen; and the mask (F, C, P)."""
    cameras, frames, _, points = tracks.shape
    rows = (tracks / noise[:, None, None, None]).transpose(1, 0, 2, 3).reshape(frames, 2 * cameras, points)
    seen = np.isfinite(tracks).all(2).astype(float)
    return np.nan_to_num(rows), seen.transpose(1, 0, 2)


def _placed_cameras(views: NormalisedViews, angle: float) -> tuple[Floats, Floats, Floats]:
    """Place all cameras for an angle [rad] between the base cameras, and reconstruct the common points.

    Returns:
        Camera from the first base camera (C, 3, 3), scales (C,), and points (F, N, 3) in the axes of that camera.
    """
    cameras = len(views.tracks)
    placed = {views.base[0]: (np.eye(3), 1.0), views.base[1]: (views.pair.second_from_first(angle), views.pair.scale)}
    shapes = _reconstructed(views.complete, placed)
    for camera in set(range(cameras)) - set(views.base):
        place = place_camera(views.tracks[camera][..., views.common], shapes)
        if place is None:
            raise MareyError(
                f"Camera {camera} sees too few of the points that cameras {views.base[0]} and {views.base[1]} both see"
                f": at least {FEWEST_POINTS} points in {FEWEST_FRAMES} frames are needed."
            )
        placed[camera] = place
    shapes = _reconstructed(views.complete, placed)
    rotation, scale = (np.array([placed[camera][k] for camera in range(cameras)]) for k in (0, 1))
    return rotation, scale, np.swapaxes(_interpolated(shapes), 1, 2)


def _reconstructed(complete: Floats, placed: dict[int, tuple[Floats, float]]) -> Floats:
    """Compute points (F, 3, N) by least squares in frames that two or more cameras see; NaN in others."""
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


def _interpolated(shapes: Floats) -> Floats:
    """Interpolate frames without points from their neighbours in time, as initial values."""
    known = np.isfinite(shapes).all((1, 2))
    time = np.arange(len(shapes))
    flat = shapes.reshape(len(shapes), -1)
    filled = np.stack([np.interp(time, time[known], column[known]) for column in flat.T], 1)
    return np.asarray(filled.reshape(shapes.shape))


def initial_motion(best: CameraArrangement, settings: ViewAngleSettings) -> tuple[Floats, Floats, bool]:
    """Compute initial rotations and shapes.

    Args:
        best: Arrangement of the cameras.
        settings: Criterion for a rotation of constant rate.

    Returns:
        Rotations (F, 3, 3), shapes (F, 3, N), and whether the rotation has a constant rate.
    """
    shapes = best.model.shapes
    steady = smoothed_path(best.model.rotation, settings.steady_weight)
    turned = np.swapaxes(steady, 1, 2) @ best.model.rotation @ shapes
    if _departure(turned) <= settings.steady_departure * _departure(shapes):
        return steady, turned, True
    return best.model.rotation, shapes, False


def _departure(shapes: Floats) -> float:
    return float(np.sqrt(np.mean((shapes - shapes.mean(0)) ** 2)))
