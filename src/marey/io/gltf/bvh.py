"""Writing motions to BVH."""

from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.body.articulation.surface import Body
from marey.errors import MareyError
from marey.geometry import rotations
from marey.io.atomic import replacing
from marey.io.axes import GLTF_FROM_WORLD, change_point_axes, change_rotation_axes
from marey.motion.anatomical import euler_angles
from marey.motion.motion import BodyMotion

_CENTIMETRES = 100.0
"""Number of centimetres per metre."""
_ORDER = "ZXY"
"""Order of the rotation axes in the channels of each joint."""


def write_bvh(path: Path | str, body: Body, motion: BodyMotion) -> None:
    """Write a motion in centimetres, Y up, with continuous angles in degrees in the order Z, X, Y.

    BVH cannot represent gaps: missing poses are interpolated between the neighbouring ones, and before the first and
    after the last pose, that pose is repeated. `state` in motion.npz shows which frames these are.

    Args:
        path: The file.
        body: The body at rest; the offsets are those of its joint centres.
        motion: The motion of the body's segments.

    Raises:
        MareyError: No frame has a pose.
    """
    turn, origin = _without_gaps(motion)
    local = _local(body, change_rotation_axes(GLTF_FROM_WORLD, turn))
    angles = np.degrees(np.unwrap(_nearest_branch(euler_angles(local, _ORDER)), axis=0))
    place = change_point_axes(GLTF_FROM_WORLD, origin) * _CENTIMETRES
    order = _depth_first(body)
    lines = ["HIERARCHY", *_hierarchy(body, order), "MOTION"]
    lines += [f"Frames: {len(motion)}", f"Frame Time: {1 / motion.rate:.9f}"]
    values = np.concatenate([place, angles[:, order].reshape(len(motion), -1)], 1)
    lines += [" ".join(f"{v:.6f}" for v in row) for row in values]
    with replacing(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _without_gaps(motion: BodyMotion) -> tuple[Floats, Floats]:
    """Return the rotations of the segments (F, S, 3, 3) and the positions of the root (F, 3) with gaps interpolated."""
    known = np.flatnonzero(motion.answered)
    if not len(known):
        raise MareyError("No frame of the motion has a pose, so it cannot be written as an animation.")
    turn, origin = np.array(motion.segment_rotation), np.array(motion.segment_origin[:, 0])
    turn[: known[0]], origin[: known[0]] = turn[known[0]], origin[known[0]]
    turn[known[-1] :], origin[known[-1] :] = turn[known[-1]], origin[known[-1]]
    for start, end in motion.gaps():
        whole = rotations.log(turn[end] @ np.swapaxes(turn[start - 1], -1, -2))
        for f in range(start, end):
            share = (f - start + 1) / (end - start + 1)
            turn[f] = rotations.exp(share * whole) @ turn[start - 1]
            origin[f] = (1 - share) * origin[start - 1] + share * origin[end]
    return turn, origin


def _local(body: Body, turn: Floats) -> Floats:
    """Return the rotation of each segment relative to its parent (F, S, 3, 3)."""
    local = np.array(turn)
    for k, parent in enumerate(body.skeleton.parents):
        if parent >= 0:
            local[:, k] = np.swapaxes(turn[:, parent], -1, -2) @ turn[:, k]
    return local


def _nearest_branch(angles: Floats) -> Floats:
    """Choose, of the two triples of angles of the same rotation, the one nearer to the previous frame (F, S, 3)."""
    result = np.array(angles)
    for f in range(1, len(result)):
        other = result[f] * [1, -1, 1] + np.pi
        both = np.stack([result[f], other])
        apart = np.abs(np.angle(np.exp(1j * (both - result[f - 1])))).sum(-1)
        result[f] = np.where((apart[1] < apart[0])[:, None], other, result[f])
    return result


def _depth_first(body: Body) -> list[int]:
    """Return the segments in depth-first order from the root."""
    parents = body.skeleton.parents

    def below(k: int) -> list[int]:
        return [k] + [n for child in np.flatnonzero(parents == k) for n in below(int(child))]

    return below(0)


def _hierarchy(body: Body, order: list[int]) -> list[str]:
    """Return the lines of the joints with their offsets; a segment without children ends at its farthest vertex."""
    skeleton, lines, depth = body.skeleton, [], 0
    level = {0: 0}
    for k in order:
        parent = int(skeleton.parents[k])
        level[k] = 0 if parent < 0 else level[parent] + 1
        lines += ["\t" * d + "}" for d in range(depth - 1, level[k] - 1, -1)]
        offset = np.zeros(3) if parent < 0 else body.joint_centres[k] - body.joint_centres[parent]
        pad = "\t" * level[k]
        lines += [f"{pad}{'ROOT' if parent < 0 else 'JOINT'} {skeleton.segment_names[k]}", pad + "{"]
        lines.append(f"{pad}\tOFFSET {_offset(offset)}")
        position = "6 Xposition Yposition Zposition" if parent < 0 else "3"
        lines.append(f"{pad}\tCHANNELS {position} " + " ".join(f"{axis}rotation" for axis in _ORDER))
        depth = level[k] + 1
        if not (skeleton.parents == k).any():
            lines += [f"{pad}\tEnd Site", pad + "\t{", f"{pad}\t\tOFFSET {_offset(_end(body, k))}", pad + "\t}"]
    return lines + ["\t" * d + "}" for d in range(depth - 1, -1, -1)]


def _end(body: Body, segment: int) -> Floats:
    """Return the farthest vertex of a segment relative to its joint centre (3,) [m]."""
    share = np.where(body.vertex_segments == segment, body.vertex_weights, 0).sum(1)
    own = body.vertices[share > 0.5] - body.joint_centres[segment]
    return own[np.argmax(np.linalg.norm(own, axis=1))] if len(own) else np.zeros(3)


def _offset(vector: Floats) -> str:
    """Format an offset in centimetres and the axes of the file."""
    return " ".join(f"{v + 0.0:.6f}" for v in change_point_axes(GLTF_FROM_WORLD, vector) * _CENTIMETRES)
