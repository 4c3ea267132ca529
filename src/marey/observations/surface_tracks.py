"""Observations of patches that were tracked on the surface in one camera's images."""

from dataclasses import dataclass
from typing import NamedTuple, final

import numpy as np

from marey.arrays import Floats, Integers
from marey.body.articulation.pose import PosedBody, SkinPoints
from marey.cameras.camera import Camera
from marey.observations.detected_joints import t_weights
from marey.observations.observation import Linearization, Observation


class TrackDerivatives(NamedTuple):
    """First-order model of tracked patches."""

    residual: Floats
    """(n, 2) predicted minus measured [px]."""
    by_pose: Floats
    """(n, 2, D)."""
    by_offset: Floats
    """(n, 2, 2) by the offsets of the tracks on the surface [px/m]."""


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class TrackedPatches(Observation):
    """Patches of the surface in one image, each at an unknown offset from the point to which it was attached.

    A patch is attached to the surface where the body in its first image has it. The error of that pose is the same in
    all its images: it is the offset, an unknown of the track. So the patch measures how the surface moved since then,
    for example how far a limb has turned about its axis, and nothing absolute.
    """

    camera: Camera
    """The camera."""
    tracks: Integers
    """(n,) number of each patch's track."""
    where: SkinPoints
    """(n,) points of the surface to which the patches were attached."""
    segments: Integers
    """(n,) segment that carries each offset."""
    tangents: Floats
    """(n, 3, 2) two directions along the surface, in the segment, in which the offset lies."""
    pixels: Floats
    """(n, 2) measured positions [px]."""
    information: Floats
    """(n, 2, 2) inverse covariance of the positions [1/px2]; it may be zero in one direction."""
    freedom: float = np.inf
    """Degrees of freedom of the t distribution of the errors; infinite for a normal distribution."""

    @property
    def sigma(self) -> float:
        """Standard deviation of a residual, in units of the patches' own standard deviations."""
        return 1.0

    def derivatives(self, posed: PosedBody) -> TrackDerivatives:
        """Predict the positions for offsets of zero; those behind the camera have zero derivatives and residual."""
        seen, by_point = self.camera.project_with_derivative(posed.points(self.where))
        visible = np.isfinite(seen[:, 0])
        by_point = np.where(visible[:, None, None], by_point, 0.0)
        return TrackDerivatives(
            residual=np.where(visible[:, None], seen - self.pixels, 0.0),
            by_pose=posed.constraint_jacobian(self.where, by_point),
            by_offset=by_point @ posed.segment_rotation[self.segments] @ self.tangents,
        )

    def weights(self, residual: Floats) -> Floats:
        """Return the robust weights (n,) of residuals (n, 2) [px]."""
        squares = np.einsum("ni,nij,nj->n", residual, self.information, residual)
        return t_weights(squares, self.freedom)

    def linearize(self, posed: PosedBody, *, shape: bool = False) -> Linearization:
        """Return the first-order model for offsets of zero, in units of the patches' standard deviations.

        Residuals and Jacobian contain the square roots of the robust weights at this pose. The derivatives by the shape
        are zero: how far a patch moves depends little on the sizes of the body.
        """
        found = self.derivatives(posed)
        values, vectors = np.linalg.eigh(self.information)
        root = np.sqrt(np.maximum(values, 0.0))[:, :, None] * np.swapaxes(vectors, 1, 2)
        root = root * np.sqrt(self.weights(found.residual))[:, None, None]
        jacobian = root @ found.by_pose
        if shape:
            jacobian = np.concatenate([jacobian, np.zeros((*jacobian.shape[:2], len(posed.body.space)))], 2)
        residual = (root @ found.residual[..., None])[..., 0]
        return Linearization(residual.ravel(), jacobian.reshape(-1, jacobian.shape[2]))
