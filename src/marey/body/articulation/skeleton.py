"""The skeleton: a tree of segments, joints of single degrees of freedom, their limits and usual angles."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from marey.arrays import Floats, Integers, freeze_fields, frozen
from marey.errors import SettingProblem

ROOT_COORDINATES = ("pelvis_tx", "pelvis_ty", "pelvis_tz", "pelvis_turn", "pelvis_list", "pelvis_tilt")
"""Names of the root's coordinates: translations, then rotations in the order of `ROOT_AXES`."""
ROOT_AXES = ((0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0))
"""Axes of the root's rotations: Z, then Y, then X of the rest posture (Z up, Y backward, X to the left)."""

PARENTS = {"pelvis": None, "abdomen": "pelvis", "thorax": "abdomen", "neck": "thorax", "head": "neck"}
"""Parent of each segment, parents before their children."""
for _side in ("left", "right"):
    for _child, _parent in (
        ("clavicle", "thorax"), ("upperarm", "clavicle"), ("forearm", "upperarm"), ("hand", "forearm"),
        ("thigh", "pelvis"), ("shank", "thigh"), ("foot", "shank"), ("toes", "foot"),
    ):  # fmt: skip
        PARENTS[f"{_side}_{_child}"] = _parent if _parent in ("thorax", "pelvis") else f"{_side}_{_parent}"

JOINT_OF_SEGMENT = {"neck": "neck", "head": "head"} | {
    f"{side}_{segment}": f"{side}_{joint}"
    for side in ("left", "right")
    for segment, joint in (
        ("thigh", "hip"), ("shank", "knee"), ("foot", "ankle"), ("toes", "toe"),
        ("upperarm", "shoulder"), ("forearm", "elbow"), ("hand", "wrist"),
    )
}  # fmt: skip
"""Name in the results of the joint centre about which a segment rotates on its parent."""

LIMBS = ("trunk", "left_arm", "right_arm", "left_leg", "right_leg")
"""Parts that may hide or be mistaken for each other; the trunk, with head and clavicles, is one of them."""
COLOUR_PARTS = ("head", "trunk", "pelvis", "upperarm", "forearm", "hand", "thigh", "shank", "foot")
"""Parts whose colours may differ; left and right are one part, since clothes and skin are alike on both sides."""
_PART_OF_SEGMENT = {"neck": "head", "abdomen": "trunk", "thorax": "trunk", "clavicle": "trunk", "toes": "foot"}
"""Colour part of a segment, by its name without the side, where the two names differ."""
_LIMB_KINDS = {"upperarm": "arm", "forearm": "arm", "hand": "arm"} | dict.fromkeys(
    ("thigh", "shank", "foot", "toes"), "leg"
)
"""Kind of limb of a segment, by its name without the side."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Coordinate:
    """One degree of freedom: a rotation about an axis fixed in the parent."""

    name: str
    """Name of the coordinate."""
    segment: str
    """Segment that it rotates."""
    axis: tuple[float, float, float]
    """Unit axis in the rest posture."""
    mean: float = 0.0
    """Mean angle over many postures [rad]."""
    sd: float
    """Standard deviation of the angle over many postures [rad]."""
    lower: float = -np.inf
    """Lower limit [rad]."""
    upper: float = np.inf
    """Upper limit [rad]."""


class PackedSkeleton(NamedTuple):
    """The skeleton as plain arrays, for the kernels."""

    parents: Integers
    """(S,) see `Skeleton.parents`."""
    coordinate_segment: Integers
    """(D - 6,) see `Skeleton.coordinate_segment`."""
    axes: Floats
    """(D - 6, 3) see `Skeleton.axes`."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Skeleton:
    """Segments, each rotating on its parent about one centre by coordinates of one degree of freedom each.

    The rotation of a segment is that of its parent times the rotations of its coordinates, in their order
    ([Rosenhahn2006] eq. (12)); at rest every rotation is the identity.
    """

    segment_names: tuple[str, ...]
    """S names."""
    parents: Integers
    """(S,) index of each segment's parent, -1 for the root; parents come before their children."""
    coordinates: tuple[Coordinate, ...]
    """The joints' coordinates, ordered by segment; the root's six precede them in every vector."""

    def __post_init__(self) -> None:
        freeze_fields(self, "parents", dtype=np.int64)
        order = [self.segment_names.index(c.segment) for c in self.coordinates]
        if order != sorted(order):
            raise ValueError("coordinates must be ordered by segment")

    @property
    def coordinate_names(self) -> tuple[str, ...]:
        """Names of all D coordinates, the root's six first."""
        return ROOT_COORDINATES + tuple(c.name for c in self.coordinates)

    @cached_property
    def coordinate_segment(self) -> Integers:
        """(D - 6,) index of the segment that each joint coordinate rotates."""
        return frozen([self.segment_names.index(c.segment) for c in self.coordinates], np.int64)

    @cached_property
    def segment_limb(self) -> Integers:
        """(S,) index in `LIMBS` of the limb to which each segment belongs."""
        parted = (name.partition("_") for name in self.segment_names)
        kinds = ((side, _LIMB_KINDS.get(plain)) for side, _, plain in parted)
        return frozen([LIMBS.index(f"{side}_{kind}") if kind else 0 for side, kind in kinds], np.int64)

    @cached_property
    def segment_colour_part(self) -> Integers:
        """(S,) index in `COLOUR_PARTS` of the part to which each segment belongs."""
        plain = [name.removeprefix("left_").removeprefix("right_") for name in self.segment_names]
        return frozen([COLOUR_PARTS.index(_PART_OF_SEGMENT.get(name, name)) for name in plain], np.int64)

    @cached_property
    def axes(self) -> Floats:
        """(D - 6, 3) unit axes in the rest posture."""
        return frozen(np.array([c.axis for c in self.coordinates], dtype=float).reshape(-1, 3))

    @cached_property
    def packed(self) -> PackedSkeleton:
        """The skeleton as arrays."""
        return PackedSkeleton(self.parents, self.coordinate_segment, self.axes)

    @cached_property
    def limits(self) -> Floats:
        """(D - 6, 2) lower and upper limit [rad]."""
        return frozen(np.array([(c.lower, c.upper) for c in self.coordinates]).reshape(-1, 2))

    @cached_property
    def habit(self) -> tuple[Floats, Floats]:
        """Mean and standard deviation (D - 6,) of each joint coordinate over many postures [rad]."""
        return frozen([c.mean for c in self.coordinates]), frozen([c.sd for c in self.coordinates])

    def __len__(self) -> int:
        """Return the number D of coordinates, including the root's six."""
        return 6 + len(self.coordinates)

    def segment(self, name: str) -> int:
        """Return a segment's index.

        Raises:
            SettingProblem: There is no segment of this name.
        """
        if name not in self.segment_names:
            raise SettingProblem(f"There is no segment '{name}'. The skeleton has {', '.join(self.segment_names)}.")
        return self.segment_names.index(name)

    def above(self) -> Floats:
        """Return the segments between the root and each segment, itself included: (S, S) of bool."""
        chain = np.eye(len(self.segment_names), dtype=bool)
        for k, parent in enumerate(self.parents):
            if parent >= 0:
                chain[k] |= chain[parent]
        return chain

    def mirrored(self) -> tuple[Integers, Integers]:
        """Return for each segment and each joint coordinate the index of its counterpart on the other side.

        A coordinate whose counterpart is not free is its own counterpart.
        """

        def other(name: str) -> str:
            if name.startswith("left_"):
                return "right_" + name[5:]
            return "left_" + name[6:] if name.startswith("right_") else name

        names = [c.name for c in self.coordinates]
        return (
            np.array([self.segment_names.index(other(name)) for name in self.segment_names]),
            np.array([names.index(other(name) if other(name) in names else name) for name in names]),
        )


def _degrees(
    name: str, segment: str, axis: Sequence[float], mean: float, sd: float, lower: float, upper: float
) -> Coordinate:
    """Make a coordinate from values in degrees."""
    unit = np.asarray(axis, float) / np.linalg.norm(axis)
    low, high = np.deg2rad(lower), np.deg2rad(upper)
    return Coordinate(
        name=name, segment=segment, axis=(float(unit[0]), float(unit[1]), float(unit[2])),
        mean=float(np.deg2rad(mean)), sd=float(np.deg2rad(sd)), lower=float(low), upper=float(high),
    )  # fmt: skip


# Axes of the rest posture: X to the left, Y backward, Z up; the right side is the mirror image.
# Means, standard deviations and limits are in degrees.
_TRUNK = {
    "abdomen": ("lumbar", (12, 8, 8), (45, 25, 25)),
    "thorax": ("thoracic", (12, 8, 12), (35, 25, 40)),
    "neck": ("neck", (12, 8, 12), (40, 30, 45)),
    "head": ("head", (12, 8, 15), (40, 30, 50)),
}
"""For each trunk segment the joint's name, and standard deviations and limits of flexion, bending and rotation
[deg]. Chosen by hand to cover sport and daily life, deliberately wide."""
_TRUNK_AXES = {"flexion": (1, 0, 0), "bending": (0, 1, 0), "rotation": (0, 0, 1)}
"""Axes of the trunk's coordinates in the rest posture."""


def _shoulder_axes(arm: Floats) -> tuple[Floats, Floats]:
    """Return the first two axes of the left shoulder; the third is the arm's own.

    Three successive rotations are singular where the arm points along the first axis, forward, medial and down or its
    opposite. An arm that hangs, reaches forward, sideways or up is 50 degrees away from it.
    """
    first = np.array([-0.6, -0.5, -0.6])
    first -= (first @ arm) * arm
    first /= np.linalg.norm(first)
    return first, np.cross(arm, first)


def _left_arm(arm: Floats, elbow: Floats, palm: Floats) -> list[tuple[Any, ...]]:
    """List the left arm's coordinates: name, segment, axis, mean, sd, limits [deg]."""
    sweep, lift = _shoulder_axes(arm)
    hand_side = np.cross(arm, palm)
    return [
        ("clavicle_elevation", "clavicle", (0, -1, 0), 0, 8, -15, 40),
        ("clavicle_protraction", "clavicle", (0, 0, -1), 0, 6, -25, 30),
        ("shoulder_sweep", "upperarm", sweep, 0, 45, -170, 170),
        ("shoulder_lift", "upperarm", lift, 0, 45, -100, 100),
        ("shoulder_turn", "upperarm", arm, 0, 35, -110, 110),
        ("elbow_flexion", "forearm", elbow, 25, 40, -5, 150),
        ("pronation", "forearm", arm, 0, 25, -90, 90),
        ("wrist_flexion", "hand", hand_side, 0, 15, -75, 80),
        ("wrist_deviation", "hand", palm, 0, 10, -30, 40),
    ]


_LEFT_LEG = [
    ("hip_flexion", "thigh", (-1, 0, 0), 10, 35, -35, 125),
    ("hip_abduction", "thigh", (0, -1, 0), 0, 14, -35, 65),
    ("hip_rotation", "thigh", (0, 0, -1), 0, 18, -50, 50),
    ("knee_flexion", "shank", (1, 0, 0), 15, 35, -5, 150),
    ("knee_adduction", "shank", (0, 1, 0), 0, 3, -8, 8),
    ("knee_rotation", "shank", (0, 0, -1), 0, 8, -30, 30),
    ("ankle_dorsiflexion", "foot", (-1, 0, 0), 0, 14, -55, 35),
    ("ankle_inversion", "foot", (0, -1, 0), 0, 8, -30, 30),
    ("toe_extension", "toes", (-1, 0, 0), 0, 12, -30, 70),
]
"""Coordinates of the left leg: name, segment, axis, mean, standard deviation and limits [deg]. Chosen by hand to
cover sport and daily life, deliberately wide."""


def _both_sides(left: list[tuple[Any, ...]]) -> list[Coordinate]:
    """Make the coordinates of both sides; a rotation mirrored in the plane X = 0 keeps its sign."""
    coordinates = []
    for side in ("left", "right"):
        for name, segment, axis, *numbers in left:
            # The mirror image of a rotation about (x, y, z) is one about (x, -y, -z).
            mirror = np.array([1, 1, 1] if side == "left" else [1, -1, -1])
            coordinates.append(_degrees(f"{side}_{name}", f"{side}_{segment}", np.array(axis) * mirror, *numbers))
    return coordinates


def full_skeleton(*, arm: Floats, elbow: Floats, palm: Floats) -> Skeleton:
    """Return the skeleton of 54 degrees of freedom.

    Args:
        arm: (3,) direction of the left arm at rest, from shoulder to wrist.
        elbow: (3,) flexion axis of the left forearm.
        palm: (3,) direction, across the arm, that the left palm faces at rest.
    """
    arm = np.asarray(arm, float) / np.linalg.norm(arm)
    elbow = elbow - (elbow @ arm) * arm
    palm = palm - (palm @ arm) * arm
    trunk = [
        _degrees(f"{joint}_{turn}", segment, axis, 0, sds[i], -limits[i], limits[i])
        for segment, (joint, sds, limits) in _TRUNK.items()
        for i, (turn, axis) in enumerate(_TRUNK_AXES.items())
    ]
    limbs = _both_sides(_left_arm(arm, elbow / np.linalg.norm(elbow), palm / np.linalg.norm(palm)) + _LEFT_LEG)
    names = tuple(PARENTS)
    parents = [-1 if parent is None else names.index(parent) for parent in PARENTS.values()]
    ordered = sorted(trunk + limbs, key=lambda c: names.index(c.segment))
    return Skeleton(segment_names=names, parents=np.array(parents), coordinates=tuple(ordered))


def root_angles(rotation: Floats) -> Floats:
    """Return the root's three angles (turn, list, tilt) from its rotation: rotation = Rz Ry Rx.

    Args:
        rotation: (..., 3, 3).

    Returns:
        (..., 3) [rad]; the list lies within a quarter turn.
    """
    r = np.asarray(rotation)
    tilt = np.arctan2(r[..., 2, 1], r[..., 2, 2])
    lean = np.arctan2(-r[..., 2, 0], np.hypot(r[..., 0, 0], r[..., 1, 0]))
    turn = np.arctan2(r[..., 1, 0], r[..., 0, 0])
    return np.stack([turn, lean, tilt], -1)
