"""Other postures of a limb that may look alike: a swing about the line between its ends, and those of other frames."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Floats, Integers
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.skeleton import Skeleton
from marey.fit.search.placements import ball_angles
from marey.geometry import rotations

_THREE = 3
"""Number of coordinates of a ball joint."""
_CHAINS = {"arm": ("upperarm", "forearm", "hand"), "leg": ("thigh", "shank", "foot")}
"""Upper segment, lower segment and end of a limb, by its kind."""


@dataclass(frozen=True, eq=False)
class LimbChain:
    """A limb of two long segments between a ball joint and a wrist or an ankle."""

    name: str
    """For example "left arm"."""
    segments: tuple[int, int, int]
    """Upper segment, lower segment, and the end, whose origin is the wrist or the ankle."""
    ball: Integers
    """(3,) indices of the ball joint's coordinates among the angles of a pose."""
    coordinates: Integers
    """(n,) indices of all coordinates of the limb among the angles of a pose."""


def limb_chains(skeleton: Skeleton) -> list[LimbChain]:
    """Return the limbs whose ball joint and middle joint are free, arms first."""
    found = []
    names = skeleton.segment_names
    for kind, chain in _CHAINS.items():
        for side in ("left", "right"):
            parts = [f"{side}_{part}" for part in chain]
            if not set(parts) <= set(names):
                continue
            upper, lower, end = (names.index(part) for part in parts)
            ball = np.flatnonzero(skeleton.coordinate_segment == upper)
            beyond = np.flatnonzero(skeleton.above()[:, upper][skeleton.coordinate_segment])
            if len(ball) == _THREE and (skeleton.coordinate_segment == lower).any():
                found.append(LimbChain(f"{side} {kind}", (upper, lower, end), ball, beyond))
    return found


def swung(posed: PosedBody, limb: LimbChain, angle: float) -> Pose:
    """Swing a limb about the line between its ends.

    The shoulder and the wrist, or the hip and the ankle, stay in place, and so do the lengths and the bend between
    them; the hand or the foot turns with the limb.

    Args:
        posed: The body.
        limb: The limb.
        angle: Angle of the swing [rad].

    Returns:
        The pose, whose angles may exceed the joints' limits.
    """
    skeleton = posed.body.skeleton
    upper, _, end = limb.segments
    line = posed.segment_origin[end] - posed.segment_origin[upper]
    swing = rotations.about(line / np.linalg.norm(line), np.array(angle))
    parent = posed.segment_rotation[skeleton.parents[upper]]
    wanted = parent.T @ swing @ posed.segment_rotation[upper]
    angles = np.array(posed.pose.angles)
    turns = ball_angles(skeleton.axes[limb.ball], wanted)
    angles[limb.ball] = _within(turns, skeleton.limits[limb.ball])
    return replace(posed.pose, angles=angles)


def _within(angles: Floats, limits: Floats) -> Floats:
    """Return the one of the two triples of a ball joint's angles with the same rotation that keeps its limits better.

    Args:
        angles: (3,) [rad].
        limits: (3, 2) [rad].
    """
    two = np.array([angles, [angles[0] + np.pi, np.pi - angles[1], angles[2] + np.pi]])
    two = np.mod(two + np.pi, 2 * np.pi) - np.pi
    excess = np.maximum(two - limits[:, 1], 0.0) + np.maximum(limits[:, 0] - two, 0.0)
    return np.asarray(two[int(np.argmin(excess.sum(1)))])


def bent(posed: PosedBody, limb: LimbChain) -> float:
    """Return the distance of the elbow or the knee from the line between the limb's ends [m]."""
    upper, lower, end = (posed.segment_origin[s] for s in limb.segments)
    line = (end - upper) / np.linalg.norm(end - upper)
    return float(np.linalg.norm(np.cross(line, lower - upper)))


def carried(pose: Pose, other: Pose, coordinates: Sequence[int] | Integers) -> Pose:
    """Return a pose with some joint coordinates of another one."""
    angles = np.array(pose.angles)
    angles[coordinates] = other.angles[coordinates]
    return replace(pose, angles=angles)
