"""Contact of the cartilage of two bones: division of the space between them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from marey.arrays import Floats, freeze_fields
from marey.knee.cartilage.evidence import DEPTHS_MM, THICKEST_MM
from marey.knee.cartilage.prediction import PREDICTED_SD_SHARE
from marey.knee.space.surface import TriangleSurface
from marey.knee.space.triangle_tree import TriangleTree

_LEAST_SD_MM = 0.3
"""Least standard deviation [mm] of where another bone's cartilage begins; chosen by hand."""
_BONE_MM = 0.5
"""Distance [mm] before another bone at which its edge begins to blur; chosen by hand."""
_NEVER = 50.0
"""Cost of a thickness that reaches into another bone, larger than any other cost."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Contact:
    """What lies across the joint from each vertex, along its normal."""

    away_mm: Floats
    """(V,) distance to the other bone; infinite where there is none."""
    begins_mm: Floats
    """(V,) where the other bone's cartilage is predicted to begin; infinite where there is none."""
    begins_sd_mm: Floats
    """(V,) its standard deviation."""

    def __post_init__(self) -> None:
        freeze_fields(self, "away_mm", "begins_mm", "begins_sd_mm")

    @property
    def theirs(self) -> Floats:
        """(V, D) probability that the other bone's cartilage has begun, at `DEPTHS_MM`."""
        return np.asarray(ndtr((DEPTHS_MM[None] - self.begins_mm[:, None]) / self.begins_sd_mm[:, None]))

    @property
    def ends_mm(self) -> Floats:
        """(V,) depth up to which a profile may show cartilage."""
        return self.away_mm - _BONE_MM

    def from_above(self, height_mm: Floats) -> "Contact":
        """Return the contact as seen from origins moved outward along the normals by heights (V,)."""
        away, begins = self.away_mm - height_mm, self.begins_mm - height_mm
        return Contact(away_mm=away, begins_mm=begins, begins_sd_mm=self.begins_sd_mm)

    def costs(self, levels_mm: Floats) -> Floats:
        """Return the cost (V, L) of each thickness due to the other bone, into which it must not reach."""
        return np.where(levels_mm[None] > self.away_mm[:, None], _NEVER, 0.0)

    def divided_mm(self, predicted_mm: Floats) -> Floats:
        """Return the thickness (V,) where two cartilages fill the space between the bones [mm].

        The space is divided in the ratio of this cartilage's predicted thickness (V,) to that of the other. Without
        another cartilage, the result is NaN.
        """
        both = np.isfinite(self.begins_mm)
        away, begins = np.where(both, self.away_mm, 0.0), np.where(both, self.begins_mm, 0.0)
        return np.where(both, away * predicted_mm / (predicted_mm + away - begins), np.nan)


def contact_with(places_mm: Floats, normals: Floats, others: Sequence[tuple[TriangleSurface, Floats]]) -> Contact:
    """Find other bones along normals.

    Args:
        places_mm: (V, 3) on this bone.
        normals: (V, 3) unit vectors.
        others: Bones, and the predicted thickness of the cartilage at the vertices of each, 0 where it is bare.
    """
    away, theirs = np.full(len(places_mm), np.inf), np.zeros(len(places_mm))
    for other, thickness in others:
        tree = TriangleTree.of(other)
        far = tree.crossings(places_mm, normals, 2 * THICKEST_MM).distance_mm[:, 0]
        met = np.isfinite(far) & (far < away)
        if met.any():
            near = tree.nearest(places_mm[met] + far[met, None] * normals[met])
            away[met], theirs[met] = far[met], thickness[other.faces[near.face]].max(1)
    begins = np.where(theirs > 0, away - theirs, np.inf)
    return Contact(away_mm=away, begins_mm=begins, begins_sd_mm=np.maximum(PREDICTED_SD_SHARE * theirs, _LEAST_SD_MM))
