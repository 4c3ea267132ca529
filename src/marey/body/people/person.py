"""The body of a largely unknown person, from which a capture starts."""

from dataclasses import replace

import numpy as np

from marey.arrays import Floats, Mask
from marey.body.articulation.presets import PRESETS, Preset
from marey.body.articulation.skeleton import PARENTS, Skeleton, full_skeleton
from marey.body.articulation.surface import Body, ShapeSpace
from marey.body.people.anthropometry import condition, measures
from marey.body.people.departures import JOINT_SD, SEGMENT_OF_JOINT, departure_modes, extended_space
from marey.body.people.family import BodyFamily, DetailLevel, load_family
from marey.errors import SettingProblem


def stature(body: Body) -> tuple[float, float]:
    """Compute a body's stature from its lowest to its highest point at rest.

    Args:
        body: The body.

    Returns:
        The stature [m], and its standard deviation [m]: NaN if the body's numbers have no covariance.
    """
    highest, lowest = int(np.argmax(body.vertices[:, 2])), int(np.argmin(body.vertices[:, 2]))
    height = float(body.vertices[highest, 2] - body.vertices[lowest, 2])
    if body.numbers_covariance is None:
        return height, float("nan")
    by_number = body.space.vertex_modes[:, highest, 2] - body.space.vertex_modes[:, lowest, 2]
    return height, float(np.sqrt(by_number @ body.numbers_covariance @ by_number))


MEASURED_SD_RATIO = 0.7
"""Ratio of the standard deviation of a size to that before the images were used, above which they do not measure it:
they then explain less than half of its variance. Lengths of bodies that are seen whole have 0.04 to 0.27."""


def is_measured(sd: float, before: float) -> bool:
    """Return whether the images have measured a size of a body.

    Args:
        sd: Standard deviation of the size.
        before: Its standard deviation in people, before the images were used.

    Returns:
        True also if a standard deviation is not known.
    """
    return not sd > MEASURED_SD_RATIO * before


def measured_stature(body: Body) -> tuple[float, float] | None:
    """Return the stature and its standard deviation [m]; None if the images show too little of the body to measure it.

    Args:
        body: The fitted body.
    """
    if body.followed is not None and not body.followed.all():
        return None
    height, sd = stature(body)
    _, before = stature(before_images(body))
    return (height, sd) if is_measured(sd, before) else None


def shown_segments(body: Body) -> Mask:
    """Return the segments (S,) that a preset follows, and some of whose outline is used."""
    count = len(body.skeleton.segment_names)
    followed = np.ones(count, bool) if body.followed is None else np.asarray(body.followed)
    if body.outlined is None or body.outlined.all():
        return followed
    return followed & (np.bincount(body.face_segment[body.outlined], minlength=count) > 0)


def before_images(body: Body) -> Body:
    """Return a body with the covariance that its numbers have in people, before any image is used."""
    return replace(body, numbers_covariance=np.asarray(body.space.prior_covariance), joint_offset_sd=None)


def family_skeleton(family: BodyFamily) -> Skeleton:
    """Return the full skeleton with the family's own directions of arm, elbow and palm."""
    joints = family.joints_mean
    arm = joints[family.segment("left_hand")] - joints[family.segment("left_upperarm")]
    arm = arm / np.linalg.norm(arm)
    elbow = family.hinge_axes[family.segment("left_forearm")]
    palm = np.cross(family.hinge_axes[family.segment("left_hand")], arm)
    return full_skeleton(arm=arm, elbow=elbow, palm=palm)


def family_space(family: BodyFamily) -> ShapeSpace:
    """Return the shapes of the family, of unit variance."""
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
"""Share of the joint centres' standard deviation among people that outlines may estimate: outlines determine a joint
only by its motion, and other errors bias it if it is free: at their full spread, knees of `reach` are 14 mm off and
hips of `jacks` 31 mm (docs/accuracy/rejected.md)."""

VARYING = 0.8
"""Share of a joint centre's distance from its place in the skin that varies with the posture. How it was
chosen is not recorded; docs/accuracy/capture.md has the share of the errors that the stated intervals contain."""
CONSTANT = 0.6
"""Share of a joint centre's distance from its place in the skin that is constant over postures. How it
was chosen is not recorded; docs/accuracy/capture.md has the errors of lengths in stated standard deviations."""


def person_space(family: BodyFamily, *, numbers: int) -> ShapeSpace:
    """Return the shapes of people: the family's first numbers and the modes beyond it, all of unit variance."""
    space = extended_space(family_space(family).keep(range(numbers)), departure_modes(family))
    joints = np.array([name.startswith(tuple(f"{joint}_" for joint in JOINT_SD)) for name in space.names])
    scale = np.where(joints, JOINT_SHARE, 1.0)
    return replace(space, prior_covariance=space.prior_covariance * np.outer(scale, scale))


def _body(family: BodyFamily, space: ShapeSpace) -> Body:
    """Return the mean body of a space over a family, with segments in the skeleton's order."""
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
    """Return the standard deviation (S,) of joint centres that outlines may not estimate, per axis [m]."""
    offsets = np.zeros(len(skeleton.segment_names))
    for joint, spreads in JOINT_SD.items():
        own = [name.endswith(SEGMENT_OF_JOINT[joint]) for name in skeleton.segment_names]
        offsets[own] = np.sqrt((1.0 - JOINT_SHARE**2) * np.mean(np.square(spreads)))
    return offsets


def family_body(level: DetailLevel = "fine", numbers: int | None = None) -> Body:
    """Return the mean body of the family."""
    family = load_family(level, numbers)
    return _body(family, family_space(family))


STATURE_SD = 0.01
"""Standard deviation of a person's stated stature, shoes and posture included [m]. Chosen by hand."""


def person_body(
    level: DetailLevel = "fine", *, numbers: int = 8, preset: str = "full", stature_m: float | None = None
) -> Body:
    """Return the mean body with all shape parameters: the family's first ones and the modes beyond it.

    Args:
        level: "fine" or "coarse".
        numbers: Number of the family's numbers; further ones absorb the clothes.
        preset: One of `PRESETS`.
        stature_m: The person's stature, if known [m].

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
    """Return a preset by its name.

    Raises:
        SettingProblem: There is no preset of this name.
    """
    if name not in PRESETS:
        raise SettingProblem(f"There is no preset '{name}'. It should be one of {', '.join(PRESETS)}.")
    return PRESETS[name]


def preset_body(body: Body, preset: Preset) -> Body:
    """Return the part of a body that a preset follows. Faces at the edge of the remaining skin have no outline."""
    skeleton = body.skeleton
    if preset.coordinates is not None:
        kept = tuple(c for c in skeleton.coordinates if c.name in preset.coordinates)
        skeleton = replace(skeleton, coordinates=kept)
    segments = preset.segments or skeleton.segment_names
    there = np.isin(body.face_segment, [skeleton.segment(name) for name in segments])
    counted = ~np.isin(body.face_segment, [skeleton.segment(name) for name in preset.without_outline])
    cut = np.isin(body.faces, np.unique(body.faces[~there])).any(1)
    names = preset.segments or [name for name in skeleton.segment_names if name not in preset.without_outline]
    followed = np.isin(skeleton.segment_names, names)
    balls = body.metaballs
    return replace(
        body, skeleton=skeleton, faces=body.faces[there], outlined=(counted & ~cut)[there], followed=followed,
        metaballs=None if balls is None else balls.with_skeleton(skeleton),
    )  # fmt: skip
