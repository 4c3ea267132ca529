"""Observations of joints that a detector found in an image, with a constant offset from the body's own joints."""

from dataclasses import dataclass
from typing import final

import numpy as np

from marey.arrays import Floats, Integers
from marey.body.articulation.pose import PosedBody
from marey.cameras.camera import Camera
from marey.observations.observation import Linearization, Observation

JOINT_FREEDOM = 3.0
"""Degrees of freedom of the t distribution of a detector's errors: some points lie on another limb or person.

Chosen by hand; results were not measured against other values.
"""


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class DetectedJoints(Observation):
    """Detected joints of one person in one camera's image, by the collinearity equations and with robust weights.

    A detector's hip is not the body's hip: each point lies at a constant offset from the body's joint centre, in the
    frame of the segment that ends there.
    """

    camera: Camera
    """The camera."""
    segments: Integers
    """(n,) segments at whose proximal joint centres the points lie."""
    offsets: Floats
    """(n, 3) offset of each point from the joint centre, in the frame of the segment's parent [m]."""
    pixels: Floats
    """(n, 2) [px]."""
    sd_px: Floats
    """(n,) standard deviation of each point, per axis [px]."""
    freedom: float = JOINT_FREEDOM
    """Degrees of freedom of the t distribution of the errors; infinite for a normal distribution."""

    @property
    def sigma(self) -> float:
        """Standard deviation of a residual, in units of the points' own standard deviations."""
        return 1.0

    def predict(self, posed: PosedBody) -> Floats:
        """Return the positions (n, 3) of the points on a posed body [m, world]."""
        rotations = posed.segment_rotation[posed.body.skeleton.parents[self.segments]]
        offsets = np.einsum("nij,nj->ni", rotations, self.offsets)
        return np.asarray(posed.segment_origin[self.segments] + offsets)

    def linearize(self, posed: PosedBody, *, shape: bool = False) -> Linearization:
        """Project the points; those behind the camera have zero residual and Jacobian.

        Residuals and Jacobian contain the square roots of the robust weights at this pose.
        """
        seen, by_point = self.camera.project_with_derivative(self.predict(posed))
        residual, visible = (seen - self.pixels) / self.sd_px[:, None], np.isfinite(seen[:, 0])
        weight = np.where(visible, np.sqrt(t_weights(np.sum(residual**2, axis=1), self.freedom)), 0.0)
        moved = posed.pose_jacobian(*self._parts(posed))
        if shape:
            moved = np.concatenate([moved, posed.origin_shape_jacobian()[self.segments]], 2)
        residual = np.where(visible[:, None], residual, 0.0) * weight[:, None]
        by_point = np.where(visible[:, None, None], by_point, 0.0) * (weight / self.sd_px)[:, None, None]
        jacobian = by_point @ moved
        return Linearization(residual.ravel(), jacobian.reshape(-1, jacobian.shape[2]))

    def _parts(self, posed: PosedBody) -> tuple[Integers, Floats]:
        """Return the points in the form of `PosedBody.parts`, each carried by the parent of its segment."""
        rest, parents = posed.body.joint_centres, posed.body.skeleton.parents[self.segments]
        part = np.ones((len(self.segments), 1, 4))
        part[:, 0, :3] = rest[self.segments] - rest[parents] + self.offsets
        return np.ascontiguousarray(parents[:, None]), part


def t_weights(squares: Floats, freedom: float = JOINT_FREEDOM) -> Floats:
    """Return the weights (n,) of points in the image whose errors have a t distribution.

    Args:
        squares: (n,) squared distances, in variances per axis.
        freedom: Degrees of freedom; infinite for a normal distribution, whose weights are one.
    """
    return np.asarray((1.0 + 2.0 / freedom) / (1.0 + squares / freedom))
