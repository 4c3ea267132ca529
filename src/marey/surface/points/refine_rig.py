"""Bundle adjustment of the cameras' relative poses from the matches themselves.

If a camera's pose differs slightly from its calibration, the rays of a patch matched in three images do not intersect.
Only the poses are corrected, as far as these rays determine them; the rest stays as calibrated.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Floats
from marey.cameras.camera import Camera
from marey.cameras.rig import Rig
from marey.cameras.triangulate import triangulate
from marey.errors import SettingProblem
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform
from marey.surface.points.settings import RIG_REFINEMENT_DEFAULTS, RigRefinementSettings

_BASELINE_SD = 1e-6
"""Relative standard deviation of the first free camera's distance from the fixed one, which keeps the scale."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Sighting:
    """Matches of one instant."""

    pixels: Floats
    """(n, C, 2) pixels of the matches [px]; NaN without a match."""
    sigma: Floats
    """(n, C) standard deviations of the pixels [px]."""


@dataclass(frozen=True, eq=False, kw_only=True)
class RigRefinement:
    """Correction of the cameras' poses by the matches."""

    rig: Rig
    """The corrected cameras."""
    rotation: Floats
    """(C,) angle by which each camera was rotated [rad]."""
    shift: Floats
    """(C,) distance by which each camera was moved [m]."""
    moved_px: Floats
    """(C,) displacement of projected points by the correction, root mean square over the matches [px]."""
    residual_before: float
    """Median residual of the forward intersection with the given cameras [px]."""
    residual_after: float
    """Median residual with the corrected cameras [px]."""
    tuples: int
    """Number of matches used."""
    settings: RigRefinementSettings = RIG_REFINEMENT_DEFAULTS
    """Settings with which the correction was estimated."""

    @property
    def significant(self) -> bool:
        """Whether the matches contradict the given cameras significantly."""
        fall = self.residual_before - self.residual_after
        ratio = self.settings.significant_ratio
        return fall >= self.settings.significant_px and self.residual_after <= ratio * self.residual_before


def refine_rig(
    rig: Rig, sightings: Sequence[Sighting], *, fixed: int, settings: RigRefinementSettings = RIG_REFINEMENT_DEFAULTS
) -> RigRefinement | None:
    """Correct the poses of all cameras but one, so that the rays of matches intersect.

    The fixed camera and the baseline of the first other one keep the position and scale of the world; the calibrated
    poses are observations with standard deviations. Instants with large residuals even after the correction (cameras
    not exposed simultaneously) have lower weights, by their own variance.

    Args:
        rig: C cameras as calibrated.
        sightings: Matches, one record per instant; those seen by at least three cameras are used, or all if there are
            none.
        fixed: Index of the camera that is not changed.
        settings: Standard deviations of the calibration, and limits.

    Returns:
        The correction; None with too few matches.

    Raises:
        SettingProblem: The rig has no camera with this index.
    """
    if not 0 <= fixed < len(rig):
        raise SettingProblem(f"The fixed camera is {fixed}, but the rig has the cameras 0 to {len(rig) - 1}.")
    most = settings.most_matches // max(len(sightings), 1)
    sightings = [_most_informative(sighting, most) for sighting in sightings]
    sightings = [sighting for sighting in sightings if len(sighting.pixels)]
    if sum(len(sighting.pixels) for sighting in sightings) < settings.least_matches:
        return None
    cameras = list(rig)
    free = [i for i in range(len(rig)) if i != fixed and any(_shows(s, i) for s in sightings)]
    weights = np.ones(len(sightings))
    for _ in range(settings.rounds):
        normal, right = _prior(rig, cameras, free, fixed, settings)
        for k, sighting in enumerate(sightings):
            system = _system(cameras, sighting, free, weights[k], settings.cauchy_scale)
            normal, right, weights[k] = normal + system[0], right + system[1], 1 / max(1.0, system[2])
        step = np.linalg.solve(normal, right).reshape(-1, 6)
        for i, change in zip(free, step, strict=True):
            pose = RigidTransform.from_vector(change[3:], change[:3]) @ cameras[i].camera_from_world
            cameras[i] = replace(cameras[i], camera_from_world=pose)
    return _compared(rig, Rig(tuple(cameras)), sightings, settings)


def _most_informative(sighting: Sighting, most: int) -> Sighting:
    """Return at most a number of matches, those of three views and more if there are any."""
    views = np.isfinite(sighting.pixels[..., 0]).sum(axis=1)
    kept = np.flatnonzero(views >= (3 if (views >= 3).any() else 2))
    kept = kept[np.linspace(0, len(kept) - 1, min(most, len(kept))).astype(int)]
    return Sighting(pixels=sighting.pixels[kept], sigma=sighting.sigma[kept])


def _shows(sighting: Sighting, camera: int) -> bool:
    return bool(np.isfinite(sighting.pixels[:, camera, 0]).any())


def _prior(
    rig: Rig, cameras: Sequence[Camera], free: Sequence[int], fixed: int, settings: RigRefinementSettings
) -> tuple[Floats, Floats]:
    """Build the normal equations of the calibrated poses, and of the baseline that determines the scale."""
    size = 6 * len(free)
    normal, right = np.zeros((size, size)), np.zeros(size)
    for k, i in enumerate(free):
        away = cameras[i].camera_from_world @ rig.cameras[i].camera_from_world.inverse()
        baseline = float(np.linalg.norm(rig.centres[i] - rig.centres[fixed]))
        turn = settings.rotation_sd_px / float(rig.cameras[i].matrix[0, 0])
        sd = np.repeat([settings.shift_sd_ratio * max(baseline, 1e-9), turn], 3)
        own = slice(6 * k, 6 * k + 6)
        normal[own, own] += np.diag(sd**-2.0)
        right[own] -= np.concatenate([away.translation, away.rotation_vector]) / sd**2
    if free:
        _keep_scale(rig, cameras, free[0], fixed, normal, right)
    return normal, right


def _keep_scale(
    rig: Rig, cameras: Sequence[Camera], first: int, fixed: int, normal: Floats, right: Floats
) -> None:  # fmt: skip
    """Add the constraint that the first free camera keeps its distance from the fixed one."""
    given = float(np.linalg.norm(rig.centres[first] - rig.centres[fixed]))
    apart = cameras[first].centre - cameras[fixed].centre
    now = float(np.linalg.norm(apart))
    # The centre is -R^T t. A translation v of the camera's axes moves it by -R^T v; a rotation w does not move it,
    # because it cancels in centre' = -R^T exp(-w) (exp(w) t + v).
    row = np.zeros(len(right))
    row[:3] = -(cameras[first].camera_from_world.rotation @ (apart / now))
    sd = _BASELINE_SD * given
    normal += np.outer(row, row) / sd**2
    right += row * (given - now) / sd**2


def _system(
    cameras: Sequence[Camera], sighting: Sighting, free: Sequence[int], weight: float, scale_sd: float
) -> tuple[Floats, Floats, float]:
    """Build the normal equations of one instant, reduced by its points; return also its variance factor.

    `scale_sd` is the scale of Cauchy's weights in standard deviations.
    """
    solved = triangulate(cameras, sighting.pixels.swapaxes(0, 1), sigma_px=sighting.sigma.T)
    good = np.isfinite(solved.points[:, 0])
    points, pixels, sigma = solved.points[good], sighting.pixels[good], sighting.sigma[good]
    count, size = len(points), 6 * len(free)
    by_point, by_pose = np.zeros((count, len(cameras), 2, 3)), np.zeros((count, len(cameras), 2, size))
    residual = np.zeros((count, len(cameras), 2))
    for i, camera in enumerate(cameras):
        projected, slope = camera.project_with_derivative(points)
        scale = np.where(np.isfinite(pixels[:, i, 0]), 1 / sigma[:, i], 0.0)
        known = scale > 0
        residual[known, i] = (pixels[known, i] - projected[known]) * scale[known, None]
        by_point[known, i] = slope[known] * scale[known, None, None]
        if i in free:
            at = 6 * free.index(i)
            by_pose[known, i, :, at : at + 6] = _by_pose(camera, points[known], by_point[known, i])
    squares = np.sum(residual**2, axis=(1, 2))
    freedom = 2 * np.isfinite(pixels[..., 0]).sum(axis=1) - 3
    factor = float(np.median(squares / freedom)) / 0.79
    robust = weight / (1 + squares * weight / freedom / scale_sd**2)
    rows = 2 * len(cameras)
    point, pose, left = (
        by_point.reshape(count, rows, 3),
        by_pose.reshape(count, rows, size),
        residual.reshape(count, -1),
    )
    both = np.einsum("nri,nrj->nij", point, pose)
    own = np.einsum("nri,nr->ni", point, left)
    share = np.linalg.solve(np.einsum("nri,nrj->nij", point, point), both)
    normal = np.einsum("n,nri,nrj->ij", robust, pose, pose) - np.einsum("n,nki,nkj->ij", robust, both, share)
    right = np.einsum("n,nri,nr->i", robust, pose, left) - np.einsum("n,nki,nk->i", robust, share, own)
    return normal, right, factor


def _by_pose(camera: Camera, points: Floats, by_point: Floats) -> Floats:
    """Differentiate pixels (n, 2, 6) by a translation and a rotation of the camera's axes."""
    pose = camera.camera_from_world
    by_axes = by_point @ pose.rotation.T
    return np.concatenate([by_axes, -by_axes @ rotations.hat(pose.apply(points))], axis=-1)


def _compared(given: Rig, found: Rig, sightings: Sequence[Sighting], settings: RigRefinementSettings) -> RigRefinement:
    moved = [new.camera_from_world @ old.camera_from_world.inverse() for new, old in zip(found, given, strict=True)]
    before, after = (_residuals(rig, sightings) for rig in (given, found))
    return RigRefinement(
        rig=found,
        rotation=np.array([np.linalg.norm(motion.rotation_vector) for motion in moved]),
        shift=np.linalg.norm(found.centres - given.centres, axis=1),
        moved_px=_moved_px(given, found, sightings),
        residual_before=before,
        residual_after=after,
        tuples=sum(len(sighting.pixels) for sighting in sightings),
        settings=settings,
    )


def _residuals(rig: Rig, sightings: Sequence[Sighting]) -> float:
    """Return the median over the instants of their median residuals [px]."""
    return float(
        np.median(
            [
                np.nanmedian(triangulate(rig.cameras, s.pixels.swapaxes(0, 1), sigma_px=s.sigma.T).residual_px)
                for s in sightings
            ]
        )
    )


def _moved_px(given: Rig, found: Rig, sightings: Sequence[Sighting]) -> Floats:
    pixels = np.concatenate([s.pixels for s in sightings]).swapaxes(0, 1)
    sigma = np.concatenate([s.sigma for s in sightings]).T
    points = triangulate(found.cameras, pixels, sigma_px=sigma).points
    apart = [new.project(points) - old.project(points) for new, old in zip(found, given, strict=True)]
    return np.array([np.sqrt(np.nanmean(np.sum(d**2, axis=-1))) for d in apart])
