"""Conversion from the world's axes (Z up) to the axes of other file formats."""

import numpy as np

from marey.arrays import Floats, frozen

OPENSIM_FROM_WORLD = frozen(np.eye(3)[[1, 2, 0]])
"""Rotation into OpenSim's axes, Y up: file (x, y, z) = world (Y, Z, X)."""
GLTF_FROM_WORLD = frozen([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
"""Rotation into the axes of glTF and BVH, Y up: file (x, y, z) = world (X, Z, -Y); Blender's importers undo it."""


def change_point_axes(file_from_world: Floats, points: Floats) -> Floats:
    """Express points or vectors in the axes of a file.

    Args:
        file_from_world: (3, 3) rotation into the axes of the file.
        points: (..., 3) in the world's axes.

    Returns:
        (..., 3) in the axes of the file.
    """
    return np.asarray(points, float) @ np.asarray(file_from_world).T


def change_rotation_axes(file_from_world: Floats, rotations: Floats) -> Floats:
    """Express rotations in the axes of a file, so that the identity remains the identity.

    Args:
        file_from_world: (3, 3) rotation into the axes of the file.
        rotations: (..., 3, 3) in the world's axes.

    Returns:
        (..., 3, 3) in the axes of the file.
    """
    m = np.asarray(file_from_world)
    return np.asarray(m @ np.asarray(rotations, float) @ m.T)
