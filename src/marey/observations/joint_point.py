"""Observations of joint centres in images, clicked or detected."""

from dataclasses import dataclass
from typing import final

import numpy as np

from marey.arrays import Floats, Integers
from marey.body.articulation.pose import PosedBody
from marey.cameras.camera import Camera
from marey.observations.observation import Linearization, Observation


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class JointPoints(Observation):
    """Joint centres in one camera's image, by the collinearity equations."""

    camera: Camera
    """The camera."""
    segments: Integers
    """(n,) segments whose proximal joint centres are observed."""
    pixels: Floats
    """(n, 2) [px]."""
    sigma_px: float
    """Standard deviation of a click; joints are hidden under the skin [px]."""

    @property
    def sigma(self) -> float:
        """Standard deviation of a residual [px]."""
        return self.sigma_px

    def linearize(self, posed: PosedBody, *, shape: bool = False) -> Linearization:
        """Project the joint centres; those behind the camera have zero residual and Jacobian."""
        seen, by_point = self.camera.project_with_derivative(posed.segment_origin[self.segments])
        moved = posed.pose_jacobian(*posed.joint_parts(self.segments))
        if shape:
            moved = np.concatenate([moved, posed.origin_shape_jacobian()[self.segments]], 2)
        residual, jacobian = seen - self.pixels, by_point @ moved
        hidden = np.isnan(seen[:, 0])
        residual[hidden], jacobian[hidden] = 0.0, 0.0
        return Linearization(residual.ravel(), jacobian.reshape(-1, jacobian.shape[2]))
