"""The body of a person of whom little is known yet, as a capture starts from it."""

from dataclasses import replace

import numpy as np

from marey.arrays import Floats
from marey.body.articulation.presets import PRESETS, Preset
from marey.body.articulation.skeleton import PARENTS, Skeleton, full_skeleton
from marey.body.articulation.surface import Body, ShapeSpace
from marey.body.people.anthropometry import condition, measures
from marey.body.people.departures import JOINT_SD, SEGMENT_OF_JOINT, departure_modes, wider
from marey.body.people.family import BodyFamily, Level, load_family
from marey.errors import SettingProblem


def stature(body: Body) -> tuple[float, float]:
    """Measure a body from its lowest to its highest point at rest.

    Args:
        body: Of which the height is wanted.

    Returns:
        The height [m], and its standard deviation [m]: NaN where the body's numbers have no covariance.
    """
    highest, lowest = int(np.argmax(body.vertices[:, 2])), int(np.argmin(body.vertices[:, 2]))
    height = float(body.vertices[highest, 2] - body.vertices[lowest, 2])
    if body.numbers_covariance is None:
        return height, float("nan")
    by_number = body.space.vertex_modes[:, highest, 2] - body.space.vertex_modes[:, lowest, 2]
    return height, float(np.sqrt(by_number @ body.numbers_covariance @ by_number))


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


JOINT_SHARE = 0.3
"""Share of the joint centres' spread among people that is left to outlines: they see a joint only by its motion, and
take up other errors with it when they may move it freely (docs/accuracy.md)."""

VARYING, CONSTANT = 0.8, 0.6
"""Shares of a joint centre's distance from where the skin says: what changes with the posture, and what stays
(docs/accuracy.md)."""


def person_space(family: BodyFamily, *, numbers: int) -> ShapeSpace:
    """Give the shapes of people: the family's first numbers, and the departures from it, all of unit variance."""
    space = wider(family_space(family).keep(range(numbers)), departure_modes(family))
    joints = np.array([name.startswith(tuple(f"{joint}_" for joint in JOINT_SD)) for name in space.names])
    scale = np.where(joints, JOINT_SHARE, 1.0)
    return replace(space, prior_covariance=space.prior_covariance * np.outer(scale, scale))


def _body(family: BodyFamily, space: ShapeSpace) -> Body:
    """Make the mean body of a space over a family, in the skeleton's order of segments."""
    skeleton = family_skeleton(family)
    index = np.array([skeleton.segment_names.index(name) for name in family.segment_names])
    beneath = family.joints_sd[[family.segment_names.index(name) for name in PARENTS]]
    return Body(
        skeleton=skeleton,
        space=space,
        numbers=np.zeros(len(space)),
        faces=family.faces,
        vertex_segments=index[family.vertex_segments],
        vertex_weights=family.vertex_weights,
        joint_sd=VARYING * beneath,
        joint_offset_sd=np.hypot(CONSTANT * beneath, joint_offsets(skeleton)),
    )


def joint_offsets(skeleton: Skeleton) -> Floats:
    """Give how far (S,) joint centres lie from where outlines may draw them, by axis [m]."""
    offsets = np.zeros(len(skeleton.segment_names))
    for joint, spreads in JOINT_SD.items():
        own = [name.endswith(SEGMENT_OF_JOINT[joint]) for name in skeleton.segment_names]
        offsets[own] = np.sqrt((1.0 - JOINT_SHARE**2) * np.mean(np.square(spreads)))
    return offsets


def family_body(level: Level = "fine", numbers: int | None = None) -> Body:
    """Make the mean body of the family, ready to be posed and fitted."""
    family = load_family(level, numbers)
    return _body(family, family_space(family))


STATURE_SD = 0.01
"""How well people know how tall they stand, shoes and posture included [m]."""


def person_body(
    level: Level = "fine", *, numbers: int = 8, preset: str = "full", stature_m: float | None = None
) -> Body:
    """Make the mean body with all the numbers in which people differ: the family's first ones and the departures.

    Args:
        level: "fine" or "coarse".
        numbers: of the family; more of them absorb the clothes.
        preset: one of `PRESETS`.
        stature_m: the person's height, where it is known [m].

    Raises:
        SettingProblem: The preset is unknown.
    """
    followed = preset_named(preset)
    family = load_family(level, numbers)
    space = person_space(family, numbers=numbers)
    if stature_m is not None:
        space = condition(space, measures(family), {"stature": (stature_m, STATURE_SD)})
    body = _body(family, space)
    return preset_body(replace(body, numbers=space.prior_mean), followed)


def preset_named(name: str) -> Preset:
    """Find a preset.

    Raises:
        SettingProblem: None has the name.
    """
    if name not in PRESETS:
        raise SettingProblem(f"preset is '{name}'; it should be one of {', '.join(PRESETS)}.")
    return PRESETS[name]


def preset_body(body: Body, preset: Preset) -> Body:
    """Leave of a body what a preset follows. Where the skin ends it has no outline."""
    skeleton = body.skeleton
    if preset.coordinates is not None:
        kept = tuple(c for c in skeleton.coordinates if c.name in preset.coordinates)
        skeleton = replace(skeleton, coordinates=kept)
    segments = preset.segments or skeleton.segment_names
    there = np.isin(body.face_segment, [skeleton.segment(name) for name in segments])
    believed = ~np.isin(body.face_segment, [skeleton.segment(name) for name in preset.unseen])
    cut = np.isin(body.faces, np.unique(body.faces[~there])).any(1)
    names = preset.segments or [name for name in skeleton.segment_names if name not in preset.unseen]
    followed = np.isin(skeleton.segment_names, names)
    balls = body.metaballs
    return replace(
        body, skeleton=skeleton, faces=body.faces[there], outlined=(believed & ~cut)[there], followed=followed,
        metaballs=None if balls is None else balls.with_skeleton(skeleton),
    )  # fmt: skip
