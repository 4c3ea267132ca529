"""Linear modes beyond the learned family: lengths, girths, clothes, and positions of the joint centres."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, frozen
from marey.body.articulation.surface import ShapeSpace
from marey.body.people.family import BodyFamily, distal_ends
from marey.geometry.vectors import unit

LENGTH_SEGMENTS = ("abdomen", "thorax", "neck", "head", "clavicle", "upperarm", "forearm", "hand", "thigh", "shank")
"""Segments whose length is a mode, without the side."""
GIRTH_SEGMENTS = (
    "pelvis",
    "abdomen",
    "thorax",
    "neck",
    "head",
    "upperarm",
    "forearm",
    "hand",
    "thigh",
    "shank",
    "foot",
)
"""Segments whose girth is a mode, without the side."""
CLOTHED_SEGMENTS = ("pelvis", "abdomen", "thorax", "clavicle", "upperarm", "thigh")
"""Segments covered by clothes, without the side."""
LENGTH_SD = 0.04
"""Standard deviation of a segment's length from the value expected from the rest of the body, as a share. An
estimate without a source (docs/explanation/body.md)."""
GIRTH_SD = 0.06
"""Standard deviation of a segment's girth from the value expected from the rest of the body, as a share. An estimate
without a source (docs/explanation/body.md)."""
CLOTHES_SD = 0.010
"""Standard deviation of the thickness of clothes [m]. An estimate without a source (docs/explanation/body.md)."""
SKIN_LAYER_SD = 0.005
"""Standard deviation of a layer over the whole skin [m]. An estimate without a source (docs/explanation/body.md)."""
JOINT_SD = {"hip": (0.015, 0.012, 0.012), "shoulder": (0.012, 0.012, 0.020), "knee": (0.008, 0.008, 0.012)}
"""Standard deviation of joint centres along `AXIS_NAMES` [m]: half the distance of the rig's joints from published
ones (docs/explanation/body.md), at least 0.008 m."""
SEGMENT_OF_JOINT = {"hip": "thigh", "shoulder": "upperarm", "knee": "shank"}
"""Segment that rotates about a joint, without the side."""
AXIS_NAMES = ("lateral", "backward", "up")
"""Names of the axes X, Y and Z of the rest posture in the modes' names."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Modes:
    """Linear modes of skin and joint centres about the family's mean body, symmetric between the sides.

    A body is the family's plus the sum of number_i vertices_i, and its joint centres that of number_i joints_i. A
    number is a share (0.1 is 10 % longer or thicker) or, for clothes and joint centres, a distance in metres.

    Attributes:
        names: (M,) "thigh_length", "thigh_girth", "clothes", "hip_lateral" and so on.
        vertices: (M, V, 3) metres by unit of the number.
        joints: (M, S, 3) metres by unit of the number.
        sd: (M,) standard deviation of each number among people, mean zero.
    """

    names: tuple[str, ...]
    vertices: Floats
    joints: Floats
    sd: Floats

    def __len__(self) -> int:
        """Return the number of modes."""
        return len(self.names)

    def standardised(self) -> "Modes":
        """Return the same modes for numbers of unit variance."""
        scale = self.sd[:, None, None]
        return Modes(
            names=self.names,
            vertices=frozen(self.vertices * scale),
            joints=frozen(self.joints * scale),
            sd=frozen(np.ones(len(self))),
        )

    def keep(self, *endings: str) -> "Modes":
        """Keep only the modes whose names end with one of the endings, such as "_length"."""
        index = [i for i, name in enumerate(self.names) if name.endswith(endings)]
        return Modes(
            names=tuple(self.names[i] for i in index),
            vertices=frozen(self.vertices[index]),
            joints=frozen(self.joints[index]),
            sd=frozen(self.sd[index]),
        )


def departure_modes(family: BodyFamily) -> Modes:
    """Return all modes beyond the family.

    Args:
        family: The family at either level; the same numbers mean the same body at both.
    """
    modes = [(f"{plain}_length", *length_mode(family, plain), LENGTH_SD) for plain in LENGTH_SEGMENTS]
    modes += [("pelvis_width", *pelvis_width_mode(family), LENGTH_SD), ("foot_length", *foot_mode(family), LENGTH_SD)]
    modes += [(f"{plain}_girth", *girth_mode(family, plain), GIRTH_SD) for plain in GIRTH_SEGMENTS]
    modes += [
        ("clothes", *offset_mode(family, CLOTHED_SEGMENTS), CLOTHES_SD),
        ("skin", *offset_mode(family, None), SKIN_LAYER_SD),
    ]
    for joint, spreads in JOINT_SD.items():
        modes += [(f"{joint}_{AXIS_NAMES[i]}", *joint_mode(family, joint, i), sd) for i, sd in enumerate(spreads)]
    names, vertices, joints, sds = zip(*modes, strict=True)
    return Modes(names=names, vertices=frozen(vertices), joints=frozen(joints), sd=frozen(sds))


def extended_space(space: ShapeSpace, modes: Modes) -> ShapeSpace:
    """Extend a space of shapes by modes, whose numbers come last and have unit variance.

    Args:
        space: Shape space of the family, at the level for which the modes were made.
        modes: Modes with mean zero, independent of the family's numbers.
    """
    unit, count, more = modes.standardised(), len(space), len(modes)
    covariance = np.eye(count + more)
    covariance[:count, :count] = space.prior_covariance
    return ShapeSpace(
        names=(*space.names, *unit.names),
        vertex_mean=space.vertex_mean,
        vertex_modes=np.concatenate([space.vertex_modes, unit.vertices]),
        joint_mean=space.joint_mean,
        joint_modes=np.concatenate([space.joint_modes, unit.joints]),
        prior_mean=np.concatenate([space.prior_mean, np.zeros(more)]),
        prior_covariance=covariance,
    )


def same_on_both_sides(family: BodyFamily, plain: str) -> list[int]:
    """Return the indices of the segments of a plain name: one of the trunk, or the left and the right one of a limb."""
    return [
        i for i, name in enumerate(family.segment_names) if name.removeprefix("left_").removeprefix("right_") == plain
    ]


def dense_weights(family: BodyFamily) -> Floats:
    """Return the skin weights (V, S) of every segment."""
    weights = np.zeros((len(family.vertices_mean), len(family.segment_names)))
    for column in range(family.vertex_weights.shape[1]):
        np.add.at(
            weights, (np.arange(len(weights)), family.vertex_segments[:, column]), family.vertex_weights[:, column]
        )
    return weights


def children_moved(family: BodyFamily, segment: int, field: Callable[[Floats], Floats]) -> tuple[Floats, Floats]:
    """Return the motion of skin and joints when a displacement field moves a segment and the segments beyond it.

    Args:
        family: The family.
        segment: Segment whose points the field moves.
        field: Displacement (n, 3) of points (n, 3) of the segment, zero at its own joint centre.

    Returns:
        vertices (V, 3) and joints (S, 3) displacements, blended by the skin weights.
    """
    carried = np.zeros((len(family.segment_names), 3))
    for index, parent in enumerate(family.parents):
        if parent == segment:
            carried[index] = field(family.joints_mean[index][None])[0]
        elif parent >= 0:
            carried[index] = carried[parent]
    weights = dense_weights(family)
    vertices = weights @ carried + weights[:, segment, None] * field(family.vertices_mean)
    return vertices, carried


def length_mode(family: BodyFamily, plain: str) -> tuple[Floats, Floats]:
    """Return the mode of a segment's relative length: a stretch along the long axis from joint to far end."""
    ends = distal_ends(family)
    vertices, joints = np.zeros_like(family.vertices_mean), np.zeros_like(family.joints_mean)
    for segment in same_on_both_sides(family, plain):
        joint, along = family.joints_mean[segment], ends[segment] - family.joints_mean[segment]

        def stretch(points: Floats, joint: Floats = joint, along: Floats = along) -> Floats:
            share = np.clip((points - joint) @ along / (along @ along), 0, 1)
            return share[:, None] * along

        moved = children_moved(family, segment, stretch)
        vertices, joints = vertices + moved[0], joints + moved[1]
    return vertices, joints


def pelvis_width_mode(family: BodyFamily) -> tuple[Floats, Floats]:
    """Return the mode of the pelvis' relative width: the hips and the legs move apart."""
    pelvis, half = family.segment("pelvis"), family.joints_mean[family.segment("left_thigh")][0]

    def widen(points: Floats) -> Floats:
        return np.clip(points[:, :1], -half, half) * [1.0, 0.0, 0.0]

    return children_moved(family, pelvis, widen)


def foot_mode(family: BodyFamily) -> tuple[Floats, Floats]:
    """Return the mode of the foot's relative length: a stretch from the ankle, with the toes."""
    vertices, joints = np.zeros_like(family.vertices_mean), np.zeros_like(family.joints_mean)
    for segment in same_on_both_sides(family, "foot"):
        joint = family.joints_mean[segment]

        def stretch(points: Floats, joint: Floats = joint) -> Floats:
            return (points - joint)[:, 1:2] * [0.0, 1.0, 0.0]

        moved = children_moved(family, segment, stretch)
        vertices, joints = vertices + moved[0], joints + moved[1]
    return vertices, joints


def girth_mode(family: BodyFamily, plain: str) -> tuple[Floats, Floats]:
    """Return the mode of a segment's relative girth: the skin moves away from the central long axis."""
    ends, weights = distal_ends(family), dense_weights(family)
    vertices = np.zeros_like(family.vertices_mean)
    for segment in same_on_both_sides(family, plain):
        along = ends[segment] - family.joints_mean[segment]
        along = along / np.linalg.norm(along)
        share = weights[:, segment, None]
        centre = np.sum(share * family.vertices_mean, axis=0) / share.sum()
        from_centre = family.vertices_mean - centre
        vertices = vertices + share * (from_centre - (from_centre @ along)[:, None] * along)
    return vertices, np.zeros_like(family.joints_mean)


def vertex_normals(vertices: Floats, faces: np.ndarray) -> Floats:
    """Return unit outward normals (V, 3), with each face weighted by its area."""
    a, b, c = vertices[faces].transpose(1, 0, 2)
    normals = np.zeros_like(vertices)
    np.add.at(normals, faces.ravel(), np.repeat(np.cross(b - a, c - a), 3, axis=0))
    return unit(normals)


def offset_mode(family: BodyFamily, plain_names: tuple[str, ...] | None) -> tuple[Floats, Floats]:
    """Return the mode of a layer over some segments, or over all: skin moves along its normals, joints stay."""
    normals = vertex_normals(family.vertices_mean, family.faces)
    if plain_names is not None:
        covered = [i for plain in plain_names for i in same_on_both_sides(family, plain)]
        normals = normals * dense_weights(family)[:, covered].sum(1, keepdims=True)
    return normals, np.zeros_like(family.joints_mean)


def joint_mode(family: BodyFamily, joint: str, axis: int) -> tuple[Floats, Floats]:
    """Return the mode of a joint centre's position in the same skin, mirrored on the other side."""
    joints = np.zeros_like(family.joints_mean)
    for segment in same_on_both_sides(family, SEGMENT_OF_JOINT[joint]):
        outwards = np.sign(family.joints_mean[segment, 0]) if axis == 0 else 1.0
        joints[segment, axis] = outwards
    return np.zeros_like(family.vertices_mean), joints
