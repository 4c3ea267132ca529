"""Prediction of the subject's cartilage: the thickness of a template's, mapped by the deformation."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, freeze_fields
from marey.knee.registration.deformation import Deformation
from marey.knee.space.mesh_graph import MeshGraph
from marey.knee.space.surface import TriangleSurface
from marey.knee.space.triangle_tree import TriangleTree, corner_weights

PREDICTED_SD_SHARE = 1 / 3
"""Standard deviation of the predicted thickness, as a share of it ([Alexander2003])."""
RIM_MM = 3.0
"""Standard deviation [mm] of the predicted position of the cartilage's rim; chosen by hand."""
FARTHEST_RIM_MM = 12.0
"""Distance [mm] beyond the predicted rim from which cartilage is not searched; chosen by hand."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CartilagePrediction:
    """Predicted cartilage at each vertex of the subject's bone."""

    thickness_mm: Floats
    """(V,) thickness if there is cartilage; beyond the rim that of nearby cartilage; NaN far from all cartilage."""
    presence: Floats
    """(V,) probability of cartilage, from 0 to 1."""

    def __post_init__(self) -> None:
        freeze_fields(self, "thickness_mm", "presence")


def predict_cartilage(
    bone: TriangleSurface, template: TriangleSurface, thickness_mm: Floats, deformation: Deformation | None = None
) -> CartilagePrediction:
    """Map a template's cartilage to the subject's bone ([Alexander2003] section 2.1).

    Unlike the paper, the template's normals are not mapped: thickness is measured along the subject's own.

    Args:
        bone: Surface of the subject's bone.
        template: The template's bone, rigidly registered to the subject's.
        thickness_mm: (N,) at the template's vertices, 0 where it is bare.
        deformation: Result of the elastic registration; None where the template is the subject's own shape.
    """
    vertices = bone.vertices_mm
    places = vertices if deformation is None else deformation.template_points(vertices)
    near = TriangleTree.of(template).nearest(places)
    corners = template.faces[near.face]
    weights = corner_weights(template.corners_mm[near.face], near.points_mm)
    covered = np.einsum("vk,vk->v", weights, (thickness_mm > 0)[corners].astype(float))
    thickness = np.einsum("vk,vk->v", weights, thickness_mm[corners])
    graph = MeshGraph.of(bone)
    presence = graph.smoothed((covered > 0.5).astype(float), RIM_MM)
    about = graph.filled(thickness, (covered > 0.99).astype(float), RIM_MM)
    reach = graph.smoothed((covered > 0.5).astype(float), FARTHEST_RIM_MM / 2)
    expected = np.where(covered > 0.99, thickness, about)
    return CartilagePrediction(
        thickness_mm=np.where(reach > 0.02, expected, np.nan),
        presence=np.where(reach > 0.02, presence, 0.0),
    )
