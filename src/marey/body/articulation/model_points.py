"""Segments of a person on the bodies of a user's model: which body, where its joint centre is, and anatomical axes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, freeze_fields
from marey.body.articulation.jointed_body import JointedBody
from marey.body.articulation.jointed_kinematics import PlacedBodies, place
from marey.body.articulation.model_scaling import centre_in_ground, neutral_posture
from marey.geometry.vectors import unit

SEGMENT_JOINTS = {
    "thigh": ("hip", "knee"), "shank": ("knee", "ankle"), "foot": ("ankle", "toe"),
    "upperarm": ("shoulder", "elbow"), "forearm": ("elbow", "wrist"),
}  # fmt: skip
"""Joint centres at the upper and the lower end of a segment, without its side."""
_HIPS = ("left_hip", "right_hip")
"""Joint centres of the pelvis."""
_TRUNKS = ("torso", "thorax", "trunk")
"""Names of the body that is the thorax in common models, the first choice first."""
_RIGHT, _UP = np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0])
"""Directions to the right and up in the ground of OpenSim's models, whose X points forward."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SegmentOnModel:
    """A segment of a person on a body of a model."""

    segment: str
    """Name of the segment."""
    body: str
    """Name of the body."""
    centre: Floats
    """(3,) the joint centre about which the segment rotates, in the body [m]."""
    axes: Floats
    """(3, 3) body from anatomical axes (X anterior, Y proximal, Z right)."""

    def __post_init__(self) -> None:
        freeze_fields(self, "centre", "axes")


def segment_body(model: JointedBody, joints: Mapping[str, str], segment: str) -> str | None:
    """Return the body that is a limb's segment: the last one above its lower joint centre.

    A foot is the `calcn_l` above the toes rather than the `talus_l` below the ankle, a forearm the radius.

    Args:
        model: The model.
        joints: Maps a joint centre to the body that rotates about it.
        segment: Name of the segment, with its side.

    Returns:
        The body; None if the model has no joint centre at the upper end of the segment.
    """
    side, _, kind = segment.partition("_")
    upper, lower = SEGMENT_JOINTS.get(kind, (None, None))
    start, end = joints.get(f"{side}_{upper}"), joints.get(f"{side}_{lower}")
    above = None if end is None else model.bodies[model.body_names.index(end)].parent
    return start if above is None or start is None else above


def segments_on_model(
    model: JointedBody, joints: Mapping[str, str], segments: Sequence[str]
) -> tuple[SegmentOnModel, ...]:
    """Find the bodies of a model that are segments of a person, with their anatomical axes.

    The axes are constructed in the model's neutral posture as those of a person are in `motion.anatomical`: of pelvis
    and thorax those of the ground; Y of a limb from its lower to its upper joint centre, Z to the right, of an upper
    arm along the axis of the elbow; X of a foot from the ankle to the toes, and Y up. To the right is from the left to
    the right hip, or, without both, the ground's Z.

    Args:
        model: The model.
        joints: Maps a joint centre to the body that rotates about it.
        segments: Names of the person's segments.

    Returns:
        The segments that the model has. A thorax is one body on the pelvis; its centre is their joint.
    """
    placed = place(model, neutral_posture(model))
    right = _right(model, joints, placed)
    found = []
    for segment in segments:
        if segment == "pelvis":
            one = _pelvis(model, joints, placed, right)
        elif segment == "thorax":
            one = _thorax(model, joints, placed, right)
        else:
            one = _limb(model, joints, placed, right, segment)
        if one is not None:
            found.append(one)
    return tuple(found)


def _right(model: JointedBody, joints: Mapping[str, str], placed: PlacedBodies) -> Floats:
    """Return the direction to the person's right in the ground."""
    if not all(name in joints for name in _HIPS):
        return _RIGHT
    left, right = (centre_in_ground(model, placed, joints[name]) for name in _HIPS)
    across = (right - left) * (1 - _UP)
    return unit(across) if np.linalg.norm(across) > 0 else _RIGHT


def _on_body(
    model: JointedBody, placed: PlacedBodies, segment: str, body: str, centre: Floats, axes: Floats
) -> SegmentOnModel:
    """Express a centre (3,) and axes (3, 3) in the ground in the frame of a body."""
    k = model.body_names.index(body)
    into = placed.rotation[k].T
    return SegmentOnModel(segment=segment, body=body, centre=into @ (centre - placed.origin[k]), axes=into @ axes)


def _upright(right: Floats) -> Floats:
    return np.stack([np.cross(_UP, right), _UP, right], -1)


def _pelvis(
    model: JointedBody, joints: Mapping[str, str], placed: PlacedBodies, right: Floats
) -> SegmentOnModel | None:
    parents = {model.bodies[model.body_names.index(joints[name])].parent for name in _HIPS if name in joints}
    (body,) = parents if len(parents) == 1 else (None,)
    if body is None or not all(name in joints for name in _HIPS):
        return None
    middle = np.mean([centre_in_ground(model, placed, joints[name]) for name in _HIPS], 0)
    return _on_body(model, placed, "pelvis", body, middle, _upright(right))


def _thorax(
    model: JointedBody, joints: Mapping[str, str], placed: PlacedBodies, right: Floats
) -> SegmentOnModel | None:
    names = {body.name.lower(): body for body in model.bodies}
    body = next((names[name] for name in _TRUNKS if name in names), None)
    pelvis = {model.bodies[model.body_names.index(joints[name])].parent for name in _HIPS if name in joints}
    if body is None or body.parent not in pelvis or body.name in joints.values():
        return None
    return _on_body(
        model, placed, "thorax", body.name, centre_in_ground(model, placed, body.name), _upright(right)
    )  # fmt: skip


def _limb(
    model: JointedBody, joints: Mapping[str, str], placed: PlacedBodies, right: Floats, segment: str
) -> SegmentOnModel | None:
    side, _, kind = segment.partition("_")
    body = segment_body(model, joints, segment)
    upper, lower = (f"{side}_{joint}" for joint in SEGMENT_JOINTS.get(kind, ("", "")))
    if body is None or lower not in joints:
        return None
    top, bottom = (centre_in_ground(model, placed, joints[name]) for name in (upper, lower))
    if kind == "foot":
        x = unit((bottom - top) * (1 - _UP))
        axes = np.stack([x, _UP, np.cross(x, _UP)], -1)
    else:
        y = unit(top - bottom)
        x = unit(np.cross(y, _hinge(model, placed, joints[lower]) if kind == "upperarm" else right))
        axes = np.stack([x, y, np.cross(x, y)], -1)
    return _on_body(model, placed, segment, body, top, axes)


def _hinge(model: JointedBody, placed: PlacedBodies, body: str) -> Floats:
    """Return the first axis about which a body rotates on the one above it, in the ground in the neutral posture."""
    own = model.bodies[model.body_names.index(body)]
    above = np.eye(3) if own.parent is None else placed.rotation[model.body_names.index(own.parent)]
    axis = next((motion.axis for motion in own.motions if motion.turns and motion.coordinate is not None), _RIGHT)
    return np.asarray(above @ own.before.rotation @ axis)


def undriven_coordinates(model: JointedBody, bodies: Sequence[str]) -> tuple[str, ...]:
    """List the coordinates of joints below which none of some bodies is: nothing on these determines them.

    Args:
        model: The model.
        bodies: Bodies whose pose is known.

    Returns:
        Names of the coordinates that are free, in the order of the model.
    """
    parent = {body.name: body.parent for body in model.bodies}
    above: set[str] = set()
    for name in bodies:
        at: str | None = name
        while at is not None:
            above.add(at)
            at = parent[at]
    moved = {m.coordinate for body in model.bodies if body.name in above for m in body.motions}
    free = zip(model.coordinates, model.free, strict=True)
    return tuple(c.name for c, is_free in free if is_free and c.name not in moved)
