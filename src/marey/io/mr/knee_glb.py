"""GLB export of a knee's bones and cartilages in motion, for Blender and the web."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from marey.arrays import Floats, Image, Mask
from marey.geometry import rotations
from marey.io.atomic import replacing
from marey.io.axes import GLTF_FROM_WORLD
from marey.io.gltf.glb import INDEX_BUFFER, VERTEX_BUFFER, GlbBuffer
from marey.io.gltf.gltf import binary_chunk, pack_glb
from marey.knee.space.surface import TriangleSurface
from marey.markers.kinematics.transform_chain import NamedTransform

_MM = 1e3
"""Millimetres per metre; glTF's unit is the metre."""
SEE_THROUGH = 0.35
"""Opacity of bones that are drawn transparent, from 0 to 1. Chosen by eye."""
_BALL_MM, _RINGS, _SECTORS = 1.5, 7, 12
"""Radius of the ball at a centre of proximity [mm], and the numbers of its rings and sectors. Chosen by eye."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ColouredPart:
    """A structure with the colours of its vertices."""

    bone: str
    """The bone with which it moves."""
    surface: TriangleSurface
    colours: Image
    """(V, 3) red, green and blue from 0 to 255."""
    see_through: bool = False


def write_knee_glb(
    path: Path | str, parts: Mapping[str, ColouredPart], poses: Mapping[str, NamedTransform], time: Floats, *,
    balls: Mapping[str, tuple[str, Floats]], y_up: bool = False,
) -> None:  # fmt: skip
    """Write meshes that move with their bones, in metres with Y up.

    In a frame without a pose, the bone is hidden: it is scaled to a point.

    Args:
        path: The file.
        parts: Structures by name.
        poses: Pose of each bone in every frame [mm]; a constant pose is not animated.
        time: (F,) [s].
        balls: Centres of proximity by name: the bone in whose frame they are given, and their positions (F, 3) [mm].
        y_up: Whether Y points up in the frame of the poses; otherwise Z does.
    """
    buffer = GlbBuffer()
    builder = _Builder(buffer, np.asarray(time) - float(time[0]))
    meshes, materials = [], [_material(1.0), _material(SEE_THROUGH), _material(1.0, (0.05, 0.05, 0.05))]
    root: dict[str, Any] = {"name": "knee", "children": []}
    if not y_up:
        root["rotation"] = rotations.to_quaternion(np.asarray(GLTF_FROM_WORLD, float))[[1, 2, 3, 0]].tolist()
    nodes: list[dict[str, Any]] = [root]
    of_bone: dict[str, int] = {}
    for bone, pose in poses.items():
        of_bone[bone] = len(nodes)
        root["children"].append(len(nodes))
        nodes.append({"name": bone, "children": []} | builder.animate_pose(len(nodes), pose))
    for name, part in parts.items():
        meshes.append({"name": name, "primitives": [_primitive(buffer, part, int(part.see_through))]})
        nodes[of_bone[part.bone]]["children"].append(len(nodes))
        nodes.append({"name": f"{name} surface", "mesh": len(meshes) - 1})
    sphere = _sphere(_BALL_MM)
    ball = ColouredPart(bone="", surface=sphere, colours=np.full((len(sphere.vertices_mm), 3), 255, np.uint8))
    for name, (bone, places) in balls.items():
        meshes.append({"name": name, "primitives": [_primitive(buffer, ball, 2)]})
        nodes[of_bone[bone]]["children"].append(len(nodes))
        nodes.append({"name": name, "mesh": len(meshes) - 1} | builder.animate_position(len(nodes), places))
    document = _document(buffer, nodes, meshes, materials, builder)
    with replacing(path) as beside:
        beside.write_bytes(pack_glb(document, [binary_chunk(bytes(buffer.bytes))]))


class _Builder:
    """Collects the samplers and channels of the animation."""

    def __init__(self, buffer: GlbBuffer, time: Floats):
        self._buffer, self._time = buffer, time
        self.samplers: list[dict[str, Any]] = []
        self.channels: list[dict[str, Any]] = []

    def animate_pose(self, node: int, pose: NamedTransform) -> dict[str, Any]:
        """Animate a node with the pose of a bone, and return its initial transform."""
        if not pose.moves:
            return _transform(pose.rotation, pose.translation)
        known: Mask = np.asarray(np.isfinite(pose.matrix()).all((1, 2)))
        if not known.any():
            return {"scale": [0.0] * 3}
        turns = rotations.continuous(rotations.to_quaternion(pose.rotation[known]))[:, [1, 2, 3, 0]]
        self._add_channel(node, "rotation", known, turns, "VEC4")
        self._add_channel(node, "translation", known, pose.translation[known] / _MM, "VEC3")
        self._animate_visibility(node, known)
        first = int(np.argmax(known))
        return _transform(pose.rotation[first], pose.translation[first])

    def animate_position(self, node: int, places: Floats) -> dict[str, Any]:
        """Animate the translation of a node, and return its initial transform."""
        known: Mask = np.asarray(np.isfinite(places).all(1))
        if not known.any():
            return {"scale": [0.0] * 3}
        self._add_channel(node, "translation", known, places[known] / _MM, "VEC3")
        self._animate_visibility(node, known)
        return {"translation": (places[np.argmax(known)] / _MM).tolist()}

    def _animate_visibility(self, node: int, known: Mask) -> None:
        if not known.all():
            size = np.repeat(known[:, None].astype(float), 3, 1)
            self._add_channel(node, "scale", np.ones_like(known), size, "VEC3", "STEP")

    def _add_channel(
        self, node: int, what: str, keys: Mask, values: Floats, kind: str, between: str = "LINEAR"
    ) -> None:  # fmt: skip
        time = self._buffer.add(self._time[keys, None], "<f4", "SCALAR", bounds=True)
        self.channels.append({"sampler": len(self.samplers), "target": {"node": node, "path": what}})
        output = self._buffer.add(values, "<f4", kind)
        self.samplers.append({"input": time, "output": output, "interpolation": between})


def _transform(rotation: Floats, translation: Floats) -> dict[str, Any]:
    turn = rotations.to_quaternion(rotation)[[1, 2, 3, 0]]
    return {"rotation": turn.tolist(), "translation": (translation / _MM).tolist()}


def _primitive(buffer: GlbBuffer, part: ColouredPart, material: int) -> dict[str, Any]:
    surface = part.surface
    colours = np.concatenate([part.colours, np.full((len(part.colours), 1), 255)], 1)
    attributes = {
        "POSITION": buffer.add(surface.vertices_mm / _MM, "<f4", "VEC3", target=VERTEX_BUFFER, bounds=True),
        "NORMAL": buffer.add(_normals(surface), "<f4", "VEC3", target=VERTEX_BUFFER),
        "COLOR_0": buffer.add(_linear(colours), "<f4", "VEC4", target=VERTEX_BUFFER),
    }
    index = buffer.add(surface.faces.reshape(-1, 1), "<u4", "SCALAR", target=INDEX_BUFFER)
    return {"attributes": attributes, "indices": index, "material": material}


def _linear(colours: np.ndarray) -> Floats:
    """Convert sRGB colours to the linear colours that glTF uses at vertices."""
    share = np.asarray(colours, float) / 255
    share[:, :3] = np.where(share[:, :3] <= 0.04045, share[:, :3] / 12.92, ((share[:, :3] + 0.055) / 1.055) ** 2.4)
    return share


def _normals(surface: TriangleSurface) -> Floats:
    """Return unit normals (V, 3), also at vertices without a face, as glTF requires."""
    normals = surface.vertex_normals
    return np.where(np.linalg.norm(normals, axis=1, keepdims=True) > 0, normals, [0.0, 0.0, 1.0])


def _material(opacity: float, colour: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> dict[str, Any]:
    shine = {"baseColorFactor": [*colour, opacity], "metallicFactor": 0.0, "roughnessFactor": 0.7}
    return {"pbrMetallicRoughness": shine} | ({"alphaMode": "BLEND"} if opacity < 1 else {})


def _sphere(radius_mm: float) -> TriangleSurface:
    """Return a sphere of rings and sectors."""
    down, round_ = np.meshgrid(np.linspace(0, np.pi, _RINGS), np.linspace(0, 2 * np.pi, _SECTORS + 1), indexing="ij")
    places = np.stack([np.sin(down) * np.cos(round_), np.sin(down) * np.sin(round_), np.cos(down)], -1).reshape(-1, 3)
    corner = np.arange(_RINGS * (_SECTORS + 1)).reshape(_RINGS, -1)
    one, two, three, four = (
        each.ravel() for each in (corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:])
    )
    faces = np.concatenate([np.stack([one, two, three], 1), np.stack([one, three, four], 1)])
    return TriangleSurface(vertices_mm=radius_mm * places, faces=faces)


def _document(
    buffer: GlbBuffer, nodes: Sequence[dict[str, Any]], meshes: Sequence[dict[str, Any]],
    materials: Sequence[dict[str, Any]], builder: _Builder,
) -> dict[str, Any]:  # fmt: skip
    for node in nodes:
        if not node.get("children", True):
            del node["children"]
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "marey"}, "scene": 0, "scenes": [{"nodes": [0]}],
        "nodes": list(nodes), "meshes": list(meshes), "materials": list(materials),
        "bufferViews": buffer.views, "accessors": buffer.accessors, "buffers": [{"byteLength": len(buffer.bytes)}],
    }  # fmt: skip
    if builder.channels:
        document["animations"] = [{"name": "motion", "samplers": builder.samplers, "channels": builder.channels}]
    return document
