"""GLB export of deforming points, for Blender, game engines and the web, with basis shapes as morph targets."""

from pathlib import Path
from typing import Any

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.geometry import rotations
from marey.io.atomic import replacing
from marey.io.axes import GLTF_FROM_WORLD
from marey.io.gltf.glb import INDEX_BUFFER, VERTEX_BUFFER, GlbBuffer
from marey.io.gltf.gltf import binary_chunk, pack_glb
from marey.io.shapes.shapes import upright
from marey.nonrigid.recovered import RecoveredShapes

_POINTS, _LINES = 0, 1
"""Primitive modes POINTS and LINES of the glTF 2.0 specification."""


def write_shape_glb(
    path: Path | str, found: RecoveredShapes, edges: Integers, *, rate: float, scale: float, unit: str, y_up: bool
) -> None:
    """Write the mean shape with a morph target for each further basis shape, and the motion; Y points up.

    The weights of the targets are the coefficients, so that every frame is exactly the recovered shape. Frames without
    a result have no key frame. Points that have a result in no frame are omitted.

    Args:
        path: The file.
        found: The recovered shapes.
        edges: (E, 2) lines between points.
        rate: Sampling rate [Hz].
        scale: Metres per unit of the shapes, or a factor that makes an object of unknown size about 1 m large.
        unit: Unit of the shapes, stored in the `extras` of the file.
        y_up: Whether Y points up in the laboratory; otherwise Z does.
    """
    buffer = GlbBuffer()
    known: Mask = np.asarray(np.isfinite(found.basis).all((0, 1)))
    lines = _lines_between(edges, known)
    targets = [{"POSITION": _positions(buffer, shape[:, known])} for shape in scale * found.basis[1:]]
    position = {"POSITION": _positions(buffer, scale * found.basis[0][:, known])}
    parts: list[dict[str, Any]] = [{"attributes": position, "mode": _POINTS, "material": 0}]
    if len(lines):
        index = buffer.add(lines.reshape(-1, 1), "<u4", "SCALAR", target=INDEX_BUFFER)
        parts.append({"attributes": position, "mode": _LINES, "indices": index, "material": 0})
    mesh: dict[str, Any] = {"name": "points", "primitives": parts}
    if targets:
        mesh |= {"weights": [0.0] * len(targets)}
        for part in parts:
            part["targets"] = targets
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "marey", "extras": {"unit": unit, "metres_per_unit": scale}},
        "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"name": "object", "mesh": 0}], "meshes": [mesh],
        "materials": [{"pbrMetallicRoughness": {"baseColorFactor": [0.03, 0.15, 0.46, 1.0], "metallicFactor": 0.0}}],
        "animations": [_animation(buffer, found, rate, scale, y_up=y_up)],
    }  # fmt: skip
    document |= {
        "bufferViews": buffer.views, "accessors": buffer.accessors, "buffers": [{"byteLength": len(buffer.bytes)}],
    }  # fmt: skip
    with replacing(path) as beside:
        beside.write_bytes(pack_glb(document, [binary_chunk(bytes(buffer.bytes))]))


def _positions(buffer: GlbBuffer, shape: Floats) -> int:
    return buffer.add(shape.T, "<f4", "VEC3", target=VERTEX_BUFFER, bounds=True)


def _lines_between(edges: Integers, known: Mask) -> Integers:
    """Return the edges between known points, with indices among the known points only."""
    number = np.cumsum(known) - 1
    return np.asarray(number[edges[known[edges].all(1)]]) if len(edges) else np.zeros((0, 2), np.int64)


def _animation(buffer: GlbBuffer, found: RecoveredShapes, rate: float, scale: float, *, y_up: bool) -> dict[str, Any]:
    """Animate the node with the pose of the object, and the morph targets with the coefficients."""
    # Frames in which no camera sees the object have no translation.
    answered = np.flatnonzero(found.answered & np.isfinite(found.translation).all(1))
    time = buffer.add(answered[:, None] / rate, "<f4", "SCALAR", bounds=True)
    turn = GLTF_FROM_WORLD @ upright(found, y_up=y_up)
    where = found.origin[answered]
    # The origin of an image is arbitrary in space: the positions are centred at the world's origin.
    where = scale * (where - where.mean(0)) @ turn.T
    turns = rotations.continuous(rotations.to_quaternion(turn @ found.rotation[answered]))[:, [1, 2, 3, 0]]
    tracks = [("translation", where, "VEC3"), ("rotation", turns, "VEC4")]
    if found.basis_shapes > 1:
        tracks.append(("weights", found.coefficients[answered, 1:].reshape(-1, 1), "SCALAR"))
    samplers = [
        {"input": time, "output": buffer.add(values, "<f4", kind), "interpolation": "LINEAR"}
        for _, values, kind in tracks
    ]
    channels = [{"sampler": n, "target": {"node": 0, "path": name}} for n, (name, _, _) in enumerate(tracks)]
    return {"name": "motion", "samplers": samplers, "channels": channels}
