"""Axes of other programs: what their files call x, y and z, in terms of the world (Z up)."""

import numpy as np

from marey.arrays import Floats, frozen

OPENSIM_FROM_WORLD = frozen(np.eye(3)[[1, 2, 0]])
"""OpenSim, Y up: file (x, y, z) = world (Y, Z, X)."""
GLTF_FROM_WORLD = frozen([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
"""glTF and BVH, Y up: file (x, y, z) = world (X, Z, -Y); Blender's importers turn it back into the world's own axes."""


def turned_points(file_from_world: Floats, points: Floats) -> Floats:
    """Express points or vectors (..., 3) in a file's axes."""
    return np.asarray(points, float) @ np.asarray(file_from_world).T


def turned_rotations(file_from_world: Floats, rotations: Floats) -> Floats:
    """Express rotations (..., 3, 3) in a file's axes: the same turns, the identity stays the identity."""
    m = np.asarray(file_from_world)
    return m @ np.asarray(rotations, float) @ m.T
