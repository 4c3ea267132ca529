"""Fit of a bright ball in air and tissue to the voxels about it, each of which is the mean over its box."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.optimize import least_squares
from scipy.special import ndtr

from marey.arrays import Floats, Integers
from marey.knee.markers.ball_candidates import BallCandidate, sphere_directions
from marey.knee.space.resampling import part_of
from marey.knee.space.volume import Volume, VoxelGrid


@dataclass(frozen=True, kw_only=True)
class BallFitSettings:
    """Settings for fitting a ball to the voxels about it.

    Values without a stated source were chosen by hand.
    """

    margin_mm: float = 2.5
    """Distance [mm] about the ball up to which voxels are fitted."""
    voxels_per_radius: float = 8.0
    """Voxels are averaged until a radius has about this many of them: more do not improve the fit."""
    point_spacing_mm: float = 0.5
    """Spacing [mm] of the points whose mean models a voxel; larger in balls whose voxels are averaged."""
    beside_mm: tuple[float, float] = (0.8, 2.0)
    """Range [mm] outside the ball in which tissue is searched."""
    tissue_share: float = 0.3
    """Voxels count as tissue above this share of the step from air to the ball."""
    blur_mm: tuple[float, float] = (0.1, 1.5)
    """Least and largest standard deviation [mm] of the blur."""
    robust: float = 3.0
    """Number of standard deviations beyond which residuals have less weight: tissue is less even than the model."""
    slope_sd: float = 0.02
    """Standard deviation of the slope of the tissue's level [1/mm], as a share of the patch's range of
    intensities."""
    most_steps: int = 15
    """Largest number of evaluations of the least-squares solver."""
    steepest: float = 20.0
    """Largest change of the parameters of the skin's plane."""
    least_span: float = 0.03
    """Least range of the levels about a ball, as a share of its contrast, from which tissue is fitted."""
    bandwidth: int = 2
    """Number of voxels within which residuals may depend on each other, by the scanner's filters or errors of the
    model."""
    model_error: float = 0.03
    """Standard deviation of the centre due to errors of the model, as a share of the width of an edge. Made balls
    need it (bench/knee/gadolinium.py); by noise alone it would be micrometres."""
    model_error_in_tissue: float = 0.07
    """The additional standard deviation for a ball in tissue of the same brightness."""


BALL_FIT_DEFAULTS = BallFitSettings()
"""Default settings for fitting a ball to the voxels about it."""

_BALL = 7
"""Number of parameters of the ball and the air: centre, radius, blur, level, level of the air."""
_ALL = _BALL + 8
"""Number of all parameters, with those of the tissue: level, its slopes, and the plane of the skin."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BallFit:
    """A fitted ball."""

    centre_mm: Floats
    """(3,) LPS."""
    covariance_mm2: Floats
    """(3, 3) of the centre, by noise and by errors of the model."""
    radius_mm: float
    radius_sd_mm: float
    level: float
    air: float
    tissue: float
    """Level of the bright tissue that it touches; that of air if it touches none."""
    tissue_share: float
    """Share of the ball's surroundings that is such tissue."""
    misfit: float
    """Root mean square residual about the ball's edge, as a share of its contrast to air."""
    seen: float
    """Share of the ball that lies within the image."""


@dataclass(frozen=True, eq=False)
class _Patch:
    """The voxels about a ball."""

    values: Floats
    """(n,) intensities."""
    points: Floats
    """(n, m, 3) mm from the start's centre: points within each voxel."""
    middles: Floats
    """(n, 3) mm from the start's centre: the voxels' centres."""
    voxel_mm: float
    """Standard deviation of the position within a voxel, the root mean square of the axes."""
    point_mm: float
    """Standard deviation of the position within the part of a voxel that each point represents, along an axis."""
    index: Integers
    """(n, 3) k, j, i in the patch."""
    shape: tuple[int, ...]


def fit_ball(
    volume: Volume,
    start: BallCandidate,
    others: Sequence[tuple[Floats, float]] = (),
    *,
    settings: BallFitSettings = BALL_FIT_DEFAULTS,
) -> BallFit | None:
    """Fit a ball and its surroundings by least squares.

    The model is a ball of one level, blurred by a Gaussian and averaged over each voxel, in air of another level beside
    tissue whose skin is a plane and whose level may slope; without tissue if none is visible. The covariance allows for
    correlated residuals of neighbouring voxels.

    Args:
        volume: The image.
        start: Approximate position and radius.
        others: Centre and radius of balls nearby, whose voxels are ignored.
        settings: Tuned constants of the algorithm.

    Returns:
        The fit; None where too few voxels show the ball.
    """
    patch = _patch(volume, start, others, settings=settings)
    if patch is None:
        return None
    beside = _start_at_skin(patch, start, settings=settings)
    return _ball(
        volume.grid,
        patch,
        _solved(patch, _start_in_air(patch, start) if beside is None else beside, settings=settings),
        start,
        settings=settings,
    )


@dataclass(frozen=True, eq=False)
class _Solution:
    numbers: Floats
    residual: Floats
    jacobian: Floats
    weight: Floats


def _patch(
    volume: Volume, start: BallCandidate, others: Sequence[tuple[Floats, float]], *, settings: BallFitSettings
) -> _Patch | None:
    reach = start.radius_mm + settings.margin_mm
    grid = volume.grid
    half = reach / grid.spacing_mm + 1
    middle = grid.voxels(start.centre_mm)
    low = np.maximum(np.floor(middle - half), 0).astype(int)[::-1]
    high = np.minimum(np.ceil(middle + half) + 1, grid.shape[::-1]).astype(int)[::-1]
    if (high - low < 1).any():
        return None
    box = tuple(slice(a, b) for a, b in zip(low.tolist(), high.tolist(), strict=True))
    values, part = _coarser(volume.intensity[box], part_of(grid, box), start.radius_mm / settings.voxels_per_radius)
    index = np.argwhere(np.ones(values.shape, dtype=bool))
    middles = part.lps(index[:, ::-1].astype(float))
    kept = np.linalg.norm(middles - start.centre_mm, axis=1) < reach
    for centre, radius in others:
        kept &= np.linalg.norm(middles - centre, axis=1) > radius + 0.5 * float(part.spacing_mm.max()) + 0.5
    if kept.sum() < 4 * _ALL:
        return None
    middles = middles[kept] - start.centre_mm
    within, point = _within_voxel(part, max(settings.point_spacing_mm, start.radius_mm / settings.voxels_per_radius))
    points = middles[:, None, :] + within[None]
    voxel = float(np.sqrt((part.spacing_mm**2).mean() / 12))
    return _Patch(values[tuple(index[kept].T)].astype(float), points, middles, voxel, point, index[kept], values.shape)


def _coarser(values: np.ndarray, grid: VoxelGrid, wanted_mm: float) -> tuple[np.ndarray, VoxelGrid]:
    """Return the means of blocks of voxels no wider than wanted; the voxels themselves where they are wider."""
    blocks = [max(1, int(wanted_mm / spacing)) for spacing in grid.array_spacing_mm]
    counts = [n // block for n, block in zip(values.shape, blocks, strict=True)]
    trimmed = values[tuple(slice(0, n * block) for n, block in zip(counts, blocks, strict=True))]
    shape = [each for pair in zip(counts, blocks, strict=True) for each in pair]
    means: np.ndarray = trimmed.reshape(shape).mean(axis=(1, 3, 5), dtype=np.float64)
    lps_from_voxel = grid.lps_from_voxel.copy()
    lps_from_voxel[:3, :3] *= blocks[::-1]
    lps_from_voxel[:3, 3] = grid.lps((np.array(blocks[::-1]) - 1) / 2)
    k, j, i = counts
    return means, VoxelGrid(shape=(k, j, i), lps_from_voxel=lps_from_voxel)


def _within_voxel(grid: VoxelGrid, apart_mm: float) -> tuple[Floats, float]:
    """Return offsets (m, 3) [mm] of points spaced evenly in a voxel, and the standard deviation of the part of each."""
    counts = np.maximum(np.rint(grid.spacing_mm / apart_mm), 1)
    axes = [(np.arange(n) + 0.5) / n - 0.5 for n in counts]
    steps = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    spread = float(np.sqrt(((grid.spacing_mm / counts) ** 2).mean() / 12))
    return np.asarray(steps @ grid.lps_from_voxel[:3, :3].T), spread


def _start_in_air(patch: _Patch, start: BallCandidate) -> Floats:
    away = np.linalg.norm(patch.middles, axis=1)
    inner, outer = patch.values[away < 0.6 * start.radius_mm], patch.values[away > start.radius_mm + 1]
    level = float(np.median(inner)) if inner.size else float(patch.values.max())
    air = float(np.percentile(outer, 10)) if outer.size else float(patch.values.min())
    return np.array([0.0, 0.0, 0.0, start.radius_mm, 0.3, level, air])


def _start_at_skin(patch: _Patch, start: BallCandidate, *, settings: BallFitSettings) -> Floats | None:
    """Return parameters with a plane between the darker and the brighter part about the ball, if there are two."""
    away = np.linalg.norm(patch.middles, axis=1)
    shell = away > start.radius_mm + 0.7
    if shell.sum() < _ALL:
        return None
    values, places = patch.values[shell], patch.middles[shell]
    alone = _start_in_air(patch, start)
    air, tissue = np.percentile(values, [10, 90])
    if tissue - air < settings.least_span * (alone[5] - alone[6]):
        return None
    design = np.column_stack([np.ones(len(places)), places])
    plane = np.linalg.lstsq(design, np.where(values > (air + tissue) / 2, 1.0, -1.0), rcond=None)[0]
    slope = float(np.linalg.norm(plane[1:]))
    if slope < 1e-6:
        return None
    return np.concatenate([alone[: _BALL - 1], [air, tissue, 0, 0, 0], 2.0 * plane / slope])


def _model(numbers: Floats, patch: _Patch, *, derivatives: bool) -> tuple[Floats, Floats]:
    """Return the intensity (n,) and its derivatives (n, p) with respect to the parameters.

    A ball of radius r under a Gaussian of width s has at the distance d from its centre, with A = (r - d) / s and
    B = (r + d) / s, the value Phi(A) + Phi(B) - 1 - s / d (phi(A) - phi(B)): half of it lies within r, not at r.
    """
    centre, (radius, blur, level, air) = numbers[:3], numbers[3:_BALL]
    off = patch.points - centre
    away = np.maximum(np.sqrt((off**2).sum(axis=-1)), 1e-3)
    # The part of the voxel that a point represents blurs the ball's edge as well.
    wide = np.hypot(blur, patch.point_mm)
    near, far = _density((radius - away) / wide), _density((radius + away) / wide)
    ball = ndtr((radius - away) / wide) + ndtr((radius + away) / wide) - 1 - wide / away * (near - far)
    ball = ball.mean(axis=1)
    skin, tissue = _skin(numbers, patch)
    behind = air + (tissue - air) * skin
    given = behind + (level - behind) * ball
    if not derivatives:
        return given, np.empty((0, 0))
    jacobian = np.empty((len(given), len(numbers)))
    height = level - behind
    inner, outer = (radius - away) / wide * near, (radius + away) / wide * far
    by_away = (wide / away**2 - 1 / wide) * (near - far) - (inner + outer) / away
    bent = (radius - away) / wide * inner - (radius + away) / wide * outer
    by_wide = -(inner + outer) / wide - (near - far + bent) / away
    jacobian[:, :3] = -height[:, None] * (by_away[..., None] * off / away[..., None]).mean(axis=1)
    jacobian[:, 3] = height * (radius / (wide * away) * (near - far)).mean(axis=1)
    jacobian[:, 4] = height * by_wide.mean(axis=1) * blur / wide
    jacobian[:, 5] = ball
    jacobian[:, 6] = (1 - ball) * (1 - skin)
    if len(numbers) == _ALL:
        places = np.column_stack([np.ones(len(given)), patch.middles])
        jacobian[:, 7:11] = ((1 - ball) * skin)[:, None] * places
        steep = (1 - ball) * (tissue - air) * _density(places @ numbers[11:])
        jacobian[:, 11:] = steep[:, None] * places
    return given, jacobian


def _skin(numbers: Floats, patch: _Patch) -> tuple[Floats, Floats]:
    """Return the share (n,) of tissue in each voxel without the ball, and the tissue's level (n,) there."""
    if len(numbers) == _BALL:
        return np.zeros(len(patch.values)), np.zeros(len(patch.values))
    places = np.column_stack([np.ones(len(patch.values)), patch.middles])
    return np.asarray(ndtr(places @ numbers[11:])), places @ numbers[7:11]


def _density(values: Floats) -> Floats:
    return np.asarray(np.exp(-0.5 * values**2) / np.sqrt(2 * np.pi))


def _solved(patch: _Patch, start: Floats, *, settings: BallFitSettings) -> _Solution:
    """Fit by least squares, with less weight for residuals beyond the noise."""
    low, high = _bounds(start, patch, settings=settings)
    numbers, scale = start, settings.robust * max(0.05 * float(np.ptp(patch.values)), 1e-6)
    for _ in range(2):
        even = _evenness(len(start), patch, scale, settings=settings)
        solved = least_squares(
            lambda x, even=even: np.append(_model(x, patch, derivatives=False)[0] - patch.values, even @ x),
            np.clip(numbers, low + 1e-6, high - 1e-6),
            jac=lambda x, even=even: np.vstack([_model(x, patch, derivatives=True)[1], even]),
            bounds=(low, high), x_scale="jac", loss="soft_l1", f_scale=scale, max_nfev=settings.most_steps,
            xtol=1e-6, ftol=1e-6,
        )  # fmt: skip
        numbers = solved.x
        given, jacobian = _model(numbers, patch, derivatives=True)
        residual = given - patch.values
        scale = settings.robust * max(_spread(residual), 1e-9)
    return _Solution(numbers, residual, jacobian, 1 / np.sqrt(1 + (residual / scale) ** 2))


def _bounds(start: Floats, patch: _Patch, *, settings: BallFitSettings) -> tuple[Floats, Floats]:
    """Return lower and upper bounds (p,) of the parameters: the ball stays within its start's radius."""
    span = float(np.ptp(patch.values))
    reach = np.full(len(start), 2 * span)
    reach[:4] = start[3]
    reach[11:] = settings.steepest
    low, high = start - reach, start + reach
    low[4], high[4] = settings.blur_mm
    return low, high


def _evenness(size: int, patch: _Patch, scale: float, *, settings: BallFitSettings) -> Floats:
    """Return the derivatives (3, p), or (0, p) in air, of the residuals of the prior of the tissue's slopes."""
    even = np.zeros((3 if size == _ALL else 0, size))
    if len(even):
        even[:, 8:11] = np.eye(3) * scale / settings.robust / (settings.slope_sd * float(np.ptp(patch.values)))
    return even


def _spread(residual: Floats) -> float:
    """Return the robust standard deviation of residuals."""
    return max(float(1.4826 * np.median(np.abs(residual))), 0.3 * float(residual.std()), 1e-12)


def _covariance(patch: _Patch, best: _Solution, *, settings: BallFitSettings) -> Floats:
    """(p, p) covariance: the sandwich estimator of White and of Newey and West for correlated residuals."""
    even = _evenness(len(best.numbers), patch, settings.robust * _spread(best.residual), settings=settings)
    information = (best.jacobian * best.weight[:, None]).T @ best.jacobian + even.T @ even
    bread = np.linalg.pinv(information, rcond=1e-12, hermitian=True)
    scores = np.zeros((*patch.shape, len(best.numbers)))
    scores[tuple(patch.index.T)] = best.jacobian * (best.weight * best.residual)[:, None]
    near = scores
    lags = np.arange(-settings.bandwidth, settings.bandwidth + 1)
    bartlett = 1 - np.abs(lags) / (settings.bandwidth + 1)
    for axis in range(3):
        near = ndimage.convolve1d(near, bartlett, axis=axis, mode="constant")
    size = len(best.numbers)
    meat = scores.reshape(-1, size).T @ near.reshape(-1, size)
    n = len(patch.values)
    return np.asarray(bread @ (meat + meat.T) / 2 @ bread * n / max(n - size, 1))


def _ball(
    grid: VoxelGrid, patch: _Patch, best: _Solution, start: BallCandidate, *, settings: BallFitSettings
) -> BallFit:
    numbers = best.numbers
    covariance = _covariance(patch, best, settings=settings)
    sds = np.sqrt(np.maximum(np.diag(covariance), 0))
    centre, (radius, blur, level, air) = start.centre_mm + numbers[:3], numbers[3:_BALL].tolist()
    away = np.linalg.norm(patch.middles - numbers[:3], axis=1) - radius
    edge = np.abs(away) < 1.0 + blur
    share, tissue = _bright_beside(patch, away, level, air, settings=settings)
    similar = np.clip((tissue - air) / max(level - air, 1e-12), 0, 1)
    fault = (settings.model_error + settings.model_error_in_tissue * similar) * float(np.hypot(blur, patch.voxel_mm))
    return BallFit(
        centre_mm=centre,
        covariance_mm2=covariance[:3, :3] + np.eye(3) * fault**2,
        radius_mm=radius,
        radius_sd_mm=float(sds[3]),
        level=level,
        air=air,
        tissue=tissue,
        tissue_share=share,
        misfit=float(np.sqrt((best.residual[edge] ** 2).mean()) / max(level - air, 1e-12)) if edge.any() else np.inf,
        seen=_share_within(grid, centre, radius),
    )


def _bright_beside(
    patch: _Patch, away: Floats, level: float, air: float, *, settings: BallFitSettings
) -> tuple[float, float]:
    """Return the share of the voxels just outside a ball that are tissue not much darker than it, and their level.

    It is measured in the voxels, because a thin layer of fat over muscle is not a half space of one level.
    """
    beside = patch.values[(away > settings.beside_mm[0]) & (away < settings.beside_mm[1])]
    bright = beside[beside > air + settings.tissue_share * (level - air)]
    return (len(bright) / len(beside), float(np.percentile(bright, 75))) if len(bright) else (0.0, air)


def _share_within(grid: VoxelGrid, centre_mm: Floats, radius_mm: float) -> float:
    """Return the share of a ball that lies within the image's voxels."""
    depths = (np.arange(6) + 0.5) / 6
    points = np.concatenate([depth ** (1 / 3) * sphere_directions() for depth in depths])
    voxels = grid.voxels(centre_mm + radius_mm * points)
    return float(((voxels > -0.5) & (voxels < np.array(grid.shape[::-1]) - 0.5)).all(axis=1).mean())
