"""Pixels of points in calibrated cameras as measurements of the homogeneous factorisation."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Mask
from marey.cameras.camera import Camera
from marey.cameras.triangulate import triangulate
from marey.compiled.kernels import kernel
from marey.geometry import rotations

FAR = 9.0
"""Squared distance, in variances, beyond which the weight of a pixel falls with its square. Three standard deviations;
chosen by hand, results were not measured against other values."""
_POSE_REGULARISATION = 1e-9
"""Added to the normal matrix of a pose [px2]; keeps it solvable."""


@dataclass(frozen=True, kw_only=True)
class PixelPlacesSettings:
    """Settings of initial positions and poses; chosen by hand, results were not measured against other values."""

    missed: float = 5.0
    """Rays that miss each other by more than this many standard deviations do not determine an initial position."""
    least_parallax: float = 1e-3
    """Least eigenvalue of the normal matrix of one camera's rays, from all frames, that determine a position: the sum
    of their squared angles about their mean [rad2]."""
    pose_points: int = 6
    """Least number of points of known shape from which a frame's pose is initialised by its neighbour's."""
    pose_steps: int = 15
    """Number of Gauss-Newton steps of that pose."""


class PixelPlaces:
    """Pixels of P points over F frames in C calibrated cameras.

    Args:
        cameras: The C cameras.
        pixels: (C, F, P, 2) [px]; NaN where not seen.
        sigma: (C, F, P) standard deviation of a pixel's coordinate [px].
        settings: Tuned constants.
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        pixels: Floats,
        sigma: Floats,
        settings: PixelPlacesSettings = PixelPlacesSettings(),
    ) -> None:
        self.cameras, self.sigma, self.settings = tuple(cameras), sigma, settings
        self._by_view: Mask = np.asarray(np.isfinite(pixels).all(-1) & np.isfinite(sigma))
        self.pixels = np.where(self._by_view[..., None], pixels, np.nan)
        self._weight = np.where(self._by_view, 1 / np.where(self._by_view, sigma, 1.0) ** 2, 0.0)
        self._views = self._by_view.sum(0)
        self._seen: Mask = np.asarray(self._views > 0)
        frames, points = self._seen.shape
        flat = self.pixels.reshape(len(self.cameras), -1, 2)
        found = triangulate(self.cameras, flat, sigma_px=sigma.reshape(len(flat), -1))
        # Rays that miss each other by far include an outlier, and do not determine a position.
        self._known = np.where(self._met(found.residual_px)[:, None], found.points, np.nan).reshape(frames, points, 3)
        self._known_variance: Floats = np.trace(found.covariance, axis1=1, axis2=2).reshape(frames, points)

    def _met(self, residual: Floats) -> Mask:
        """Find the points (n,) whose rays meet within their accuracy; `residual` (n,) is their mean distance [px]."""
        count = np.maximum(self._views.reshape(-1), 1)
        stated = np.where(self._by_view, self.sigma, 0).sum(0).reshape(-1) / count
        return np.asarray(np.nan_to_num(residual, nan=np.inf) <= self.settings.missed * stated)

    @property
    def seen(self) -> Mask:
        """(F, P) mask of the points that any camera saw."""
        return self._seen

    @property
    def coordinates(self) -> int:
        """Two per view, at most three per point."""
        return int(np.minimum(2 * self._views, 3).sum())

    @property
    def known(self) -> Floats:
        """(F, P, 3) points where the rays of two or more cameras meet [m]."""
        return self._known

    @property
    def known_variance(self) -> Floats:
        """(F, P) trace of the covariance of these points [m2]."""
        return self._known_variance

    def projected(self, model: Floats) -> Floats:
        """Project points (F, P, 3) into the images, (C, F, P, 2) [px]."""
        return np.stack([camera.project(model) for camera in self.cameras])

    def equations(self, model: Floats, variance: float) -> tuple[Floats, Floats]:
        """Compute information (F, P, 3, 3) and right-hand side (F, P, 3), allowing for the variance about the model."""
        flat = np.ascontiguousarray(model, float).reshape(-1, 3)
        normal, pull = np.zeros((len(flat), 3, 3)), np.zeros((len(flat), 3))
        for camera, pixels, weight in zip(self.cameras, self.pixels, self._weight, strict=True):
            projected, slope = camera.project_with_derivative(flat)
            residual = pixels.reshape(-1, 2) - projected
            add_rays(residual, slope, weight.reshape(-1), float(variance), normal, pull)
        see_through(float(variance), normal, pull)
        return normal.reshape(*self._seen.shape, 3, 3), pull.reshape(*self._seen.shape, 3)

    def squares(self, model: Floats) -> Floats:
        """Compute the mean squared distance in the images over the views (F, P) [px2]."""
        squared = ((self.pixels - self.projected(model)) ** 2).sum(-1)
        there = np.isfinite(squared)
        count = there.sum(0)
        return np.where(count > 0, np.where(there, squared, 0).sum(0) / np.maximum(count, 1), np.nan)

    def without(self, hidden: Mask) -> "PixelPlaces":
        """Return the pixels without the points in the mask, in all views."""
        shown = np.where(hidden[..., None], np.nan, self.pixels)
        return PixelPlaces(self.cameras, shown, self.sigma, self.settings)

    def among(self, frames: Mask, points: Mask) -> "PixelPlaces":
        """Return the pixels of some frames and points."""
        chosen = np.ix_(np.ones(len(self.cameras), bool), frames, points)
        return PixelPlaces(self.cameras, self.pixels[chosen], self.sigma[chosen], self.settings)

    def placed(self, mean: Floats, rotation: Floats, translation: Floats) -> tuple[Floats, Floats, Floats]:
        """Initialise frames in which too few rays meet by their neighbours, and points that no two cameras saw.

        Such a point is placed where its rays of all frames, in the object's frame, come nearest to each other: the
        motion of the object shows it from several sides.
        """
        posed = np.isfinite(rotation[:, 0, 0])
        if not posed.any():
            return mean, rotation, translation
        missing = np.isnan(mean[:, 0])
        mean = mean.copy()
        mean[missing] = self._from_all_frames(rotation, translation, posed)[missing]
        rotation, translation = rotation.copy(), translation.copy()
        enough = (self._seen & np.isfinite(mean[:, 0])).sum(1) >= self.settings.pose_points
        answered = np.flatnonzero(posed)
        # from the frames with a pose outwards, each initialised by its neighbour on that side
        distance = np.abs(np.arange(len(posed))[:, None] - answered)
        for frame in np.argsort(distance.min(1), kind="stable"):
            if posed[frame] or not enough[frame]:
                continue
            solved = np.flatnonzero(np.isfinite(rotation[:, 0, 0]))
            near = solved[np.abs(solved - frame).argmin()]
            rotation[frame], translation[frame] = self._pose(int(frame), mean, rotation[near], translation[near])
        return mean, rotation, translation

    def _pose(self, frame: int, mean: Floats, rotation: Floats, translation: Floats) -> tuple[Floats, Floats]:
        """Fit the rigid shape to one frame's pixels by a few Gauss-Newton steps with reduced weights of outliers."""
        used = self._seen[frame] & np.isfinite(mean[:, 0])
        shape, pixels = mean[used], self.pixels[:, frame, used]
        for _ in range(self.settings.pose_steps):
            normal, right = _POSE_REGULARISATION * np.eye(6), np.zeros(6)
            turned = -rotation @ rotations.hat(shape)
            moves = np.concatenate([turned, np.broadcast_to(np.eye(3), turned.shape)], -1)
            for camera, seen in zip(self.cameras, pixels, strict=True):
                at, slope = camera.project_with_derivative(shape @ rotation.T + translation)
                residual = np.nan_to_num(seen - at)
                squares = (residual**2).sum(1)
                share = 1 / (1 + squares / max(float(np.median(squares)), 1.0))
                jacobian = np.nan_to_num(slope) @ moves * np.isfinite(seen - at)[..., None]
                normal = normal + np.einsum("n,nij,nik->jk", share, jacobian, jacobian)
                right = right + np.einsum("n,nij,ni->j", share, jacobian, residual)
            step = np.linalg.solve(normal, right)
            rotation, translation = rotation @ rotations.exp(step[:3]), translation + step[3:]
        return rotation, translation

    def _from_all_frames(self, rotation: Floats, translation: Floats, posed: Mask) -> Floats:
        """Compute the points (P, 3) of the object nearest to their rays of all frames; NaN where rays are parallel."""
        points = self._seen.shape[1]
        normal, right = np.zeros((points, 3, 3)), np.zeros((points, 3))
        for camera, pixels in zip(self.cameras, self.pixels, strict=True):
            direction = camera.rays(pixels).directions @ rotation
            used = np.isfinite(direction[..., 0]) & posed[:, None]
            direction = np.where(used[..., None], direction, 0.0)
            centre = np.einsum("fji,fj->fi", rotation, camera.centre - translation)
            across = used[..., None, None] * np.eye(3) - direction[..., None] * direction[..., None, :]
            normal += across.sum(0)
            right += np.einsum("fpij,fj->pi", across, np.where(posed[:, None], centre, 0.0))
        fixed = np.linalg.eigvalsh(normal)[:, 0] > self.settings.least_parallax
        found = np.full((points, 3), np.nan)
        found[fixed] = np.linalg.solve(normal[fixed], right[fixed][..., None])[..., 0]
        return found


@kernel
def add_rays(
    residual: Floats, slope: Floats, weight: Floats, variance: float, normal: Floats, pull: Floats
) -> None:  # pragma: no cover - compiled
    """Add the pixels of one camera to the normal equations of points.

    A pixel far from the model, relative to its noise and the variance about the model, has a reduced weight.

    Args:
        residual: (n, 2) pixel minus that of the model [px]; NaN where not seen.
        slope: (n, 2, 3) derivative of the pixel [px/m].
        weight: (n,) inverse variance of the pixel [1/px2].
        variance: Variance of a coordinate about the model [m2].
        normal: (n, 3, 3) normal matrices [1/m2]; changed in place.
        pull: (n, 3) right-hand sides [1/m]; changed in place.
    """
    for i in range(len(residual)):
        w, x, y = weight[i], residual[i, 0], residual[i, 1]
        if not (w > 0.0 and np.isfinite(x + y)):
            continue
        a, b = slope[i, 0], slope[i, 1]
        inflation = 1.0 + 0.5 * w * variance * (a @ a + b @ b)
        w *= FAR / max(FAR, w * (x * x + y * y) / inflation)
        for j in range(3):
            pull[i, j] += w * (a[j] * x + b[j] * y)
            for k in range(3):
                normal[i, j, k] += w * (a[j] * a[k] + b[j] * b[k])


@kernel
def see_through(variance: float, normal: Floats, pull: Floats) -> None:  # pragma: no cover - compiled
    """Convert normal equations of points into those of the model, about which the points have a variance.

    Both are multiplied by the inverse of I + variance * normal, in place.

    Args:
        variance: Variance of a coordinate about the model [m2].
        normal: (n, 3, 3) [1/m2].
        pull: (n, 3) [1/m].
    """
    for i in range(len(normal)):
        n = normal[i]
        a, b, c = 1.0 + variance * n[0, 0], variance * n[0, 1], variance * n[0, 2]
        d, e, f = 1.0 + variance * n[1, 1], variance * n[1, 2], 1.0 + variance * n[2, 2]
        xx, xy, xz = d * f - e * e, c * e - b * f, b * e - c * d
        yy, yz, zz = a * f - c * c, b * c - a * e, a * d - b * b
        determinant = a * xx + b * xy + c * xz
        x, y, z = pull[i]
        pull[i, 0] = (xx * x + xy * y + xz * z) / determinant
        pull[i, 1] = (xy * x + yy * y + yz * z) / determinant
        pull[i, 2] = (xz * x + yz * y + zz * z) / determinant
        for k in range(3):
            x, y, z = n[0, k], n[1, k], n[2, k]
            n[0, k] = (xx * x + xy * y + xz * z) / determinant
            n[1, k] = (xy * x + yy * y + yz * z) / determinant
            n[2, k] = (xz * x + yz * y + zz * z) / determinant
