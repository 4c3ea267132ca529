"""Observations of patches that were tracked on the surface in one camera's images."""

from dataclasses import dataclass, replace
from typing import NamedTuple, final

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.body.articulation.pose import PosedBody, SkinPoints
from marey.cameras.camera import Camera
from marey.observations.observation import Linearization, Observation


class TrackDerivatives(NamedTuple):
    """First-order model of tracked patches."""

    residual: Floats
    """(n, 2) predicted minus measured [px]."""
    by_pose: Floats
    """(n, 2, D) or (n, 2, D + M)."""
    by_offset: Floats
    """(n, 2, 3) by the offsets of the tracks [px/m]."""


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
    directions: Floats
    """(n, 3, 3) unit vectors of the offset in the segment: two along the surface, and the one across it, scaled by the
    ratio of the standard deviations."""
    pixels: Floats
    """(n, 2) measured positions [px]."""
    information: Floats
    """(n, 2, 2) inverse covariance of the positions [1/px2]; it may be zero in one direction."""

    def __getitem__(self, which: Mask) -> "TrackedPatches":
        return self._with({name: np.asarray(values)[which] for name, values in self._arrays().items()})

    def joined(self, other: "TrackedPatches") -> "TrackedPatches":
        """Return these patches and those of another batch of the same camera."""
        more = other._arrays()
        return self._with({name: np.concatenate([values, more[name]]) for name, values in self._arrays().items()})

    def _arrays(self) -> dict[str, np.ndarray]:
        own = {name: getattr(self, name) for name in ("tracks", "segments", "directions", "pixels", "information")}
        return {**own, "face": self.where.face, "barycentric": self.where.barycentric}

    def _with(self, arrays: dict[str, np.ndarray]) -> "TrackedPatches":
        return replace(
            self,
            tracks=arrays["tracks"],
            where=SkinPoints(face=arrays["face"], barycentric=arrays["barycentric"]),
            segments=arrays["segments"],
            directions=arrays["directions"],
            pixels=arrays["pixels"],
            information=arrays["information"],
        )

    @property
    def sigma(self) -> float:
        """Standard deviation of a residual, in units of the patches' own standard deviations."""
        return 1.0

    def before_motion(self, late: PosedBody, posed: PosedBody) -> "TrackedPatches":
        """Return the patches where they would have been seen before a known motion.

        Args:
            late: The body when the image was taken.
            posed: The body before the motion.
        """
        motion = self.camera.project(late.points(self.where)) - self.camera.project(posed.points(self.where))
        return replace(self, pixels=self.pixels - np.nan_to_num(motion))

    def derivatives(self, posed: PosedBody, *, shape: bool = False) -> TrackDerivatives:
        """Predict the positions for offsets of zero; those behind the camera have zero derivatives and residual.

        Args:
            posed: The body.
            shape: Whether the columns of the shape parameters are appended to the derivatives by the pose.
        """
        seen, by_point = self.camera.project_with_derivative(posed.points(self.where))
        visible = np.isfinite(seen[:, 0])
        by_point = np.where(visible[:, None, None], by_point, 0.0)
        return TrackDerivatives(
            residual=np.where(visible[:, None], seen - self.pixels, 0.0),
            by_pose=posed.constraint_jacobian(self.where, by_point, shape=shape),
            by_offset=by_point @ posed.segment_rotation[self.segments] @ self.directions,
        )

    def linearize(self, posed: PosedBody, *, shape: bool = False) -> Linearization:
        """Return the first-order model for offsets of zero, in units of the patches' standard deviations."""
        found = self.derivatives(posed, shape=shape)
        values, vectors = np.linalg.eigh(self.information)
        root = np.sqrt(np.maximum(values, 0.0))[:, :, None] * np.swapaxes(vectors, 1, 2)
        jacobian, residual = root @ found.by_pose, root @ found.residual[..., None]
        return Linearization(residual.ravel(), jacobian.reshape(-1, jacobian.shape[2]))
