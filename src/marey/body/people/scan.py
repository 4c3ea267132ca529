"""A person's own scan as a body: moved to the rest posture, with the skeleton and skin weights of a template."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from marey.arrays import Floats, Integers
from marey.body.articulation.kinematics import blend_skin
from marey.body.articulation.skeleton import JOINT_OF_SEGMENT
from marey.body.articulation.surface import Body, ShapeSpace
from marey.errors import MareyError
from marey.geometry import rotations

_SIDES = ("left", "right")
"""Prefixes of the two sides' names."""
_LIMBS = ("thigh", "shank", "foot", "upperarm", "forearm", "hand")
"""Segments of the limbs whose joint centres are required."""
_NEXT = {"thigh": "shank", "shank": "foot", "upperarm": "forearm", "forearm": "hand", "foot": "toes"}
"""The segment beyond each limb segment."""
_NEIGHBOURS = 4
"""Number of the template's nearest vertices from which a vertex takes its weights. Chosen by hand."""


def scanned_body(
    template: Body,
    *,
    vertices: Floats,
    faces: Integers,
    joint_centres: Mapping[str, Floats],
    weights: Mapping[str, Floats] | None = None,
) -> Body:
    """Make a body of a scanned or modelled person: no shape parameters, the template's skeleton.

    The person stands upright, in any heading, with arms and legs in any posture. It is turned to face -y, and its limbs
    are aligned with the template's at rest, by the rotation of least angle of each, so that all joint angles are
    counted from the same posture. Joint centres that are not given (abdomen, clavicles, toes ...) are placed between
    their neighbours as in the template. Without weights, those of the template's nearest skin are used.

    Args:
        template: An average body in the rest posture.
        vertices: (V, 3) Z up [m].
        faces: (T, 3).
        joint_centres: Proximal joint centre (3,) of each segment by its name [m]; those of the limbs are required, and
            one of neck and head.
        weights: Weight (V,) of each vertex, by the name of the segment.

    Returns:
        The body at rest, its pelvis' joint centre at the origin.

    Raises:
        MareyError: A joint centre is missing.
    """
    forward = _facing_forward(joint_centres)
    names = template.skeleton.segment_names
    joints = _completed(template, {name: forward @ np.asarray(c, float) for name, c in joint_centres.items()})
    skin = np.asarray(vertices, float) @ forward.T
    turns = _turns_to_rest(template, joints)
    if weights is None:
        shares = _borrowed_shares(template, joints, turns, skin)
    else:
        shares = np.stack([np.asarray(weights.get(name, np.zeros(len(skin))), float) for name in names], 1)
    segments, strongest = _strongest(shares)
    at_rest = _joints_at_rest(template, joints, turns)
    aligned = blend_skin(skin, segments, strongest, joints, turns, at_rest)
    space = ShapeSpace(
        names=(),
        vertex_mean=aligned,
        vertex_modes=np.zeros((0, len(aligned), 3)),
        joint_mean=at_rest,
        joint_modes=np.zeros((0, len(names), 3)),
        prior_mean=np.zeros(0),
        prior_covariance=np.zeros((0, 0)),
    )
    return replace(
        template,
        space=space,
        numbers=np.zeros(0),
        numbers_covariance=None,
        faces=faces,
        vertex_segments=segments,
        vertex_weights=strongest,
    )


def _facing_forward(joint_centres: Mapping[str, Floats]) -> Floats:
    """Return the rotation about the vertical after which the person faces -y, with the left side at +x."""
    wanted = [f"{side}_{limb}" for side in _SIDES for limb in _LIMBS]
    missing = [name for name in wanted if name not in joint_centres]
    if "neck" not in joint_centres and "head" not in joint_centres:
        missing.append("neck")
    if missing:
        listed = ", ".join(JOINT_OF_SEGMENT[name] for name in missing)
        raise MareyError(f"The body lacks joint centres: {listed}. Add them, or rename the joints of the character.")
    pairs = [(f"left_{limb}", f"right_{limb}") for limb in ("thigh", "upperarm")]
    left = np.sum([np.asarray(joint_centres[a], float) - joint_centres[b] for a, b in pairs], axis=0)
    return rotations.about(np.array([0.0, 0.0, 1.0]), np.array(-np.arctan2(left[1], left[0])))


def _completed(template: Body, centres: dict[str, Floats]) -> Floats:
    """Return all joint centres (S, 3); missing ones are placed between their neighbours as in the template."""
    skeleton = template.skeleton
    names, own = skeleton.segment_names, template.joint_centres
    legs = [(f"{side}_{a}", f"{side}_{b}") for side in _SIDES for a, b in (("thigh", "shank"), ("shank", "foot"))]
    at = names.index
    size = np.mean([np.linalg.norm(centres[b] - centres[a]) / np.linalg.norm(own[at(b)] - own[at(a)]) for a, b in legs])
    if "pelvis" not in centres:
        hips = [at(f"{side}_thigh") for side in _SIDES]
        middle = np.mean([centres[f"{side}_thigh"] for side in _SIDES], axis=0)
        centres["pelvis"] = middle + size * (own[0] - own[hips].mean(0))
    above = skeleton.above()
    for k, name in enumerate(names):
        if name not in centres:
            parent = names[int(skeleton.parents[k])]
            below = [n for n in names if n in centres and above[at(n), k]]
            offset = own[k] - own[at(parent)]
            if below:
                ours, theirs = own[at(below[0])] - own[at(parent)], centres[below[0]] - centres[parent]
                offset = rotations.shortest(ours, theirs) @ offset * (np.linalg.norm(theirs) / np.linalg.norm(ours))
            else:
                offset = offset * size
            centres[name] = centres[parent] + offset
    return np.stack([centres[name] for name in names])


def _turns_to_rest(template: Body, joints: Floats) -> Floats:
    """Return the rotation (S, 3, 3) of each segment from the scan's posture to the rest posture."""
    skeleton, own = template.skeleton, template.joint_centres
    names = skeleton.segment_names
    turns = np.tile(np.eye(3), (len(names), 1, 1))
    for k, name in enumerate(names):
        side, _, kind = name.rpartition("_")
        if not side or kind == "clavicle":
            continue
        turns[k] = turns[skeleton.parents[k]]
        if kind in ("thigh", "shank", "upperarm", "forearm"):
            end = names.index(f"{side}_{_NEXT[kind]}")
            turns[k] = rotations.shortest(turns[k] @ (joints[end] - joints[k]), own[end] - own[k]) @ turns[k]
        elif kind == "foot":  # the sole stays as it is in the scan, flat; only the heading of the foot changes
            toes = names.index(f"{side}_toes")
            flat = np.array([1.0, 1.0, 0.0])
            turns[k] = rotations.shortest((joints[toes] - joints[k]) * flat, (own[toes] - own[k]) * flat)
    return turns


def _joints_at_rest(template: Body, joints: Floats, turns: Floats) -> Floats:
    placed = np.zeros_like(joints)
    for k, parent in enumerate(template.skeleton.parents):
        if parent >= 0:
            placed[k] = placed[parent] + turns[parent] @ (joints[k] - joints[parent])
    return placed


def _borrowed_shares(template: Body, joints: Floats, turns: Floats, skin: Floats) -> Floats:
    """Move the template to the scan's posture and size, and return the weights of its nearest skin (V, S)."""
    skeleton, own = template.skeleton, template.joint_centres
    size = np.ones(len(joints))
    lengths = np.linalg.norm([joints - joints[skeleton.parents], own - own[skeleton.parents]], axis=2)
    for k, parent in enumerate(skeleton.parents):
        if parent >= 0:
            size[k] = size[parent]  # a last segment keeps the size of the one before it
    for k, parent in enumerate(skeleton.parents):
        if parent >= 0 and (skeleton.parents == parent).sum() == 1:
            size[parent] = lengths[0, k] / lengths[1, k]
    back = np.ascontiguousarray(np.swapaxes(turns, 1, 2)) * size[:, None, None]
    aligned = blend_skin(template.vertices, template.vertex_segments, template.vertex_weights, own, back, joints)
    distance, nearest = cKDTree(aligned).query(skin, k=_NEIGHBOURS)
    dense = np.zeros((len(aligned), len(joints)))
    for c in range(template.vertex_segments.shape[1]):
        np.add.at(dense, (np.arange(len(aligned)), template.vertex_segments[:, c]), template.vertex_weights[:, c])
    closeness = 1.0 / (distance + 1e-3)
    return np.asarray(np.einsum("vn,vns->vs", closeness, dense[nearest]) / closeness.sum(1, keepdims=True))


def _strongest(shares: Floats) -> tuple[Integers, Floats]:
    """Keep the four largest weights of each vertex: segments (V, 4) and weights (V, 4) of sum one."""
    segments = np.argsort(-shares, axis=1)[:, :4]
    weights = np.take_along_axis(shares, segments, 1)
    total = weights.sum(1, keepdims=True)
    if (total <= 0).any():
        raise MareyError(f"{int((total <= 0).sum())} vertices of the body have no weight for any segment.")
    return np.ascontiguousarray(segments, dtype=np.int64), weights / total
