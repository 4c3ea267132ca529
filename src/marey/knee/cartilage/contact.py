"""Where the cartilage of another bone may touch this one's: who has which part of the space between the two."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from marey.arrays import Floats, Mask, freeze_fields
from marey.knee.cartilage.evidence import DEPTHS_MM, THICKEST_MM
from marey.knee.cartilage.prediction import TOLD_SHARE
from marey.knee.space.surface import Surface
from marey.knee.space.triangle_tree import TriangleTree

_LEAST_SD_MM = 0.3
_BONE_MM = 0.5
"""So far before another bone its edge begins to blur."""
_TOUCHING_MM = 0.5
_NEVER = 50.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Contact:
    """What lies across the joint from each vertex, along its normal."""

    away_mm: Floats
    """(V,) to the other bone; infinite where there is none."""
    begins_mm: Floats
    """(V,) where the other bone's cartilage is foretold to begin; infinite where there is none."""
    begins_sd_mm: Floats
    """(V,) standard deviation of that."""

    def __post_init__(self) -> None:
        freeze_fields(self, "away_mm", "begins_mm", "begins_sd_mm")

    @property
    def theirs(self) -> Floats:
        """(V, D) how probable it is that the other bone's cartilage has begun, at `DEPTHS_MM`."""
        return np.asarray(ndtr((DEPTHS_MM[None] - self.begins_mm[:, None]) / self.begins_sd_mm[:, None]))

    @property
    def ends_mm(self) -> Floats:
        """(V,) how far out a profile tells of cartilage."""
        return self.away_mm - _BONE_MM

    def from_above(self, height_mm: Floats) -> "Contact":
        """Look from places (V,) so much farther out along the normals."""
        away, begins = self.away_mm - height_mm, self.begins_mm - height_mm
        return Contact(away_mm=away, begins_mm=begins, begins_sd_mm=self.begins_sd_mm)

    def costs(self, levels_mm: Floats) -> Floats:
        """Return what each thickness costs (V, L) for the other bone that is in its way."""
        return np.where(levels_mm[None] > self.away_mm[:, None], _NEVER, 0.0)

    def reached(self, thickness_mm: Floats) -> Mask:
        """(V,) true where cartilage so thick may touch the other bone's, within a standard deviation."""
        return thickness_mm > self.begins_mm - np.maximum(self.begins_sd_mm, _TOUCHING_MM)


def contact_with(places_mm: Floats, normals: Floats, others: Sequence[tuple[Surface, Floats]]) -> Contact:
    """Look along normals (V, 3) from places (V, 3) for other bones.

    Args:
        places_mm: On this bone.
        normals: Unit.
        others: Bones, and how thick the cartilage on each is foretold to be at its vertices, 0 where it is bare.
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
    return Contact(away_mm=away, begins_mm=begins, begins_sd_mm=np.maximum(TOLD_SHARE * theirs, _LEAST_SD_MM))
