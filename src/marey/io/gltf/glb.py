"""Writing a body with its skin and motion to GLB (glTF 2.0), for Blender, game engines and the web."""

from pathlib import Path
from typing import Any

import numpy as np

from marey.arrays import Floats, Integers
from marey.body.articulation.surface import Body
from marey.errors import MareyError
from marey.geometry import rotations
from marey.io.atomic import replacing
from marey.io.axes import GLTF_FROM_WORLD, change_point_axes, change_rotation_axes
from marey.io.gltf.gltf import binary_chunk, pack_glb
from marey.io.gltf.structure import COMPONENT
from marey.motion.motion import BodyMotion

VERTEX_BUFFER, INDEX_BUFFER = 34962, 34963
"""Targets ARRAY_BUFFER and ELEMENT_ARRAY_BUFFER of a buffer view, by the glTF 2.0 specification."""
_SKIN_COLOUR = [0.80, 0.66, 0.56, 1.0]
"""Colour of the skin: red, green, blue and opacity, from 0 to 1; chosen by hand."""


class GlbBuffer:
    """The binary buffer of a GLB, with the views and accessors that describe it."""

    def __init__(self) -> None:
        self.bytes = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(self, array: np.ndarray, kind: str, shape: str, *, target: int | None = None, bounds: bool = False) -> int:
        """Append an array and return the index of its accessor.

        Args:
            array: (n, width).
            kind: Type of an element, a key of `COMPONENT`.
            shape: Type of a row in glTF (`SCALAR`, `VEC3`, ...).
            target: Target of the buffer view; None for data that are not vertices.
            bounds: Whether to store the minimum and maximum of each column.
        """
        data = np.ascontiguousarray(array, dtype=kind)
        self.bytes += b"\0" * (-len(self.bytes) % 4)
        view: dict[str, Any] = {"buffer": 0, "byteOffset": len(self.bytes), "byteLength": data.nbytes}
        self.views.append(view | ({"target": target} if target else {}))
        self.bytes += data.tobytes()
        accessor: dict[str, Any] = {
            "bufferView": len(self.views) - 1, "componentType": COMPONENT[kind], "count": len(data), "type": shape,
        }  # fmt: skip
        if bounds:
            flat = data.reshape(len(data), -1)
            accessor |= {"min": flat.min(0).tolist(), "max": flat.max(0).tolist()}
        self.accessors.append(accessor)
        return len(self.accessors) - 1


def write_glb(path: Path | str, body: Body, motion: BodyMotion | None = None) -> None:
    """Write a skinned mesh, and its motion as rotations of the segments, in metres, Y up, with one node per segment.

    Frames without a pose have no key: a viewer interpolates between the neighbouring poses.

    Args:
        path: The file.
        body: The body at rest, which is the bind pose of the skin.
        motion: The motion of this body; None, or a motion without any pose, gives a file without animation.

    Raises:
        MareyError: The motion has other segments than the body.
    """
    names = body.skeleton.segment_names
    buffer = GlbBuffer()
    count = len(names)
    nodes = [*_nodes(body), {"name": "body", "mesh": 0, "skin": 0}]
    root = int(np.flatnonzero(body.skeleton.parents < 0)[0])
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "marey"},
        "scene": 0,
        "scenes": [{"nodes": [root, count]}],
        "nodes": nodes,
        "meshes": [{"name": "skin", "primitives": [_primitive(buffer, body)]}],
        "skins": [{"joints": list(range(count)), "skeleton": root, "inverseBindMatrices": _bind(buffer, body)}],
        "materials": [{"pbrMetallicRoughness": {
            "baseColorFactor": _SKIN_COLOUR, "metallicFactor": 0.0, "roughnessFactor": 0.8,
        }}],
    }  # fmt: skip
    if motion is not None and motion.answered.any():
        if motion.segment_names != names:
            raise MareyError("The segments of the motion differ from those of the body. Give the motion of this body.")
        document["animations"] = [_animation(buffer, body, motion, root)]
    document |= {
        "bufferViews": buffer.views, "accessors": buffer.accessors, "buffers": [{"byteLength": len(buffer.bytes)}],
    }  # fmt: skip
    with replacing(path) as temporary:
        temporary.write_bytes(pack_glb(document, [binary_chunk(bytes(buffer.bytes))]))


def _nodes(body: Body) -> list[dict[str, Any]]:
    """Return one node per segment, at rest."""
    skeleton, nodes = body.skeleton, []
    for k, (name, parent) in enumerate(zip(skeleton.segment_names, skeleton.parents, strict=True)):
        offset = body.joint_centres[k] - (body.joint_centres[parent] if parent >= 0 else 0)
        node: dict[str, Any] = {"name": name, "translation": change_point_axes(GLTF_FROM_WORLD, offset).tolist()}
        children = np.flatnonzero(skeleton.parents == k).tolist()
        nodes.append(node | ({"children": children} if children else {}))
    return nodes


def _primitive(buffer: GlbBuffer, body: Body) -> dict[str, Any]:
    """Add the skin of a body to the buffer and return its primitive."""
    vertices = change_point_axes(GLTF_FROM_WORLD, body.vertices)
    joints, weights = _carriers(body)
    attributes = {
        "POSITION": buffer.add(vertices, "<f4", "VEC3", target=VERTEX_BUFFER, bounds=True),
        "NORMAL": buffer.add(_normals(vertices, body.faces), "<f4", "VEC3", target=VERTEX_BUFFER),
        "JOINTS_0": buffer.add(joints, "u1", "VEC4", target=VERTEX_BUFFER),
        "WEIGHTS_0": buffer.add(weights, "<f4", "VEC4", target=VERTEX_BUFFER),
    }
    indices = buffer.add(body.faces.reshape(-1, 1), "<u4", "SCALAR", target=INDEX_BUFFER)
    return {"attributes": attributes, "indices": indices, "material": 0}


def _carriers(body: Body) -> tuple[Integers, Floats]:
    """Return the four distinct segments (V, 4) with the largest weights of each vertex, and the weights (V, 4)."""
    shares = np.zeros((len(body.vertices), len(body.skeleton.segment_names)))
    for c in range(body.vertex_segments.shape[1]):
        np.add.at(shares, (np.arange(len(shares)), body.vertex_segments[:, c]), body.vertex_weights[:, c])
    joints = np.argsort(-shares, axis=1, kind="stable")[:, :4]
    weights = np.take_along_axis(shares, joints, 1).astype("<f4")
    weights = weights / weights.sum(1, keepdims=True)
    return np.where(weights > 0, joints, 0), weights


def _normals(vertices: Floats, faces: np.ndarray) -> Floats:
    """Return the normal of each vertex (V, 3): the mean of the normals of its faces, weighted by area."""
    corner = vertices[faces]
    across = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    total = np.zeros_like(vertices)
    for c in range(3):
        np.add.at(total, faces[:, c], across)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 0, total / np.where(length > 0, length, 1), [0.0, 1.0, 0.0])


def _bind(buffer: GlbBuffer, body: Body) -> int:
    """Add the inverse bind matrices to the buffer and return the index of their accessor."""
    matrices = np.tile(np.eye(4), (len(body.joint_centres), 1, 1))
    matrices[:, :3, 3] = -change_point_axes(GLTF_FROM_WORLD, body.joint_centres)
    return buffer.add(np.swapaxes(matrices, 1, 2).reshape(-1, 16), "<f4", "MAT4")  # column by column


def _animation(buffer: GlbBuffer, body: Body, motion: BodyMotion, root: int) -> dict[str, Any]:
    """Add the poses of a motion to the buffer and return the animation."""
    known = np.flatnonzero(motion.answered)
    time = buffer.add(motion.time[known, None], "<f4", "SCALAR", bounds=True)
    turn = change_rotation_axes(GLTF_FROM_WORLD, motion.segment_rotation[known])
    samplers: list[dict[str, Any]] = []
    channels: list[dict[str, Any]] = []

    def track(node: int, path: str, values: Floats, shape: str) -> None:
        channels.append({"sampler": len(samplers), "target": {"node": node, "path": path}})
        samplers.append({"input": time, "output": buffer.add(values, "<f4", shape), "interpolation": "LINEAR"})

    track(root, "translation", change_point_axes(GLTF_FROM_WORLD, motion.segment_origin[known, root]), "VEC3")
    for k, parent in enumerate(body.skeleton.parents):
        local = turn[:, k] if parent < 0 else np.swapaxes(turn[:, parent], -1, -2) @ turn[:, k]
        track(k, "rotation", rotations.continuous(rotations.to_quaternion(local))[:, [1, 2, 3, 0]], "VEC4")
    return {"name": "motion", "samplers": samplers, "channels": channels}
