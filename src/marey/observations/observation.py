"""Interface of all observations, in any unit."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import final

import numpy as np

from marey.arrays import Floats
from marey.body.articulation.pose import PosedBody, SkinPoints
from marey.compiled.kernels import kernel


@dataclass(frozen=True, eq=False)
class Linearization:
    """First-order model of an observation: r(x + d) = residual + jacobian d.

    Example:
        >>> import numpy as np
        >>> import marey
        >>> marey.Linearization(residual=np.array([0.02]), jacobian=np.zeros((1, 48))).jacobian.shape
        (1, 48)
    """

    residual: Floats
    """(m,) predicted minus measured, in the observation's own unit."""
    jacobian: Floats
    """(m, D) by the pose, or (m, D + M) by pose and shape; columns as `PosedBody.moved` takes them."""


class Observation(ABC):
    """A batch of measurements of one kind in one frame, with their uncertainty and their prediction.

    A new kind of observation is a subclass with `sigma` and `linearize`. It is given by frame to
    `marey.capture(trial, observations={frame: [observation, ...]})`.

    Example:
        The height of a joint was measured, with a standard deviation of 5 mm:

        >>> import numpy as np
        >>> import marey
        >>> class JointHeight(marey.Observation):
        ...     sigma = 0.005
        ...
        ...     def __init__(self, segment, height_m):
        ...         self.segment, self.height_m = segment, height_m
        ...
        ...     def linearize(self, posed, *, shape=False):
        ...         residual = posed.segment_origin[self.segment][2:] - self.height_m
        ...         jacobian = posed.pose_jacobian(*posed.joint_parts(np.array([self.segment])))[:, 2]
        ...         if shape:
        ...             jacobian = np.hstack([jacobian, posed.origin_shape_jacobian()[self.segment, 2:]])
        ...         return marey.Linearization(residual, jacobian)
        >>> JointHeight(segment=4, height_m=1.62).sigma
        0.005
    """

    @property
    @abstractmethod
    def sigma(self) -> float:
        """Standard deviation of one residual, in the residual's own unit."""

    @abstractmethod
    def linearize(self, posed: PosedBody, *, shape: bool = False) -> Linearization:
        """Predict the measurements, with the derivative of the prediction by the pose (and the shape)."""

    @final
    def whiten(self, posed: PosedBody, *, shape: bool = False) -> Linearization:
        """Linearise in units of sigma, so that residuals of different units can be combined."""
        raw = self.linearize(posed, shape=shape)
        return Linearization(raw.residual / self.sigma, raw.jacobian / self.sigma)


class AngleObservation(Observation):
    """Measurements of the joint angles, one of each; their Jacobian is diagonal."""

    @abstractmethod
    def by_angle(self, posed: PosedBody) -> tuple[Floats, Floats]:
        """Return the residuals (D - 6,) and their derivatives (D - 6,) by the angles."""

    @final
    def linearize(self, posed: PosedBody, *, shape: bool = False) -> Linearization:
        """Return the linearisation with the full Jacobian."""
        residual, slope = self.by_angle(posed)
        jacobian = np.zeros((len(slope), 6 + len(slope) + (len(posed.body.space) if shape else 0)))
        jacobian[np.arange(len(slope)), 6 + np.arange(len(slope))] = slope
        return Linearization(residual, jacobian)


class SurfaceObservation(Observation):
    """Measurements that are linear in points of the body's surface: r = rows p - offsets.

    All of them enter the least squares through the same moments ([Rosenhahn2006] eq. (10), for any kind that is linear
    in the point), see `fit.solver.moments`.

    Example:
        The heights of points of the surface were measured, with a standard deviation of 1 cm:

        >>> import numpy as np
        >>> import marey
        >>> class PointHeights(marey.SurfaceObservation):
        ...     sigma = 0.01
        ...
        ...     def __init__(self, where, heights_m):
        ...         self.where, self.heights_m = where, heights_m
        ...
        ...     def constraints(self, posed):
        ...         rows = np.tile([[[0.0, 0.0, 1.0]]], (len(self.where), 1, 1))
        ...         return rows, self.heights_m[:, None]
    """

    where: SkinPoints
    """The n points of the surface."""

    @abstractmethod
    def constraints(self, posed: PosedBody) -> tuple[Floats, Floats]:
        """Return rows (n, r, 3) and offsets (n, r), so that the residuals are rows p - offsets."""

    @final
    def residuals(self, posed: PosedBody) -> Floats:
        """Return the residuals (n, r)."""
        rows, offsets = self.constraints(posed)
        return np.asarray(residuals(np.ascontiguousarray(rows), offsets, posed.points(self.where)))

    @final
    def linearize(self, posed: PosedBody, *, shape: bool = False) -> Linearization:
        """Combine the constraints with the derivatives of the surface points."""
        rows, offsets = self.constraints(posed)
        residual = residuals(np.ascontiguousarray(rows), offsets, posed.points(self.where))
        jacobian = posed.constraint_jacobian(self.where, rows, shape=shape)
        return Linearization(residual.ravel(), jacobian.reshape(-1, jacobian.shape[2]))


# Short: see `marey.compiled.kernels.kernel`.
@kernel(nogil=False)
def residuals(rows, offsets, points):
    """Return rows p - offsets (n, r) for rows (n, r, 3), offsets (n, r) and points (n, 3)."""
    out = np.empty(offsets.shape)
    for i in range(rows.shape[0]):
        for r in range(rows.shape[1]):
            out[i, r] = (
                rows[i, r, 0] * points[i, 0]
                + rows[i, r, 1] * points[i, 1]
                + rows[i, r, 2] * points[i, 2]
                - offsets[i, r]
            )
    return out
