"""Contradictions between cameras at the frontier points of silhouettes, and a camera found again by them.

The outermost planes through the centres of two cameras that touch a body touch both of its silhouettes ([Sinha2010]).
Where they do not, one of the cameras is not where its calibration places it. Nothing has to be known of the body.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np

from marey.arrays import Floats, Mask, freeze_fields
from marey.cameras.camera import Camera
from marey.cameras.epipolar import EpipolarPlanes
from marey.cameras.parameters import pose_basis, stepped_camera
from marey.fit.clocks.signals import BORDER_PX, CLEAR_PX, WIDEST, outline_pixels
from marey.fit.solver.weights import geman_mcclure

EDGE_PX = 0.5
"""Distance from the outermost pixels of a silhouette to its outline [px]."""
FINDING_STEPS = 30
"""Largest number of Gauss-Newton steps. Chosen by hand."""
SETTLED_RAD = 1e-4
"""Largest turn in the last step [rad]. Chosen by hand."""
LEAST_SCALE_PX = 3.0
"""Least scale of the robust weights [px]. Chosen by hand."""
BIAS_PX = 1.0
"""Standard deviation of the part of the differences of one pair and side that all frames share, from errors that the
silhouettes repeat [px]. Chosen by hand. On `jacks` and `reach`, whose people stay in one place, the orientations of
cameras found again were up to 2.3 degrees off."""
TURN_SD_RAD, SHIFT_SD_M = 0.2, 0.5
"""Standard deviations of the displacement of a camera before the measurement [rad, m]. Chosen by hand: they only hold
what the silhouettes do not determine."""
_DIFFERENCE_RAD, _DIFFERENCE_M = 1e-4, 1e-3
"""Steps of the numerical derivatives [rad, m]."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SilhouetteHulls:
    """The convex hulls of one camera's silhouettes, whose tangents are those of the silhouettes."""

    directions: Floats
    """(F, K, 3) unit directions of the corners in camera axes; NaN beyond the last corner of a frame."""
    border: Mask
    """(F, K) true for corners at the border of the image."""
    turn_per_pixel: float
    """Angle by which a ray turns per pixel [rad/px]."""

    def __post_init__(self) -> None:
        freeze_fields(self, "directions")
        freeze_fields(self, "border", dtype=np.bool_)

    @staticmethod
    def of(camera: Camera, masks: Iterable[Mask]) -> "SilhouetteHulls":
        """Find the hulls of silhouettes (height, width)."""
        found = [_hull(mask) for mask in masks]
        pixels = np.full((len(found), max([len(own) for own in found] + [1]), 2), np.nan)
        for f, own in enumerate(found):
            pixels[f, : len(own)] = own
        straight = camera.undistort(pixels)
        rays = np.concatenate([straight, np.ones_like(straight[..., :1])], axis=-1)
        return SilhouetteHulls(
            directions=rays / np.linalg.norm(rays, axis=-1, keepdims=True),
            border=np.isfinite(pixels[..., 0]) & ~camera.sees(pixels, margin=BORDER_PX),
            turn_per_pixel=float(2 / (camera.matrix[0, 0] + camera.matrix[1, 1])),
        )  # fmt: skip

    def tangents(self, camera: Camera, planes: EpipolarPlanes) -> tuple[Floats, Floats]:
        """Return the outermost planes that touch the silhouettes.

        Args:
            camera: The camera, at any place.
            planes: The planes through its centre and that of another camera.

        Returns:
            The least and greatest angle (F, 2) [rad], and their change per pixel (F, 2) [rad/px]; NaN if unknown.
        """
        angle, lever = planes.angles(self.directions @ camera.camera_from_world.rotation)
        across = np.nansum(lever * np.sin(angle), axis=1), np.nansum(lever * np.cos(angle), axis=1)
        middle = np.arctan2(*across)[:, None]
        beside = np.angle(np.exp(1j * (angle - middle)))
        known = np.isfinite(beside).any(axis=1)
        low, high = np.where(np.isnan(beside), np.inf, beside), np.where(np.isnan(beside), -np.inf, beside)
        frames = np.arange(len(beside))
        found, per_pixel = np.full((len(beside), 2), np.nan), np.full((len(beside), 2), np.nan)
        narrow = known & (np.where(known, high.max(axis=1), 0) - np.where(known, low.min(axis=1), 0) < WIDEST)
        for side, (corner, sign) in enumerate(((low.argmin(axis=1), -1), (high.argmax(axis=1), 1))):
            own, arm = beside[frames, corner], lever[frames, corner]
            near = np.abs(beside - own[:, None]) * arm[:, None] < CLEAR_PX * self.turn_per_pixel
            good = narrow & ~(near & self.border).any(axis=1)
            step = self.turn_per_pixel / np.where(good, arm, 1.0)
            found[good, side] = (own + middle[:, 0] + sign * EDGE_PX * step)[good]
            per_pixel[good, side] = step[good]
        return found, per_pixel


def _hull(mask: Mask) -> Floats:
    pixels = outline_pixels(mask)
    return cv2.convexHull(pixels.astype(np.float32))[:, 0].astype(float) if len(pixels) else pixels


def tangent_differences(
    cameras: Sequence[Camera], hulls: Sequence[SilhouetteHulls], pairs: Iterable[tuple[int, int]]
) -> Floats:
    """Return by how much the tangent planes of pairs of cameras differ.

    Args:
        cameras: C cameras.
        hulls: Their silhouettes.
        pairs: P pairs of cameras.

    Returns:
        (P, F, 2) differences of both sides, as seen in images [px]; NaN if unknown.
    """
    found = []
    for i, j in pairs:
        planes = EpipolarPlanes.between(cameras[i], cameras[j])
        if planes is None:
            found.append(np.full((len(hulls[i].directions), 2), np.nan))
            continue
        first, one = hulls[i].tangents(cameras[i], planes)
        second, other = hulls[j].tangents(cameras[j], planes)
        found.append(np.angle(np.exp(1j * (first - second))) / np.hypot(one, other))
    return np.array(found)


@dataclass(frozen=True, eq=False, kw_only=True)
class FoundCamera:
    """A camera that was found again by its silhouettes."""

    camera: Camera
    covariance: Floats
    """(6, 6) of its rotation about its centre, in its axes [rad], and of its centre in the world [m]."""
    before_px: float
    """Median difference of the tangents before [px]."""
    after_px: float
    """Median difference of the tangents with the camera in its new place [px]."""


def find_camera(cameras: Sequence[Camera], hulls: Sequence[SilhouetteHulls], moved: int) -> FoundCamera:
    """Find the position and orientation of a camera by the tangents that it shares with the others.

    Args:
        cameras: C cameras; all but one are right.
        hulls: Their silhouettes.
        moved: The other one.

    Returns:
        The camera, with a covariance that contains errors that the silhouettes repeat in all frames.
    """
    pairs = [pair for pair in combinations(range(len(cameras)), 2) if moved in pair]
    signals = np.broadcast_to(np.arange(2 * len(pairs)).reshape(-1, 1, 2), (len(pairs), len(hulls[0].border), 2))
    current, prior = list(cameras), np.diag([TURN_SD_RAD**-2.0] * 3 + [SHIFT_SD_M**-2.0] * 3)
    before = _median(tangent_differences(current, hulls, pairs))
    for _ in range(FINDING_STEPS):
        residual = tangent_differences(current, hulls, pairs)
        jacobian = _slopes(current, hulls, pairs, moved)
        known = np.isfinite(residual) & np.isfinite(jacobian).all(axis=0)
        rows, right = jacobian[:, known].T, residual[known]
        scale = max(LEAST_SCALE_PX, 2.0 * float(np.median(np.abs(right)))) if len(right) else LEAST_SCALE_PX
        weight = geman_mcclure(right, scale)
        information = rows.T @ (rows * weight[:, None]) + prior
        step = -np.linalg.solve(information, rows.T @ (weight * right))
        current[moved] = stepped_camera(current[moved], pose_basis(current[moved]) @ step)
        if np.abs(step[:3]).max() < SETTLED_RAD:
            break
    inverse = np.linalg.inv(information)
    pulls = np.array([(rows * weight[:, None])[signals[known] == s].sum(axis=0) for s in range(2 * len(pairs))])
    covariance = inverse + BIAS_PX**2 * inverse @ pulls.T @ pulls @ inverse
    after = _median(tangent_differences(current, hulls, pairs))
    return FoundCamera(camera=current[moved], covariance=covariance, before_px=before, after_px=after)


def _slopes(
    cameras: Sequence[Camera], hulls: Sequence[SilhouetteHulls], pairs: Sequence[tuple[int, int]], moved: int
) -> Floats:
    """Return the derivatives (6, P, F, 2) of the differences by rotation and shift of a camera."""
    basis, slopes = pose_basis(cameras[moved]), []
    for k in range(6):
        step = _DIFFERENCE_RAD if k < 3 else _DIFFERENCE_M
        sides = []
        for sign in (1, -1):
            changed = list(cameras)
            changed[moved] = stepped_camera(cameras[moved], sign * step * basis[:, k])
            sides.append(tangent_differences(changed, hulls, pairs))
        slopes.append((sides[0] - sides[1]) / (2 * step))
    return np.array(slopes)


def _median(differences: Floats) -> float:
    """Return the median over frames of the differences' size, the largest one over pairs and sides [px]."""
    sizes = [np.median(own[np.isfinite(own)]) for own in _by_signal(np.abs(differences)) if np.isfinite(own).any()]
    return float(max(sizes, default=np.nan))


def _by_signal(differences: Floats) -> Floats:
    """Return differences (P, F, 2) as (2 P, F)."""
    return np.moveaxis(differences, 2, 1).reshape(-1, differences.shape[1])


def pair_sizes(differences: Floats) -> Floats:
    """Return for each pair the larger side's median over frames of the differences' size (P,) [px]; NaN if unknown."""
    return np.array([_median(own[None]) for own in differences])
