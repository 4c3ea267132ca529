"""Other postures of a limb that may look alike: swung, moved along a camera's rays, or taken from other frames."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Floats, Integers
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.skeleton import Skeleton
from marey.fit.search.placements import ball_angles, limb_of
from marey.geometry import rotations

_THREE = 3
"""Number of coordinates of a ball joint."""
_STRAIGHT = 1e-3
"""Bend of an elbow or a knee below which the limb has no plane [rad]. Chosen by hand."""
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
    hinge: int
    """Index of the coordinate that bends the elbow or the knee, among the angles of a pose."""
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
                hinge = limb_of(skeleton, f"{side}_{kind}").hinge
                found.append(LimbChain(f"{side} {kind}", (upper, lower, end), ball, hinge, beyond))
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
    upper, _, end = limb.segments
    line = posed.segment_origin[end] - posed.segment_origin[upper]
    return _turned(posed, limb, rotations.about(line / np.linalg.norm(line), np.array(angle)))


def moved_in_depth(posed: PosedBody, limb: LimbChain, viewpoint: Floats) -> list[Pose]:
    """Move the elbow and the wrist, or the knee and the ankle, along the rays of a camera.

    The limb's ball joint stays in place, and so do the lengths. Each of both joints that follow lies at one of the two
    places of its ray at the right distance from the joint before ([Sminchisescu2003]): a camera cannot tell whether a
    segment points towards it or away from it.

    Args:
        posed: The body.
        limb: The limb, which must be bent.
        viewpoint: (3,) the centre of the camera [m].

    Returns:
        The other poses, at most three. The upper segment turns with the plane of the limb; angles of the ball joint may
        exceed their limits.
    """
    first, middle, end = (posed.segment_origin[s] for s in limb.segments)
    present, found = _frame_of(first, middle, end), []
    for elbow in _on_ray(viewpoint, middle, first, float(np.linalg.norm(middle - first))):
        for wrist in _on_ray(viewpoint, end, elbow, float(np.linalg.norm(end - middle))):
            same = np.allclose(elbow, middle) and np.allclose(wrist, end)
            if same or _bend(first, elbow, wrist) < _STRAIGHT:
                continue
            pose = _turned(posed, limb, _frame_of(first, elbow, wrist) @ present.T)
            angles, (low, high) = np.array(pose.angles), posed.body.skeleton.limits[limb.hinge]
            bend = _bend(first, elbow, wrist) - _bend(first, middle, end)
            angles[limb.hinge] = np.clip(angles[limb.hinge] + bend, low, high)
            found.append(replace(pose, angles=angles))
    return found


def _on_ray(viewpoint: Floats, seen: Floats, centre: Floats, radius: float) -> Iterator[Floats]:
    """Iterate over the places (3,) on a ray at a distance from a centre; there are none if the ray passes too far."""
    ray = (seen - viewpoint) / np.linalg.norm(seen - viewpoint)
    along = float((centre - seen) @ ray)
    square = radius**2 - float(np.sum((seen + along * ray - centre) ** 2))
    for sign in (-1.0, 1.0) if square >= 0.0 else ():
        yield seen + (along + sign * np.sqrt(square)) * ray


def _frame_of(first: Floats, middle: Floats, end: Floats) -> Floats:
    """Return the axes (3, 3), in columns, of a limb: along its upper segment, across its plane, and within it."""
    along = (middle - first) / np.linalg.norm(middle - first)
    across = np.cross(along, end - middle)
    across = across / np.linalg.norm(across)
    return np.column_stack([along, across, np.cross(along, across)])


def _bend(first: Floats, middle: Floats, end: Floats) -> float:
    """Return the angle between the upper segment, prolonged, and the lower one [rad]."""
    upper, lower = middle - first, end - middle
    return float(np.arctan2(np.linalg.norm(np.cross(upper, lower)), upper @ lower))


def _turned(posed: PosedBody, limb: LimbChain, turn: Floats) -> Pose:
    """Return the pose whose limb is turned about its ball joint by a rotation (3, 3) of the world."""
    skeleton = posed.body.skeleton
    upper = limb.segments[0]
    parent = posed.segment_rotation[skeleton.parents[upper]]
    angles = np.array(posed.pose.angles)
    turns = ball_angles(skeleton.axes[limb.ball], parent.T @ turn @ posed.segment_rotation[upper])
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
