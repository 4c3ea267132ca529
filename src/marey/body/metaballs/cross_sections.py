"""Cross-sections of metaballs at rest: rays of one person, and points spread evenly on an outline."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from marey.arrays import Floats
from marey.body.articulation.skeleton import LIMBS
from marey.body.metaballs.metaballs import ANY_LIMB, THRESHOLD, PosedMetaballs
from marey.body.metaballs.ray_casting import exits
from marey.errors import MareyError

AROUND_TRUNK, AROUND_LIMB = 12, 8
"""Units around the trunk, from the front by the left side, and around a limb. A skin has so many columns a unit."""
OPENINGS = {"left_arm": (2, 4), "right_arm": (8, 10)}
"""The columns [units] of the trunk between which an arm begins; the opening is as many units high as wide."""
OPENING_ROWS = 2
SIDES = {"left": 1.0, "right": -1.0}
FINE = 48
"""Rays by which the length of a cross-section's outline is measured before samples are spread evenly on it."""
_TRUNK_LENGTH = 0.54
"""Pelvis to neck of the generic person [m]; distances below are this person's, and grow with the trunk."""
_WELL_INSIDE = 1.2 * THRESHOLD
DOWN, BACK = np.array([0.0, 0.0, -1.0]), np.array([0.0, 1.0, 0.0])

Ring = Callable[[Floats], Floats]
"""Gives the points (n, 3) of a cross-section at angles (n,)."""


@dataclass(frozen=True, eq=False)
class Caster:
    """Rays on the metaballs of one person at rest."""

    posed: PosedMetaballs
    samples: int
    """A unit."""
    joints: dict[str, Floats] = field(init=False)
    """By segment."""

    def __post_init__(self) -> None:
        names = self.posed.balls.skeleton.segment_names
        object.__setattr__(self, "joints", dict(zip(names, self.posed.balls.joint_centres, strict=True)))

    @cached_property
    def size(self) -> float:
        """The trunk's length beside the generic person's."""
        return float(np.linalg.norm(self.joints["neck"] - self.joints["pelvis"]) / _TRUNK_LENGTH)

    def cast(self, part: str, origins: Floats, directions: Floats, limb: str = "", *, reach: float) -> Floats:
        """Cast rays as `exits` does, and name the part that has no surface there."""
        of = LIMBS.index(limb) if limb else ANY_LIMB
        found = exits(self.posed, origins, directions, of, reach=reach * self.size)
        if not np.isfinite(found).all():
            raise MareyError(f"The metaballs leave a gap in the {part}: its skin cannot be sampled.")
        return found

    def deepest(self, point: Floats, way: Floats, limb: str, *, reach: float = 0.05) -> Floats:
        """Give the point (3,) of greatest field on a line through a point, as far as some way off to either side."""
        tried = point + np.linspace(-reach, reach, 101)[:, None] * self.size * way
        return tried[np.argmax(self.posed.field(tried, LIMBS.index(limb)))]

    def innermost(self, point: Floats, plane: Floats, limb: str, *, reach: float = 0.04) -> Floats:
        """Give a point (3,) well inside, near a point in a plane (2, 3): the point itself, unless it lies outside."""
        of = LIMBS.index(limb)
        if self.posed.field(point[None], of)[0] > _WELL_INSIDE:
            return point
        turn, far = np.meshgrid(np.linspace(0, 2 * np.pi, 17)[:-1], np.linspace(0, reach * self.size, 9))
        flat = far.reshape(-1, 1) * np.stack([np.cos(turn).ravel(), np.sin(turn).ravel()], -1)
        tried = point + flat @ plane
        return np.asarray(tried[np.argmax(self.posed.field(tried, of))])


def even_arc(ring: Ring, first: float, last: float, count: int) -> Floats:
    """Give count + 1 points (n, 3) of a cross-section from one angle to another, evenly spaced on its outline."""
    angles = np.linspace(first, last, FINE + 1)
    steps = np.linalg.norm(np.diff(ring(angles), axis=0), axis=1)
    length = np.concatenate([[0.0], np.cumsum(steps)])
    return ring(np.interp(np.linspace(0.0, length[-1], count + 1), length, angles))


def between(first: Floats, last: Floats, share: Floats) -> Floats:
    """Go shares (n,) of the way from first (..., 3) to last (..., 3): (n, ..., 3)."""
    share = np.asarray(share).reshape(-1, *(1,) * np.ndim(first))
    return (1.0 - share) * first + share * last


def smooth(share: Floats) -> Floats:
    """Rise from 0 to 1 with level ends."""
    return share * share * (3.0 - 2.0 * share)


def unit(vector: Floats) -> Floats:
    """Give a vector (..., 3) the length one."""
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)
