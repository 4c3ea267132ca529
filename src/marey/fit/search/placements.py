"""Initial postures for a search without a prediction: whole bodies, and single limbs."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Integers
from marey.body.articulation.skeleton import Skeleton
from marey.geometry import rotations

SEARCHED_LIMBS = ("left_arm", "right_arm", "left_leg", "right_leg")
"""Names of the limbs that are searched on their own."""
_HINGES = {"arm": "elbow_flexion", "leg": "knee_flexion"}
"""Coordinate of the elbow or knee, by kind of limb."""
_SEGMENTS = {"arm": ("upperarm", "forearm", "hand"), "leg": ("thigh", "shank", "foot", "toes")}
"""Segments by kind of limb, from the trunk outwards."""


@dataclass(frozen=True, eq=False)
class LimbCoordinates:
    """One limb: its segments and the coordinates that place it."""

    name: str
    segments: tuple[str, ...]
    ball: Integers
    """(3,) the joint coordinates of its shoulder or hip."""
    hinge: int
    """The joint coordinate of its elbow or knee."""
    others: Integers
    """Its other joint coordinates, which a placement sets to zero."""

    @property
    def columns(self) -> Integers:
        """All its joint coordinates: ball, hinge, others."""
        return np.concatenate([self.ball, [self.hinge], self.others])


def limbs_of(skeleton: Skeleton) -> dict[str, LimbCoordinates]:
    """Return the limbs whose shoulder or hip and hinge are free in the skeleton, by their names in `SEARCHED_LIMBS`."""
    names = {c.name for c in skeleton.coordinates}
    hinges = {f"{side}_{kind}": f"{side}_{hinge}" for side in ("left", "right") for kind, hinge in _HINGES.items()}
    return {limb: limb_of(skeleton, limb) for limb in SEARCHED_LIMBS if hinges[limb] in names}


def limb_of(skeleton: Skeleton, name: str) -> LimbCoordinates:
    """Return a limb's coordinates by its name, one of `SEARCHED_LIMBS`."""
    side, kind = name.split("_")
    segments = tuple(f"{side}_{segment}" for segment in _SEGMENTS[kind])
    own = [i for i, c in enumerate(skeleton.coordinates) if c.segment in segments]
    ball = [i for i in own if skeleton.coordinates[i].segment == segments[0]]
    hinge = next(i for i in own if skeleton.coordinates[i].name == f"{side}_{_HINGES[kind]}")
    others = [i for i in own if i not in ball and i != hinge]
    return LimbCoordinates(name, segments, np.array(ball), hinge, np.array(others, dtype=np.int64))


def ball_angles(axes: Floats, rotation: Floats) -> Floats:
    """Decompose rotations into successive rotations about three orthogonal axes.

    Args:
        axes: (3, 3) unit axes, one per row.
        rotation: (..., 3, 3).

    Returns:
        (..., 3) [rad], so that rotation is the product of the rotations about axes[0], axes[1] and axes[2].
    """
    hand = np.sign(np.linalg.det(axes))
    frame = axes * np.array([1.0, 1.0, hand])[:, None]
    m = frame @ rotation @ frame.T
    second = np.arcsin(np.clip(m[..., 0, 2], -1, 1))
    first = np.arctan2(-m[..., 1, 2], m[..., 2, 2])
    third = np.arctan2(-m[..., 0, 1], m[..., 0, 0])
    return np.stack([first, second, hand * third], -1)


def directions(count: int) -> Floats:
    """Return unit vectors (count, 3) evenly spread over the sphere (a Fibonacci lattice)."""
    i = np.arange(count) + 0.5
    z = 1 - 2 * i / count
    turn = np.pi * (1 + np.sqrt(5)) * i
    radius = np.sqrt(1 - z**2)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), z], 1)


def shortest_turn(start: Floats, end: Floats) -> Floats:
    """Return the rotations (n, 3, 3) of least angle that map a unit vector (3,) to others (n, 3)."""
    axis = np.cross(start, end)
    sine = np.linalg.norm(axis, axis=-1, keepdims=True)
    angle = np.arctan2(sine[..., 0], end @ start)
    flat = sine[..., 0] < 1e-9
    any_axis = np.cross(start, np.eye(3)[np.argmin(np.abs(start))])
    axis = np.where(flat[..., None], any_axis / np.linalg.norm(any_axis), axis / np.where(sine < 1e-9, 1, sine))
    return rotations.about(axis, angle)


def limb_placements(skeleton: Skeleton, limb: LimbCoordinates, rest: Floats, *, count: int) -> Floats:
    """List placements of a limb within its joints' limits: directions, rotations about itself, and bends.

    Args:
        skeleton: Skeleton with the limits.
        limb: The limb.
        rest: (3,) direction of the limb at rest.
        count: Approximate number of directions on the whole sphere.

    Returns:
        (n, k) angles for `limb.columns` [rad].
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


_ARM_BENDS = ((8, (0,)), (45, range(-100, 101, 50)), (85, range(-100, 101, 40)), (125, range(-100, 101, 50)))
"""Bend of the elbow with the arm's rotations about itself [deg]; that of a nearly straight arm is not visible.
Chosen by hand."""
_LEG_BENDS = ((5, (0,)), (40, (-20, 20)), (80, (-20, 20)), (115, (-20, 20)))
"""Bend of the knee with the leg's rotations about itself [deg]. Chosen by hand."""


def _point(skeleton: Skeleton, limb: LimbCoordinates, rest: Floats, towards: Floats, bend: float) -> Floats:
    turn = shortest_turn(rest / np.linalg.norm(rest), np.asarray(towards, float)[None] / np.linalg.norm(towards))
    return np.append(ball_angles(skeleton.axes[limb.ball], turn)[0], np.deg2rad(bend))


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
"""Directions of the left arm in the axes of the rest posture (x to the left, y backward, z up), and the elbow's bend
[deg]. Chosen by hand."""
_ARM_PAIRS = (
    ("hanging", "hanging"), ("aside", "aside"), ("level", "level"), ("raised", "raised"), ("overhead", "overhead"),
    ("forward", "forward"), ("bent", "bent"), ("folded", "folded"), ("raised", "hanging"), ("hanging", "raised"),
)  # fmt: skip
"""Combinations of left and right arm in `_ARMS`."""
_LEGS = {
    "straight": ((0.08, 0, -1), 5),
    "apart": ((0.4, 0, -1), 5),
    "ahead": ((0.08, -0.45, -1), 10),
    "behind": ((0.08, 0.3, -1), 25),
    "lifted": ((0.1, -1, -0.4), 80),
    "seated": ((0.15, -1, -0.1), 90),
    "squat": ((0.2, -0.7, -0.7), 80),
}
"""Directions of the left leg in the axes of the rest posture (x to the left, y backward, z up), and the knee's bend
[deg]. Chosen by hand."""
_LEG_PAIRS = (
    ("straight", "straight"), ("apart", "apart"), ("ahead", "behind"), ("behind", "ahead"),
    ("lifted", "straight"), ("straight", "lifted"), ("squat", "squat"), ("seated", "seated"),
)  # fmt: skip
"""Combinations of left and right leg in `_LEGS`."""


def whole_postures(skeleton: Skeleton, arm: Floats, leg: Floats) -> Floats:
    """List postures of the whole body (n, D - 6): every pair of arms with every pair of legs.

    Args:
        skeleton: Full skeleton, or one with some of the limbs.
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
