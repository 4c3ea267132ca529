"""All cameras of a rig refined by the tangents that their silhouettes share, without a body.

The outermost planes through two camera centres that touch a body touch both of its silhouettes ([Sinha2010]). With
approximate cameras, these contradictions determine poses and focal lengths up to place, orientation and scale of
the cameras as a whole.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from marey.arrays import Floats
from marey.cameras.camera import Camera
from marey.cameras.parameters import stepped_camera
from marey.fit.cameras.from_joints import UNKNOWNS, block_basis, camera_basis
from marey.fit.cameras.frontier import BIAS_PX, SilhouetteHulls, tangent_differences
from marey.fit.cameras.refine import motions_as_a_whole
from marey.fit.solver.weights import SCALE_IN_SD, geman_mcclure
from marey.geometry.rigid import RigidTransform

TANGENT_ROUNDS = 30
"""Largest number of Gauss-Newton steps. Chosen by hand."""
TANGENTS_SETTLED = 1e-4
"""Largest step that ends the iteration [rad, m, 1]."""
DISTINCT = 5.0
"""Number of successive frames whose silhouettes have about the same errors. Chosen by hand."""
LEAST_NOISE_PX = 0.2
"""Least standard deviation of a difference, which is otherwise estimated from the median of all [px]. Chosen by
hand."""
_SD_OF_MEDIAN = 1.4826
"""Standard deviation of normal deviations in medians of their sizes."""
_DIFFERENCE = np.array([1e-4] * 3 + [1e-3] * 3 + [1e-3])
"""Steps of the numerical derivatives [rad, m, 1]."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SilhouetteCameras:
    """Cameras that were refined by silhouettes."""

    cameras: tuple[Camera, ...]
    covariance: Floats
    """(15 C, 15 C) of the cameras' parameters, in the world in which the cameras as a whole are at rest, at their
    scale."""
    before_px: float
    """Median difference of the tangents before [px]."""
    after_px: float
    """Median difference of the tangents after [px]."""


def refine_by_tangents(
    cameras: Sequence[Camera], covariance: Floats, hulls: Sequence[SilhouetteHulls],
    *, rounds: int = TANGENT_ROUNDS, progress: Callable[[], object] = lambda: None,
) -> SilhouetteCameras:  # fmt: skip
    """Refine all cameras together by the tangents that their silhouettes share.

    Args:
        cameras: C cameras in approximate poses.
        covariance: (15 C, 15 C) of their parameters beforehand, singular for the cameras as a whole.
        hulls: Their silhouettes.
        rounds: Largest number of steps.
        progress: Called after each step.

    Returns:
        The cameras.
    """
    current, lenses = list(cameras), list(cameras)
    pairs = list(combinations(range(len(cameras)), 2))
    basis = block_basis(cameras)
    inverse = np.linalg.pinv(basis)
    unit = np.sqrt(np.maximum(np.diag(inverse @ covariance @ inverse.T), 1e-18))
    free = motions_as_a_whole(basis * unit, cameras)[1]
    known = (free.T / unit) @ inverse @ covariance @ inverse.T @ (free / unit[:, None])
    count = free.shape[1]
    prior, offset = np.eye(count + 2 * len(pairs)), np.zeros(count + 2 * len(pairs))
    prior[:count, :count] = np.linalg.inv(known)
    # Silhouettes repeat their errors: the differences of each pair and side have an unknown constant part.
    shared = BIAS_PX * np.eye(2 * len(pairs)).reshape(len(pairs), 1, 2, -1).repeat(len(hulls[0].border), axis=1)
    before = _median(_differences(current, lenses, hulls, pairs))
    for _ in range(rounds):
        residual = _differences(current, lenses, hulls, pairs) + shared @ offset[count:]
        slopes = _slopes(current, lenses, hulls, pairs)
        jacobian = np.concatenate([np.tensordot(slopes, unit[:, None] * free, axes=(3, 0)), shared], axis=-1)
        good = np.isfinite(residual) & np.isfinite(jacobian).all(axis=-1)
        rows, right = jacobian[good], residual[good]
        noise = max(LEAST_NOISE_PX, _SD_OF_MEDIAN * float(np.median(np.abs(right)))) if len(right) else LEAST_NOISE_PX
        weight = geman_mcclure(right, SCALE_IN_SD * noise) / (DISTINCT * noise**2)
        information = rows.T @ (rows * weight[:, None]) + prior
        step = -np.linalg.solve(information, rows.T @ (weight * right) + prior @ offset)
        offset = offset + step
        current = _stepped(current, unit * (free @ step[:count]))
        progress()
        if np.abs(unit * (free @ step[:count])).max() < TANGENTS_SETTLED:
            break
    own = np.linalg.inv(information)[:count, :count]
    spread = block_basis(current) @ (unit[:, None] * free)
    return SilhouetteCameras(
        cameras=tuple(current), covariance=spread @ own @ spread.T, before_px=before,
        after_px=_median(_differences(current, lenses, hulls, pairs)),
    )  # fmt: skip


def _stepped(cameras: Sequence[Camera], step: Floats) -> list[Camera]:
    own = step.reshape(-1, UNKNOWNS)
    return [stepped_camera(camera, camera_basis(camera) @ each) for camera, each in zip(cameras, own, strict=True)]


def _differences(
    cameras: Sequence[Camera], lenses: Sequence[Camera], hulls: Sequence[SilhouetteHulls],
    pairs: Sequence[tuple[int, int]],
) -> Floats:  # fmt: skip
    """Return the differences (P, F, 2) of tangents [px] for hulls that were found with other focal lengths."""
    own = [refocused(hull, before, after) for hull, before, after in zip(hulls, lenses, cameras, strict=True)]
    return tangent_differences(cameras, own, pairs)


def refocused(hull: SilhouetteHulls, before: Camera, after: Camera) -> SilhouetteHulls:
    """Return a hull for another focal length of its camera.

    Args:
        hull: The hull.
        before: The camera with which it was found.
        after: The camera with the other focal length.
    """
    if np.array_equal(before.matrix, after.matrix):
        return hull
    pixels = replace(before, camera_from_world=RigidTransform.identity()).project(hull.directions)
    straight = after.undistort(pixels)
    rays = np.concatenate([straight, np.ones_like(straight[..., :1])], axis=-1)
    turn = hull.turn_per_pixel * before.matrix[0, 0] / after.matrix[0, 0]
    return replace(hull, directions=rays / np.linalg.norm(rays, axis=-1, keepdims=True), turn_per_pixel=float(turn))


def _slopes(
    cameras: Sequence[Camera], lenses: Sequence[Camera], hulls: Sequence[SilhouetteHulls],
    pairs: Sequence[tuple[int, int]],
) -> Floats:  # fmt: skip
    """Return the derivatives (P, F, 2, 7 C) of the differences by the cameras' unknowns."""
    slopes = np.zeros((len(pairs), len(hulls[0].border), 2, UNKNOWNS * len(cameras)))
    for c, camera in enumerate(cameras):
        involved = [p for p, pair in enumerate(pairs) if c in pair]
        some = [pairs[p] for p in involved]
        for k in range(UNKNOWNS):
            sides = []
            for sign in (1, -1):
                changed = list(cameras)
                changed[c] = stepped_camera(camera, sign * _DIFFERENCE[k] * camera_basis(camera)[:, k])
                sides.append(_differences(changed, lenses, hulls, some))
            slopes[involved, :, :, UNKNOWNS * c + k] = (sides[0] - sides[1]) / (2 * _DIFFERENCE[k])
    return slopes


def _median(differences: Floats) -> float:
    """Return the median size of differences [px]."""
    known = np.abs(differences[np.isfinite(differences)])
    return float(np.median(known)) if len(known) else float("nan")
