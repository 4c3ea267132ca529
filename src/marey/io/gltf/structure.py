"""The structure of a glTF document, checked before its nodes and arrays are used.

Only what the readers use is checked: nodes and their tree, meshes, skins, and the place of each array in its buffer.
"""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from marey.io.documents import finite, whole_number

COMPONENT = {"i1": 5120, "u1": 5121, "<i2": 5122, "<u2": 5123, "<u4": 5125, "<f4": 5126}
"""Component type of an accessor by NumPy type, by the glTF 2.0 specification."""
WIDTH = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
"""Number of components by the type of an accessor that is read, by the glTF 2.0 specification."""
_PARTS = {"translation": (3,), "rotation": (4,), "scale": (3,), "matrix": (16,)}
"""Shape of the numbers that place a node."""
_LISTS = ("nodes", "meshes", "skins", "accessors", "bufferViews", "buffers")
"""Lists of the document that are used."""
_LARGEST = 2**40
"""Largest size in a document [bytes or elements]. Chosen by hand: far beyond every file."""


def document_fault(document: Mapping[str, Any]) -> str | None:
    """Return the first fault of a document as the predicate of a sentence; None if it has none."""
    return next(_faults(document), None)


def _faults(document: Mapping[str, Any]) -> Iterator[str]:
    for name in _LISTS:
        entries = document.get(name, [])
        if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
            yield f"has no list of tables called {name}"
            return
    yield from _faults_of_nodes(document)
    yield from _faults_of_skins(document)
    yield from _faults_of_arrays(document)


def _is_index(value: object, document: Mapping[str, Any], name: str) -> bool:
    return isinstance(value, int) and whole_number(value, least=0, greatest=len(document.get(name, [])) - 1) is not None


def _faults_of_nodes(document: Mapping[str, Any]) -> Iterator[str]:
    nodes = document.get("nodes", [])
    parents: dict[int, int] = {}
    for n, node in enumerate(nodes):
        for key, shape in _PARTS.items():
            if key in node and finite(node[key], shape) is None:
                yield f"has a node {n} whose {key} is not {shape[0]} numbers"
        for key in ("mesh", "skin"):
            if key in node and not _is_index(node[key], document, f"{key}es" if key == "mesh" else "skins"):
                yield f"has a node {n} with a {key} that does not exist"
        children = node.get("children", [])
        if not isinstance(children, list) or not all(_is_index(child, document, "nodes") for child in children):
            yield f"has a node {n} with children that do not exist"
            return
        for child in children:
            if child in parents:
                yield f"has a node {child} with two parents"
            parents[child] = n
    if _has_circle(parents):
        yield "has a node that is its own ancestor"


def _has_circle(parents: Mapping[int, int]) -> bool:
    """Return whether the tree of nodes has a circle; every node is visited once."""
    sound: set[int] = set()
    for node in parents:
        path: set[int] = set()
        at: int | None = node
        while at is not None and at not in sound:
            if at in path:
                return True
            path.add(at)
            at = parents.get(at)
        sound |= path
    return False


def _faults_of_skins(document: Mapping[str, Any]) -> Iterator[str]:
    for s, skin in enumerate(document.get("skins", [])):
        joints = skin.get("joints")
        if not isinstance(joints, list) or not joints:
            yield f"has a skin {s} without joints"
        elif not all(_is_index(joint, document, "nodes") for joint in joints):
            yield f"has a skin {s} with joints that do not exist"
    for m, mesh in enumerate(document.get("meshes", [])):
        primitives = mesh.get("primitives")
        sound = isinstance(primitives, list) and all(
            isinstance(each, dict) and isinstance(each.get("attributes"), dict) for each in primitives
        )
        if not sound:
            yield f"has a mesh {m} without primitives and their attributes"


def _faults_of_arrays(document: Mapping[str, Any]) -> Iterator[str]:
    views = document.get("bufferViews", [])
    for v, view in enumerate(views):
        sizes = [whole_number(view.get(key, 0), least=0, greatest=_LARGEST) for key in ("byteOffset", "byteStride")]
        if not _is_index(view.get("buffer"), document, "buffers") or None in sizes:
            yield f"has a part {v} of a buffer that does not exist"
    for a, accessor in enumerate(document.get("accessors", [])):
        if "bufferView" not in accessor or "sparse" in accessor:
            continue  # `Gltf.array` reports it where it is used.
        numbers = [whole_number(accessor.get(key, 0), least=0, greatest=_LARGEST) for key in ("count", "byteOffset")]
        known = accessor.get("componentType") in list(COMPONENT.values()) and accessor.get("type") in list(WIDTH)
        if not _is_index(accessor["bufferView"], document, "bufferViews") or None in numbers or not known:
            yield f"has an array {a} of an unknown type, or outside its buffer"


def array_fits(rows: int, width: int, kind: str, start: int, stride: int, length: int) -> bool:
    """Return whether rows of a width and type, with the given start and stride [bytes], lie within a length [bytes]."""
    size = width * np.dtype(kind).itemsize
    return rows == 0 or start + (rows - 1) * stride + size <= length
