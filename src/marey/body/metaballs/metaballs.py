"""Metaballs: ellipsoids on the segments whose fields sum to one smooth surface, and its derivatives."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from marey.arrays import Floats, Integers, freeze_fields, frozen
from marey.body.articulation import kinematics
from marey.body.articulation.pose import Pose, PosedSegments
from marey.body.articulation.skeleton import LIMBS, PackedSkeleton, Skeleton
from marey.body.metaballs import metaball_field

THRESHOLD = metaball_field.THRESHOLD
"""Value of the field on the surface; see `metaball_field`."""
ANY_LIMB = -1
"""Limb of a point that is not assigned to one."""
_STEPS = 12
"""Largest number of steps by which a point is moved onto the surface."""
_LONGEST = 0.01
"""Longest of these steps [m]."""
_CLOSE = 1e-6
"""Distance from the surface at which they end [m]."""


class Linearized(NamedTuple):
    """A residual of n points, with its derivatives by everything that moves the surface of M balls on S segments."""

    residual: Floats
    """(n,)."""
    by_point: Floats
    """(n, 3) by the point, in the world."""
    by_centre: Floats
    """(n, M, 3) by the balls' centres, in their segments."""
    by_radii: Floats
    """(n, M, 3) by the balls' radii."""
    by_weight: Floats
    """(n, M) by the balls' weights."""
    by_shift: Floats
    """(n, S, 3) by the shift of each segment alone, in the world."""
    by_turn: Floats
    """(n, S, 3) by the rotation of each segment alone about the world's axes through the point itself."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Metaballs:
    """Ellipsoidal metaballs, each attached to a segment ([Plaenkers1999] section 3.4).

    The field of a ball at a point that lies y from its centre along its axes is w exp(-2 d), d = sum (y_a / l_a)^2
    ([Plaenkers1999] eq. (6), (7)), and the surface is where the fields sum to 1/2 (eq. (4), (5)). A ball of weight 1
    alone reaches 0.59 of its radii.

    Unlike the paper, whose points are all assigned to a limb beforehand, the field at a point includes the balls of the
    trunk and of one limb only, the point's own or else the one whose field is greatest there. An arm that touches the
    thigh, or one leg beside the other, therefore does not merge with it.
    """

    skeleton: Skeleton
    """The skeleton."""
    joint_centres: Floats
    """(S, 3) at rest [m]."""
    segment: Integers
    """(M,) the segment that carries each ball."""
    centre: Floats
    """(M, 3) in the segment, from its joint centre [m]."""
    rotation: Floats
    """(M, 3, 3) segment from ball; the columns are the ball's axes, the last one along the bone."""
    radii: Floats
    """(M, 3) along the ball's axes [m]."""
    weight: Floats
    """(M,) 1 in the paper; a larger one with smaller radii has the same size and a sharper edge."""

    def __post_init__(self) -> None:
        freeze_fields(self, "joint_centres", "centre", "rotation", "radii", "weight")
        freeze_fields(self, "segment", dtype=np.int64)
        if not (np.all(self.radii > 0.0) and np.all(self.weight > 0.0)):
            raise ValueError("radii and weights of metaballs must be positive")

    def __len__(self) -> int:
        """Return the number of balls."""
        return len(self.segment)

    @cached_property
    def limb(self) -> Integers:
        """(M,) index in `LIMBS` of the limb to which each ball belongs."""
        return frozen(self.skeleton.segment_limb[self.segment], np.int64)

    @property
    def packed(self) -> PackedSkeleton:
        """The skeleton as plain arrays."""
        return self.skeleton.packed

    def at_rest(self) -> "PosedMetaballs":
        """Return the balls in the rest posture."""
        free = len(self.skeleton.coordinates)
        return PosedMetaballs(self, Pose(self.joint_centres[0], np.eye(3), np.zeros(free)))


@dataclass(frozen=True, eq=False)
class PosedMetaballs(PosedSegments):
    """Metaballs in a pose: the field, distances from the surface, and the derivatives of both."""

    balls: Metaballs
    pose: Pose

    @property
    def carrier(self) -> Metaballs:
        """The balls, whose segments are posed."""
        return self.balls

    @property
    def world_axes(self) -> Floats:
        """(D - 6, 3) axes of the joint coordinates in the world."""
        return self._segments[2]

    @cached_property
    def place(self) -> Floats:
        """(M, 3) the balls' centres in the world [m]."""
        segment = self.balls.segment
        turned = np.einsum("mab,mb->ma", self.segment_rotation[segment], self.balls.centre)
        return np.asarray(self.segment_origin[segment] + turned)

    @cached_property
    def axes(self) -> Floats:
        """(M, 3, 3) the balls' axes in the world, one per row."""
        turned = self.segment_rotation[self.balls.segment] @ self.balls.rotation
        return np.ascontiguousarray(np.swapaxes(turned, 1, 2))

    def _field_arguments(self, points: Floats, limb: Integers | int) -> tuple[Any, ...]:
        balls = self.balls
        points = np.ascontiguousarray(points, float)
        limbs = np.ascontiguousarray(np.broadcast_to(np.asarray(limb, np.int64), len(points)))
        return points, limbs, len(LIMBS), balls.limb, self.place, self.axes, balls.radii, balls.weight

    def field(self, points: Floats, limb: Integers | int = ANY_LIMB) -> Floats:
        """Return the field (n,) at points (n, 3) of the world ([Plaenkers1999] eq. (5)), 1/2 on the surface.

        Args:
            points: (n, 3) [m].
            limb: (n,) index in `LIMBS` of the limb to which each point belongs; with `ANY_LIMB`, or on the trunk, the
                limb whose field is greatest there.
        """
        return np.asarray(THRESHOLD * np.exp(metaball_field.levels(*self._field_arguments(points, limb))))

    def distance(self, points: Floats, limb: Integers | int = ANY_LIMB) -> Floats:
        """Return the distances of points outside the surface (n,) [m], see `distances`; limb as in `field`."""
        return np.asarray(metaball_field.distances(*self._field_arguments(points, limb)))

    def shares(self, points: Floats, limb: Integers | int = ANY_LIMB) -> Floats:
        """Return each ball's share of the field (n, M) at points (n, 3), of sum one; limb as in `field`."""
        return np.asarray(metaball_field.shares(*self._field_arguments(points, limb)))

    def nearest_limbs(self, points: Floats) -> tuple[Integers, Floats]:
        """Return the limb (n,), an index in `LIMBS`, whose own field is greatest at points (n, 3), and outward normals.

        Returns:
            (n,), and (n, 3) of length one.
        """
        arguments = self._field_arguments(points, ANY_LIMB)
        found: tuple[Integers, Floats] = metaball_field.nearest_limbs(arguments[0], *arguments[2:])
        return found

    def distances(self, points: Floats, limb: Integers | int = ANY_LIMB) -> Linearized:
        """Return the distances of points outside the surface [m], to first order, and their derivatives.

        The residual is ln(1/2 / F) / |grad ln F| with the field F. Unlike the paper, whose residual F - 1/2
        (`potentials`) has no unit and no slope far from the body, it is a distance for which an observation's standard
        deviation can be given in metres. It is exact to first order near the surface; for a point far outside it is
        about half the distance. Deep inside, where the field is flat, the slope is bounded from below
        (`metaball_field.CORE`), so that no residual exceeds a few centimetres.

        Args:
            points: (n, 3) in the world [m].
            limb: See `field`.
        """
        return self._linearized(points, limb, as_distance=True)

    def potentials(self, points: Floats, limb: Integers | int = ANY_LIMB) -> Linearized:
        """Return F - 1/2 ([Plaenkers1999] eq. (13), without unit) and its derivatives; arguments as in `distances`."""
        return self._linearized(points, limb, as_distance=False)

    def onto_surface(self, points: Floats, limb: Integers | int = ANY_LIMB) -> Floats:
        """Project points (n, 3) near the surface onto it, along its normals; limb as in `field`.

        A point on a crease between two limbs may remain a millimetre away.
        """
        points = np.array(points, float)
        arguments = self._field_arguments(points, limb)
        for _ in range(_STEPS):
            if metaball_field.step_onto(points, *arguments[1:], _LONGEST) < _CLOSE:
                break
        return points

    def skin(self, points: Floats, limb: Integers | int = ANY_LIMB) -> Floats:
        """Project points (n, 3) onto the surface as `onto_surface` does, faster, along the field's own gradient."""
        points = np.array(points, float)
        arguments = self._field_arguments(points, limb)
        metaball_field.bring_onto(points, *arguments[1:], _STEPS, _LONGEST, _CLOSE)
        return points

    def _linearized(self, points: Floats, limb: Integers | int, *, as_distance: bool) -> Linearized:
        arguments = self._field_arguments(points, limb)
        n, m, s = len(points), len(self.balls), len(self.balls.skeleton.segment_names)
        shapes = ((n,), (n, 3), (n, m, 3), (n, m, 3), (n, m), (n, s, 3), (n, s, 3))
        out = Linearized(*(np.zeros(shape) for shape in shapes))
        metaball_field.linearize(*arguments, self.balls.segment, self.balls.rotation, as_distance, *out)
        return out

    def by_pose(self, points: Floats, of: Linearized) -> Floats:
        """Return the derivatives (n, D) of the residual of points fixed in the world by the pose, see `Pose.step`."""
        packed = self.balls.packed
        jacobian = np.zeros((len(points), 6 + len(packed.axes)))
        metaball_field.by_pose(
            packed.parents, packed.coordinate_segment, *self._segments[1:],
            np.ascontiguousarray(points, float), of.by_shift, of.by_turn, jacobian,
        )  # fmt: skip
        return jacobian

    def by_joints(self, of: Linearized, joint_modes: Floats) -> Floats:
        """Return the derivatives (n, N) of the residual by numbers that move the joint centres at rest.

        Args:
            of: The derivatives at the points.
            joint_modes: (N, S, 3) motion of the joint centres per number [m by unit of the number].
        """
        modes = np.ascontiguousarray(joint_modes, float)
        moved, _ = kinematics.origin_modes(self.balls.packed.parents, self.segment_rotation, modes)
        return np.asarray(np.einsum("nsa,sia->ni", of.by_shift, moved, optimize=True))
