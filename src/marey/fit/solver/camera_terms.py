"""Dependence of a frame's matches on the cameras: the border of the normal equations by camera parameters."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from marey.arrays import Floats, freeze_fields
from marey.body.articulation.pose import PosedBody
from marey.cameras.camera import Camera
from marey.cameras.parameters import PARAMETERS, project_with_slopes, stepped_camera
from marey.fit.solver.pose_solver import CameraMatches
from marey.observations.observation import SurfaceObservation


@dataclass(frozen=True, eq=False, kw_only=True)
class CameraUnknowns:
    """Errors of the cameras in terms of unknowns whose standard deviation is one before the measurement."""

    cameras: tuple[Camera, ...]
    """C cameras, at any size of their images."""
    basis: Floats
    """(15 C, G) change of the cameras' parameters per unknown, see `marey.cameras.parameters`."""
    offset: Floats
    """(G,) present values of the unknowns: how far the cameras are from their prior already."""
    estimated: bool
    """Whether the unknowns are estimated. Otherwise they are not, and their errors enlarge the covariances."""

    def __post_init__(self) -> None:
        freeze_fields(self, "basis", "offset")

    @staticmethod
    def of_covariance(cameras: Sequence[Camera], covariance: Floats) -> "CameraUnknowns":
        """Return the errors of cameras with a covariance (15 C, 15 C), which are not estimated."""
        size = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
        values, vectors = np.linalg.eigh(covariance / size[:, None] / size)
        kept = values > _LEAST_SHARE * values.max()
        basis = size[:, None] * vectors[:, kept] * np.sqrt(values[kept])
        return CameraUnknowns(
            cameras=tuple(cameras), basis=basis, offset=np.zeros(basis.shape[1]), estimated=False
        )  # fmt: skip

    def __len__(self) -> int:
        return int(self.basis.shape[1])

    @cached_property
    def by_camera(self) -> tuple[Floats, ...]:
        """The basis (15, G) of each camera."""
        return tuple(self.basis.reshape(len(self.cameras), PARAMETERS, -1))

    def stepped(self, step: Floats) -> tuple[Camera, ...]:
        """Return the cameras after a step (G,) of the unknowns."""
        return tuple(
            stepped_camera(camera, own @ step) if own.any() else camera
            for camera, own in zip(self.cameras, self.by_camera, strict=True)
        )

    def terms(self, posed: PosedBody, seen: Sequence[CameraMatches], *, shape: bool) -> tuple[Floats, Floats, Floats]:
        """Return the parts of a frame's normal equations that involve the unknowns.

        Args:
            posed: The body.
            seen: The matches of each camera.
            shape: Whether the frame's equations involve the shape.

        Returns:
            (D, G) or (D + M, G) information that links pose and shape with the unknowns, information (G, G) about the
            unknowns, and gradient (G,).
        """
        size = len(posed.body.skeleton) + (len(posed.body.space) if shape else 0)
        cross, own, pull = np.zeros((size, len(self))), np.zeros((len(self), len(self))), np.zeros(len(self))
        for camera, basis, (found, weights) in zip(self.cameras, self.by_camera, seen, strict=False):
            if not basis.any():
                continue
            for match, weight in zip(found, weights, strict=True):
                row = match.linearize(posed, shape=shape)
                repeats = len(row.residual) // max(len(weight), 1)
                share = np.repeat(weight, repeats) / match.sigma**2
                by_camera = _slopes(camera, posed, match) @ basis
                known = np.asarray(np.isfinite(by_camera).all(1))
                by_camera, share = np.where(known[:, None], by_camera, 0.0), np.where(known, share, 0.0)
                weighted = by_camera * share[:, None]
                cross += row.jacobian.T @ weighted
                own += by_camera.T @ weighted
                pull += weighted.T @ row.residual
        return cross, own, pull


_LEAST_SHARE = 1e-12
"""Smallest eigenvalue of the correlations that is used, relative to the largest; numerical."""


def _slopes(camera: Camera, posed: PosedBody, match: SurfaceObservation) -> Floats:
    """Return the derivatives (n r, 15) of residuals by the parameters of the camera in which they were measured.

    A residual is m (pixel of the point - pixel of the contour) for some m in the image, since it is linear in the point
    and does not change along the ray. With the derivative P of the pixel, its row is m P, from which m follows.
    """
    rows, _ = match.constraints(posed)
    _, by_point, slopes = project_with_slopes(camera, posed.points(match.where))
    square = by_point @ np.swapaxes(by_point, 1, 2)
    known = np.isfinite(square).all((1, 2))
    square[~known] = np.eye(2)
    across = np.linalg.solve(square, by_point @ np.swapaxes(rows, 1, 2))
    across[~known] = np.nan
    return np.asarray((np.swapaxes(across, 1, 2) @ slopes).reshape(-1, PARAMETERS))


def with_cameras(
    hessian: Floats, gradient: Floats, terms: tuple[Floats, Floats, Floats], *, size: int
) -> tuple[Floats, Floats]:
    """Append the unknowns of the cameras to a frame's equations.

    Args:
        hessian: (n, n) of pose, and shape and further unknowns if the frame has them.
        gradient: (n,).
        terms: See `CameraUnknowns.terms`.
        size: Number of unknowns before those of the cameras; those that the frame does not have are zero.

    Returns:
        (size + G, size + G) and (size + G,).
    """
    cross, own, pull = terms
    count = len(gradient)
    whole, right = np.zeros((size + len(pull),) * 2), np.zeros(size + len(pull))
    whole[:count, :count], right[:count] = hessian, gradient
    whole[: len(cross), size:], whole[size:, : len(cross)] = cross, cross.T
    whole[size:, size:], right[size:] = own, pull
    return whole, right
