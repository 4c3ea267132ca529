"""Characters: somebody's own body as a skinned GLB, or as a mesh with joint centres in a TOML."""

import json
import struct
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from marey.arrays import Floats, Integers, frozen
from marey.body.skeleton import JOINT_OF_SEGMENT, PARENTS
from marey.errors import FileProblem
from marey.geometry import rotations
from marey.io.axes import GLTF_FROM_WORLD, turned_points

_METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
_WORLD_FROM_UP = {"z": np.eye(3), "y": np.asarray(GLTF_FROM_WORLD).T}
_LIMBS = {
    "clavicle": ("shoulder",), "upperarm": ("arm",), "forearm": ("forearm",), "hand": ("hand",),
    "thigh": ("upleg",), "shank": ("leg",), "foot": ("foot",), "toes": ("toebase", "toe"),
}  # fmt: skip
_OTHER_NAMES = {"hips": "pelvis", "spine": "abdomen", "spine2": "thorax", "chest": "thorax"} | {
    f"{side}{name}": f"{side}_{segment}" for side in ("left", "right") for segment, s in _LIMBS.items() for name in s
}
"""What Mixamo and its kin call our segments, in small letters; spine1 belongs to the abdomen where spine2 is there."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Character:
    """A body that came in a file, at rest, in metres, Z up."""

    vertices: Floats
    """(V, 3) [m]."""
    faces: Integers
    """(T, 3)."""
    joint_centres: dict[str, Floats]
    """By segment: the centre (3,) about which it turns on its parent [m]."""
    weights: dict[str, Floats] | None
    """By segment: its share (V,) of each vertex, of sum one; None where the file has none."""
    node_names: dict[str, str]
    """By segment: what the file calls it."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "vertices", frozen(self.vertices))
        object.__setattr__(self, "faces", frozen(self.faces, np.int64))


def read_character(path: Path | str) -> Character:
    """Read a body: a skinned GLB, or a TOML that names a mesh and gives its joint centres.

    The TOML has `mesh` (OBJ, PLY, STL or GLB beside it), optionally `unit` ("m", "cm", "mm") and `up` ("z", "y"), and
    `[joints]` with `name = [x, y, z]` for the pelvis and the joint centres, in the mesh's own unit and axes.

    Args:
        path: The file.

    Raises:
        FileProblem: It cannot be read, or lacks what a body needs.
    """
    return _read_described(Path(path)) if Path(path).suffix.lower() == ".toml" else read_skinned(path)


def segment_called(name: str) -> str | None:
    """Find the segment that a node's name means: ours, or Mixamo's with or without its prefix."""
    plain = name.split(":")[-1]
    if plain.lower() in PARENTS:
        return plain.lower()
    bare = "".join(c for c in plain.lower() if c.isalnum()).removeprefix("mixamorig")
    return bare if bare in PARENTS else _OTHER_NAMES.get(bare)


def _read_described(path: Path) -> Character:
    try:
        described = tomllib.loads(path.read_text())
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise FileProblem(path, f"cannot be read ({error})", "Give a TOML with `mesh` and `[joints]`.") from error
    unknown = set(described) - {"mesh", "unit", "up", "joints"}
    if unknown:
        raise FileProblem(path, f"has the unknown key {sorted(unknown)[0]!r}", "Known are mesh, unit, up and joints.")
    unit, up, centres = described.get("unit", "m"), described.get("up", "z"), described.get("joints")
    if unit not in _METRES or up not in _WORLD_FROM_UP:
        raise FileProblem(path, f"has unit = {unit!r}, up = {up!r}", "Give unit m, cm or mm, and up z or y.")
    if not isinstance(centres, dict) or "mesh" not in described:
        raise FileProblem(path, "lacks `mesh` or `[joints]`", "Name the mesh, and each joint as name = [x, y, z].")
    vertices, faces = read_mesh(path.parent / str(described["mesh"]))
    change = _METRES[unit] * _WORLD_FROM_UP[up]
    segment_of = {joint: segment for segment, joint in JOINT_OF_SEGMENT.items()}
    placed = {}
    for name, centre in centres.items():
        segment = segment_of.get(name, name)
        if segment not in PARENTS or np.shape(centre) != (3,):
            raise FileProblem(
                path, f"has the joint {name!r} = {centre}", f"Known are {', '.join(_joints())}; 3 numbers."
            )
        placed[segment] = change @ np.asarray(centre, float)
    names = {segment: JOINT_OF_SEGMENT.get(segment, segment) for segment in placed}
    return Character(vertices=vertices @ change.T, faces=faces, joint_centres=placed, weights=None, node_names=names)


def _joints() -> list[str]:
    return [JOINT_OF_SEGMENT.get(segment, segment) for segment in PARENTS]


def read_mesh(path: Path | str) -> tuple[Floats, Integers]:
    """Read a triangle mesh (OBJ, PLY, STL, GLB ...), equal vertices joined.

    Args:
        path: The file.

    Returns:
        Vertices (V, 3) in the file's unit and axes, faces (T, 3).

    Raises:
        FileProblem: It cannot be read or has no faces.
    """
    try:
        mesh: Any = trimesh.load(path, force="mesh")
        mesh.merge_vertices(merge_tex=True, merge_norm=True)
    except Exception as error:  # trimesh' many formats fail in many ways
        raise FileProblem(path, f"cannot be read as a mesh ({error})", "Give an OBJ, PLY, STL or GLB.") from error
    if not len(mesh.faces):
        raise FileProblem(path, "has no faces", "Give a mesh of triangles.")
    return np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)


class _Gltf:
    """The parts of a GLB that a skinned body needs."""

    def __init__(self, path: Path | str):
        self.path = path
        try:
            data = Path(path).read_bytes()
            magic, version, _ = struct.unpack_from("<III", data)
            length, kind = struct.unpack_from("<II", data, 12)
            if magic != 0x46546C67 or version != 2 or kind != 0x4E4F534A:
                raise ValueError("it does not begin as one")
            self.document: dict[str, Any] = json.loads(data[20 : 20 + length])
            self.binary = data[28 + length :]
        except (OSError, ValueError, struct.error) as error:
            raise FileProblem(path, f"is no GLB, version 2 ({error})", "Export glTF binary (.glb).") from error
        self.nodes: list[dict[str, Any]] = self.document.get("nodes", [])

    def array(self, index: int) -> np.ndarray:
        """Read one accessor (n, width) as float64 or integers."""
        accessor = self.document["accessors"][index]
        view = self.document["bufferViews"][accessor["bufferView"]]
        kind = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}[accessor["componentType"]]
        width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}[accessor["type"]]
        size = np.dtype(kind).itemsize
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        stride = view.get("byteStride", width * size)
        rows = np.ndarray((accessor["count"], width), kind, self.binary, start, (stride, size))
        scale = float(np.iinfo(kind).max) if accessor.get("normalized") else 1.0
        return rows / scale if accessor.get("normalized") else rows.astype(float if kind == "<f4" else np.int64)

    def world_from_nodes(self) -> Floats:
        """Give each node's matrix (n, 4, 4) in the scene, as the file poses it."""
        local = np.stack([_local_matrix(node) for node in self.nodes])
        world, parent = np.array(local), self.parents()
        for n in range(len(self.nodes)):
            up = parent.get(n)
            while up is not None:
                world[n] = local[up] @ world[n]
                up = parent.get(up)
        return world

    def parents(self) -> dict[int, int]:
        """Give each node's parent."""
        return {child: n for n, node in enumerate(self.nodes) for child in node.get("children", [])}


def _local_matrix(node: Mapping[str, Any]) -> Floats:
    if "matrix" in node:
        return np.array(node["matrix"], float).reshape(4, 4).T
    matrix = np.eye(4)
    x, y, z, w = node.get("rotation", (0, 0, 0, 1))
    matrix[:3, :3] = rotations.from_quaternion(np.array([w, x, y, z], float)) * np.array(node.get("scale", (1, 1, 1)))
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix


def read_skinned(path: Path | str) -> Character:
    """Read a skinned GLB in the pose in which the file shows it, turned so that Z is up.

    A node that is none of our segments (a finger, a twist bone) gives its skin to the next segment above it.

    Args:
        path: The file.

    Raises:
        FileProblem: It is no GLB, has no skin, or none of our segments.
    """
    gltf = _Gltf(path)
    skinned = [(n["mesh"], n["skin"]) for n in gltf.nodes if "mesh" in n and "skin" in n]
    if not skinned:
        raise FileProblem(path, "has no skinned mesh", "Export the character with its armature and skin.")
    world = gltf.world_from_nodes()
    owner = _segments_of_nodes(gltf, skinned)
    vertices, faces, weights, start = [], [], [], 0
    try:
        for mesh, skin in skinned:
            for primitive in gltf.document["meshes"][mesh]["primitives"]:
                points, shares = _posed(gltf, primitive, gltf.document["skins"][skin], world)
                vertices.append(points)
                weights.append(shares)
                count = len(points)
                index = gltf.array(primitive["indices"]).ravel() if "indices" in primitive else np.arange(count)
                faces.append(index.reshape(-1, 3) + start)
                start += count
    except (KeyError, IndexError, ValueError, TypeError) as error:
        raise FileProblem(path, f"is damaged or uses what is not read here ({error!r})", "Export it again.") from error
    return _assemble(np.concatenate(vertices), np.concatenate(faces), np.concatenate(weights), owner, gltf, world)


def _segments_of_nodes(gltf: _Gltf, skinned: list[tuple[int, int]]) -> dict[int, str]:
    """Tell which segment each joint node belongs to: its own, or that of the next node above which has one."""
    joints = {node for _, skin in skinned for node in gltf.document["skins"][skin]["joints"]}
    parent = gltf.parents()
    named: dict[int, str] = {}
    for node in joints:
        segment = segment_called(gltf.nodes[node].get("name", ""))
        if segment is not None and segment not in named.values():
            named[node] = segment
    if not named:
        names = ", ".join(sorted(gltf.nodes[n].get("name", "?") for n in joints)[:8])
        raise FileProblem(
            gltf.path, f"has no joint whose name is known ({names} ...)", f"Name them {', '.join(PARENTS)}."
        )
    top = min(named, key=lambda n: list(PARENTS).index(named[n]))
    owner = {}
    for node in joints:
        up: int | None = node
        while up is not None and up not in named:
            up = parent.get(up)
        owner[node] = named[top if up is None else up]
    return owner | named


def _posed(gltf: _Gltf, primitive: dict[str, Any], skin: dict[str, Any], world: Floats) -> tuple[Floats, Floats]:
    """Pose a primitive's vertices (V, 3) in the scene, and spread its weights over the nodes (V, n)."""
    attributes = primitive["attributes"]
    points = gltf.array(attributes["POSITION"])
    joints = np.array(skin["joints"])
    bind = np.tile(np.eye(4), (len(joints), 1, 1))
    if "inverseBindMatrices" in skin:
        bind = np.swapaxes(gltf.array(skin["inverseBindMatrices"]).reshape(-1, 4, 4), 1, 2)
    shares = np.zeros((len(points), len(gltf.nodes)))
    sets = [key.removeprefix("JOINTS_") for key in attributes if key.startswith("JOINTS_")]
    for number in sets:
        nodes = joints[gltf.array(attributes[f"JOINTS_{number}"])]
        for c, weight in enumerate(gltf.array(attributes[f"WEIGHTS_{number}"]).T):
            np.add.at(shares, (np.arange(len(points)), nodes[:, c]), weight)
    shares /= shares.sum(1, keepdims=True)
    matrices = np.zeros((len(gltf.nodes), 3, 4))
    matrices[joints] = (world[joints] @ bind)[:, :3]
    moved = np.einsum("vn,nab->vab", shares, matrices)
    return np.einsum("vab,vb->va", moved[..., :3], points) + moved[..., 3], shares


def _assemble(
    vertices: Floats, faces: Integers, shares: Floats, owner: dict[int, str], gltf: _Gltf, world: Floats
) -> Character:
    """Gather nodes into segments and turn everything so that Z is up."""
    order = [segment for segment in PARENTS if segment in owner.values()]
    weights = {s: shares[:, [n for n, o in owner.items() if o == s]].sum(1) for s in order}
    nodes = {
        s: next(n for n, o in owner.items() if o == s and segment_called(gltf.nodes[n].get("name", "")) == s)
        for s in order
    }
    back = np.asarray(GLTF_FROM_WORLD).T
    return Character(
        vertices=turned_points(back, vertices),
        faces=faces,
        joint_centres={s: turned_points(back, world[n, :3, 3]) for s, n in nodes.items()},
        weights=weights,
        node_names={s: gltf.nodes[n].get("name", "") for s, n in nodes.items()},
    )
