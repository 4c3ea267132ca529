"""Thickness of cartilage over each vertex of its bone."""

from collections.abc import Sequence

import numpy as np

from marey.arrays import Floats
from marey.errors import MareyError
from marey.knee.space.surface import TriangleSurface
from marey.knee.space.triangle_tree import TriangleTree

REACH_MM = 10.0
"""Distance [mm] from the bone up to which cartilage is followed; chosen by hand."""
BEGIN_MM = 2.5
"""Largest distance [mm] from the bone at which cartilage on it begins, above or, by errors of the meshes, below; chosen
by hand."""


def cartilage_thickness(bone: TriangleSurface, cartilages: Sequence[TriangleSurface]) -> Floats:
    """Measure the thickness of cartilage along the bone's normals.

    From each vertex of the bone a line follows its outward normal, from `BEGIN_MM` below the bone to `REACH_MM` above.
    If it enters a cartilage within `BEGIN_MM` of the bone, the thickness is the distance from there to where it next
    leaves the cartilage; of several cartilages the thickest counts. If it enters none, or does not leave it within
    reach, the thickness is 0: the bone is bare there.

    Args:
        bone: Surface of the bone with N vertices.
        cartilages: Closed surfaces, such as the medial and the lateral one of a tibia.

    Returns:
        (N,) [mm].

    Raises:
        MareyError: No cartilage lies on the bone.
    """
    normals = bone.vertex_normals
    starts = bone.vertices_mm - BEGIN_MM * normals
    thickness = np.zeros(len(starts))
    for cartilage in cartilages:
        crossed = TriangleTree.of(cartilage).crossings(starts, normals, BEGIN_MM + REACH_MM)
        rows = np.arange(len(starts))
        first = np.argmax(crossed.leaving == -1, axis=1)
        begins = crossed.distance_mm[rows, first]
        after = np.minimum(first + 1, crossed.leaving.shape[1] - 1)
        entered = (crossed.leaving[rows, first] == -1) & (begins <= 2 * BEGIN_MM) & (crossed.leaving[rows, after] == 1)
        through = np.where(entered, crossed.distance_mm[rows, after] - begins, 0.0)
        thickness = np.maximum(thickness, through)
    if not thickness.any():
        raise MareyError("The cartilage does not lie on the bone: no line along the bone's normals crosses it.")
    return thickness
