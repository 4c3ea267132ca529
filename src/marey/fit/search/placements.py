"""Postures worth trying before anything is known: whole bodies, and single limbs."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Integers
from marey.body.articulation.skeleton import Skeleton
from marey.geometry import rotations

LIMBS = ("left_arm", "right_arm", "left_leg", "right_leg")
_HINGES = {"arm": "elbow_flexion", "leg": "knee_flexion"}
_SEGMENTS = {"arm": ("upperarm", "forearm", "hand"), "leg": ("thigh", "shank", "foot", "toes")}


@dataclass(frozen=True, eq=False)
class Limb:
    """One limb: its segments and the coordinates that place it."""

    name: str
    segments: tuple[str, ...]
    ball: Integers
    """(3,) the joint coordinates of its shoulder or hip."""
    hinge: int
    """The joint coordinate of its elbow or knee."""
    others: Integers
    """Its further joint coordinates, which a placement sets to zero."""

    @property
    def columns(self) -> Integers:
        """All its joint coordinates: ball, hinge, others."""
        return np.concatenate([self.ball, [self.hinge], self.others])


def limbs_of(skeleton: Skeleton) -> dict[str, Limb]:
    """Find the limbs whose shoulder or hip and hinge the skeleton leaves free, by their names in `LIMBS`."""
    names = {c.name for c in skeleton.coordinates}
    hinges = {f"{side}_{kind}": f"{side}_{hinge}" for side in ("left", "right") for kind, hinge in _HINGES.items()}
    return {limb: limb_of(skeleton, limb) for limb in LIMBS if hinges[limb] in names}


def limb_of(skeleton: Skeleton, name: str) -> Limb:
    """Find a limb's coordinates by its name, one of `LIMBS`."""
    side, kind = name.split("_")
    segments = tuple(f"{side}_{segment}" for segment in _SEGMENTS[kind])
    own = [i for i, c in enumerate(skeleton.coordinates) if c.segment in segments]
    ball = [i for i in own if skeleton.coordinates[i].segment == segments[0]]
    hinge = next(i for i in own if skeleton.coordinates[i].name == f"{side}_{_HINGES[kind]}")
    others = [i for i in own if i not in ball and i != hinge]
    return Limb(name, segments, np.array(ball), hinge, np.array(others, dtype=np.int64))


def ball_angles(axes: Floats, rotation: Floats) -> Floats:
    """Split rotations into successive turns about three axes that stand at right angles.

    Args:
        axes: (3, 3) unit axes, one a row.
        rotation: (..., 3, 3).

    Returns:
        (..., 3) [rad], so that rotation = turn about axes[0], times about axes[1], times about axes[2].
    """
    hand = np.sign(np.linalg.det(axes))
    frame = axes * np.array([1.0, 1.0, hand])[:, None]
    m = frame @ rotation @ frame.T
    second = np.arcsin(np.clip(m[..., 0, 2], -1, 1))
    first = np.arctan2(-m[..., 1, 2], m[..., 2, 2])
    third = np.arctan2(-m[..., 0, 1], m[..., 0, 0])
    return np.stack([first, second, hand * third], -1)


def directions(count: int) -> Floats:
    """Spread unit vectors (count, 3) evenly over the sphere: a Fibonacci lattice."""
    i = np.arange(count) + 0.5
    z = 1 - 2 * i / count
    turn = np.pi * (1 + np.sqrt(5)) * i
    radius = np.sqrt(1 - z**2)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), z], 1)


def shortest_turn(start: Floats, end: Floats) -> Floats:
    """Give the rotations (n, 3, 3) of least angle that carry a unit vector (3,) to others (n, 3)."""
    axis = np.cross(start, end)
    sine = np.linalg.norm(axis, axis=-1, keepdims=True)
    angle = np.arctan2(sine[..., 0], end @ start)
    flat = sine[..., 0] < 1e-9
    any_axis = np.cross(start, np.eye(3)[np.argmin(np.abs(start))])
    axis = np.where(flat[..., None], any_axis / np.linalg.norm(any_axis), axis / np.where(sine < 1e-9, 1, sine))
    return rotations.about(axis, angle)


def limb_placements(skeleton: Skeleton, limb: Limb, rest: Floats, *, count: int) -> Floats:
    """List placements of a limb within its joints' limits: directions, turns about itself, bends.

    Args:
        skeleton: whose limits count.
        limb: which limb.
        rest: (3,) direction of the limb at rest.
        count: about how many directions to try on the whole sphere.

    Returns:
        (n, k) angles for `limb.columns`.
    """
    limits = skeleton.limits[limb.ball]
    rest = rest / np.linalg.norm(rest)
    swing = shortest_turn(rest, directions(count))
    placements = []
    for bend, turns in _ARM_BENDS if "arm" in limb.name else _LEG_BENDS:
        for turn in turns:
            angles = ball_angles(skeleton.axes[limb.ball], swing @ rotations.about(rest, np.deg2rad(turn)))
            allowed = ((angles >= limits[:, 0]) & (angles <= limits[:, 1])).all(1)
            rows = np.zeros((int(allowed.sum()), len(limb.columns)))
            rows[:, :3] = angles[allowed]
            rows[:, 3] = np.deg2rad(bend)
            placements.append(rows)
    return np.concatenate(placements)


# How far the hinge bends and how the limb turns about itself [deg]; a straight limb's turn does not show.
_ARM_BENDS = ((8, (0,)), (45, range(-100, 101, 50)), (85, range(-100, 101, 40)), (125, range(-100, 101, 50)))
_LEG_BENDS = ((5, (0,)), (40, (-20, 20)), (80, (-20, 20)), (115, (-20, 20)))


def _point(skeleton: Skeleton, limb: Limb, rest: Floats, towards: Floats, bend: float) -> Floats:
    turn = shortest_turn(rest / np.linalg.norm(rest), np.asarray(towards, float)[None] / np.linalg.norm(towards))
    return np.append(ball_angles(skeleton.axes[limb.ball], turn)[0], np.deg2rad(bend))


# Directions in the rest posture's axes for the left side: x to the left, y backward, z up; bend in degrees.
_ARMS = {
    "hanging": ((0.15, 0, -1), 10),
    "aside": ((0.7, 0, -0.7), 10),
    "level": ((1, 0, 0), 10),
    "raised": ((0.6, 0, 0.8), 20),
    "overhead": ((0.15, -0.1, 1), 10),
    "forward": ((0.2, -1, 0), 10),
    "bent": ((0.25, -0.2, -1), 90),
    "folded": ((0.4, -0.6, -0.6), 100),
}
_ARM_PAIRS = (
    ("hanging", "hanging"), ("aside", "aside"), ("level", "level"), ("raised", "raised"), ("overhead", "overhead"),
    ("forward", "forward"), ("bent", "bent"), ("folded", "folded"), ("raised", "hanging"), ("hanging", "raised"),
)  # fmt: skip
_LEGS = {
    "straight": ((0.08, 0, -1), 5),
    "apart": ((0.4, 0, -1), 5),
    "ahead": ((0.08, -0.45, -1), 10),
    "behind": ((0.08, 0.3, -1), 25),
    "lifted": ((0.1, -1, -0.4), 80),
    "seated": ((0.15, -1, -0.1), 90),
    "squat": ((0.2, -0.7, -0.7), 80),
}
_LEG_PAIRS = (
    ("straight", "straight"), ("apart", "apart"), ("ahead", "behind"), ("behind", "ahead"),
    ("lifted", "straight"), ("straight", "lifted"), ("squat", "squat"), ("seated", "seated"),
)  # fmt: skip


def whole_postures(skeleton: Skeleton, arm: Floats, leg: Floats) -> Floats:
    """List postures of the whole body (n, D - 6): every pair of arms with every pair of legs.

    Args:
        skeleton: full, or with some of the limbs.
        arm: (3,) direction of the left arm at rest.
        leg: (3,) direction of the left leg at rest.
    """
    limbs = limbs_of(skeleton)
    postures = []
    for arms in _ARM_PAIRS if any("arm" in name for name in limbs) else _ARM_PAIRS[:1]:
        for legs in _LEG_PAIRS if any("leg" in name for name in limbs) else _LEG_PAIRS[:1]:
            angles = np.zeros(len(skeleton) - 6)
            for name, limb in limbs.items():
                left = name.startswith("left")
                side = np.array([1 if left else -1, 1, 1])
                rest, table, kinds = (arm, _ARMS, arms) if "arm" in name else (leg, _LEGS, legs)
                towards, bend = table[kinds[0 if left else 1]]
                angles[np.append(limb.ball, limb.hinge)] = _point(
                    skeleton, limb, rest * side, np.array(towards) * side, bend
                )
            postures.append(angles)
    return np.array(postures)
