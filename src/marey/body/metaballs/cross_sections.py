"""Cross-sections of metaballs at rest: rays, and points evenly spaced on an outline."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from marey.arrays import Floats
from marey.body.articulation.skeleton import LIMBS
from marey.body.metaballs.metaballs import ANY_LIMB, THRESHOLD, PosedMetaballs
from marey.body.metaballs.ray_casting import exits
from marey.errors import MareyError

AROUND_TRUNK = 12
"""Number of units around the trunk, from the front by the left side. A skin has `FINENESS` columns per unit."""
AROUND_LIMB = 8
"""Number of units around a limb."""
OPENINGS = {"left_arm": (2, 4), "right_arm": (8, 10)}
"""Columns of the trunk between which an arm begins [units]; the opening is as high as wide."""
OPENING_ROWS = 2
"""Rows of the trunk across an opening [units]."""
SIDES = {"left": 1.0, "right": -1.0}
"""Sign of the X axis by side."""
FINE = 48
"""Number of rays that measure the length of a cross-section's outline before samples are spaced evenly on it. By
hand."""
_TRUNK_LENGTH = 0.54
"""Distance from pelvis to neck of the generic person [m]; distances in the sections are scaled by the trunk's
length."""
_WELL_INSIDE = 1.2 * THRESHOLD
"""Field above which a point counts as well inside the surface. Chosen by hand."""
DOWN = np.array([0.0, 0.0, -1.0])
"""Downward direction of the rest posture."""
BACK = np.array([0.0, 1.0, 0.0])
"""Backward direction of the rest posture."""

Ring = Callable[[Floats], Floats]
"""Returns the points (n, 3) of a cross-section at angles (n,) [rad]."""


@dataclass(frozen=True, eq=False)
class Caster:
    """Rays on the metaballs of one person at rest."""

    posed: PosedMetaballs
    """The metaballs at rest."""
    samples: int
    """Samples per unit."""
    joints: dict[str, Floats] = field(init=False)
    """Joint centres (3,) by segment [m]."""

    def __post_init__(self) -> None:
        names = self.posed.balls.skeleton.segment_names
        object.__setattr__(self, "joints", dict(zip(names, self.posed.balls.joint_centres, strict=True)))

    @cached_property
    def size(self) -> float:
        """The trunk's length relative to the generic person's."""
        return float(np.linalg.norm(self.joints["neck"] - self.joints["pelvis"]) / _TRUNK_LENGTH)

    def cast(self, part: str, origins: Floats, directions: Floats, limb: str = "", *, reach: float) -> Floats:
        """Cast rays as `exits` does, with an error that names the part if there is no surface."""
        of = LIMBS.index(limb) if limb else ANY_LIMB
        found = exits(self.posed, origins, directions, of, reach=reach * self.size)
        if not np.isfinite(found).all():
            raise MareyError(f"The metaballs leave a gap in the {part}: its skin cannot be sampled.")
        return found

    def deepest(self, point: Floats, way: Floats, limb: str, *, reach: float = 0.05) -> Floats:
        """Return the point (3,) of greatest field on a line through a point, within a distance on both sides."""
        tried = point + np.linspace(-reach, reach, 101)[:, None] * self.size * way
        return np.asarray(tried[np.argmax(self.posed.field(tried, LIMBS.index(limb)))])

    def innermost(self, point: Floats, plane: Floats, limb: str, *, reach: float = 0.04) -> Floats:
        """Return a point (3,) well inside, near a point in a plane (2, 3); the point itself if it is well inside."""
        of = LIMBS.index(limb)
        if self.posed.field(point[None], of)[0] > _WELL_INSIDE:
            return point
        turn, far = np.meshgrid(np.linspace(0, 2 * np.pi, 17)[:-1], np.linspace(0, reach * self.size, 9))
        flat = far.reshape(-1, 1) * np.stack([np.cos(turn).ravel(), np.sin(turn).ravel()], -1)
        tried = point + flat @ plane
        return np.asarray(tried[np.argmax(self.posed.field(tried, of))])


def even_arc(ring: Ring, first: float, last: float, count: int) -> Floats:
    """Return count + 1 points (n, 3) of a cross-section between two angles, evenly spaced on its outline."""
    angles = np.linspace(first, last, FINE + 1)
    steps = np.linalg.norm(np.diff(ring(angles), axis=0), axis=1)
    length = np.concatenate([[0.0], np.cumsum(steps)])
    return ring(np.interp(np.linspace(0.0, length[-1], count + 1), length, angles))


def between(first: Floats, last: Floats, share: Floats) -> Floats:
    """Interpolate by shares (n,) between first (..., 3) and last (..., 3): (n, ..., 3)."""
    share = np.asarray(share).reshape(-1, *(1,) * np.ndim(first))
    return (1.0 - share) * first + share * last


def smooth(share: Floats) -> Floats:
    """Return a cubic step from 0 to 1 with zero slope at its ends."""
    return share * share * (3.0 - 2.0 * share)
