"""Rigid transforms, named `b_from_a`, so that neighbouring names cancel in products."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, freeze_fields
from marey.geometry import rotations


@dataclass(frozen=True, eq=False)
class RigidTransform:
    """A rotation followed by a translation: b_from_a.apply(p_a) = rotation @ p_a + translation."""

    rotation: Floats
    """(3, 3)."""
    translation: Floats
    """(3,) [m]."""

    def __post_init__(self) -> None:
        freeze_fields(self, "rotation", "translation")

    @staticmethod
    def identity() -> "RigidTransform":
        """Return the identity transform."""
        return RigidTransform(np.eye(3), np.zeros(3))

    @staticmethod
    def from_vector(rotation_vector: Floats, translation: Floats) -> "RigidTransform":
        """Return a transform from a rotation vector [rad] and a translation [m]."""
        return RigidTransform(rotations.exp(np.asarray(rotation_vector, float)), translation)

    @staticmethod
    def from_matrix(matrix: Floats) -> "RigidTransform":
        """Return a transform from a homogeneous matrix (4, 4)."""
        matrix = np.asarray(matrix, float)
        return RigidTransform(matrix[:3, :3], matrix[:3, 3])

    @property
    def matrix(self) -> Floats:
        """The homogeneous matrix (4, 4)."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self.rotation, self.translation
        return matrix

    @property
    def rotation_vector(self) -> Floats:
        """The rotation as axis times angle (3,) [rad]."""
        return rotations.log(self.rotation)

    def __matmul__(self, other: "RigidTransform") -> "RigidTransform":
        """Compose: c_from_a = c_from_b @ b_from_a."""
        return RigidTransform(self.rotation @ other.rotation, self.apply(other.translation))

    def apply(self, points: Floats) -> Floats:
        """Transform points (..., 3) from the frame a to the frame b."""
        return np.asarray(points, float) @ self.rotation.T + self.translation

    def inverse(self) -> "RigidTransform":
        """Return a_from_b for b_from_a."""
        return RigidTransform(self.rotation.T, -self.rotation.T @ self.translation)
