"""Presets: which segments and coordinates a capture uses, and the body that it starts from."""

import numpy as np

from marey.body.departures import departure_modes, wider
from marey.body.family import BodyFamily, Level, load_family
from marey.body.skeleton import PARENTS, Skeleton, full_skeleton
from marey.body.surface import Body, ShapeSpace


def family_skeleton(family: BodyFamily) -> Skeleton:
    """Build the full skeleton with the family's own directions of arm, elbow and palm."""
    joints = family.joints_mean
    arm = joints[family.segment("left_hand")] - joints[family.segment("left_upperarm")]
    arm = arm / np.linalg.norm(arm)
    elbow = family.hinge_axes[family.segment("left_forearm")]
    palm = np.cross(family.hinge_axes[family.segment("left_hand")], arm)
    return full_skeleton(arm=arm, elbow=elbow, palm=palm)


def family_space(family: BodyFamily) -> ShapeSpace:
    """Give the shapes of the family, of unit variance."""
    count = family.numbers
    order = [family.segment_names.index(name) for name in PARENTS]
    return ShapeSpace(
        names=tuple(f"family_{i + 1}" for i in range(count)),
        vertex_mean=family.vertices_mean,
        vertex_modes=family.vertices_modes,
        joint_mean=family.joints_mean[order],
        joint_modes=family.joints_modes[:, order],
        prior_mean=np.zeros(count),
        prior_covariance=np.eye(count),
    )


def person_space(family: BodyFamily, *, numbers: int) -> ShapeSpace:
    """Give the shapes of people: the family's first numbers, and the departures from it, all of unit variance."""
    return wider(family_space(family).keep(range(numbers)), departure_modes(family))


def _body(family: BodyFamily, space: ShapeSpace) -> Body:
    skeleton = family_skeleton(family)
    index = np.array([skeleton.segment_names.index(name) for name in family.segment_names])
    return Body(
        skeleton=skeleton,
        space=space,
        numbers=np.zeros(len(space)),
        faces=family.faces,
        vertex_segments=index[family.vertex_segments],
        vertex_weights=family.vertex_weights,
    )


def family_body(level: Level = "fine", numbers: int | None = None) -> Body:
    """Make the mean body of the family, ready to be posed and fitted."""
    family = load_family(level, numbers)
    return _body(family, family_space(family))


def person_body(level: Level = "fine", *, numbers: int = 10) -> Body:
    """Make the mean body with all the numbers in which people differ: the family's first ones and the departures."""
    family = load_family(level)
    return _body(family, person_space(family, numbers=numbers))
