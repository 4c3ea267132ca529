"""Skin of a person of metaballs in any pose, on their surface in that pose instead of blended from the rest posture."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from marey.arrays import Floats, Integers
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.subdivision import subdivided
from marey.body.articulation.surface import Body
from marey.body.metaballs.metaball_person import required_metaballs, vertex_limbs
from marey.body.metaballs.metaballs import Metaballs, PosedMetaballs

OFF_M = 0.015
"""Vertices farther from the metaballs' surface stay where blending places them: they lie in a crease [m]. Chosen by
hand."""


@dataclass(frozen=True, eq=False)
class MetaballSkin:
    """The metaballs' own surface, with four triangles for each of the body's."""

    body: Body
    """Body over metaballs."""

    @property
    def faces(self) -> Integers:
        """(T, 3)."""
        return self._fine.faces

    @cached_property
    def _fine(self) -> Body:
        return subdivided(self.body)

    @cached_property
    def _limb(self) -> Integers:
        return vertex_limbs(self._fine)

    @cached_property
    def _balls(self) -> Metaballs:
        return required_metaballs(self.body).balls(self.body.numbers)

    def vertices(self, pose: Pose) -> Floats:
        """Return the vertices (V, 3) in a pose [m, world]."""
        blended = PosedBody(self._fine, pose).vertices
        there = PosedMetaballs(self._balls, pose).skin(blended, self._limb)
        near = np.linalg.norm(there - blended, axis=1) < OFF_M
        return np.where(near[:, None], there, blended)
