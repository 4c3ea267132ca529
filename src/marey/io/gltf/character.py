"""Reading characters: a skinned GLB, or a mesh with joint centres in a TOML."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from marey.arrays import Floats, Integers, freeze_fields
from marey.body.articulation.skeleton import JOINT_OF_SEGMENT, PARENTS
from marey.errors import FileProblem
from marey.io.axes import GLTF_FROM_WORLD, change_point_axes
from marey.io.documents import read_tables
from marey.io.gltf.gltf import Gltf
from marey.io.gltf.rig_names import VRM_BONES, name_joints, path_up
from marey.io.units import METRES
from marey.wording import listed

_WORLD_FROM_UP = {"z": np.eye(3), "y": np.asarray(GLTF_FROM_WORLD).T}
"""Rotation (3, 3) into the world's axes by the axis of the mesh that points up."""
_LISTED = 8
"""Largest number of joints that an error message lists; chosen by hand."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Character:
    """A body at rest that was read from a file, in metres, Z up."""

    vertices: Floats
    """(V, 3) [m]."""
    faces: Integers
    """(T, 3)."""
    joint_centres: dict[str, Floats]
    """Maps a segment to the centre (3,) of the joint between it and its parent [m]."""
    weights: dict[str, Floats] | None
    """Maps a segment to its skinning weights (V,), which sum to one over the segments; None if the file has none."""
    node_names: dict[str, str]
    """Maps a segment to its name in the file."""

    def __post_init__(self) -> None:
        freeze_fields(self, "vertices")
        freeze_fields(self, "faces", dtype=np.int64)


def read_character(path: Path | str) -> Character:
    """Read a character from a skinned GLB, or from a TOML that names a mesh and its joint centres.

    The TOML has `mesh` (an OBJ, PLY, STL or GLB in the same folder), optionally `unit` ("m", "cm", "mm") and `up` ("z",
    "y"), and `[joints]` with `name = [x, y, z]` for the pelvis and the joint centres, in the unit and axes of the mesh.

    Args:
        path: The file.

    Returns:
        The character at rest.

    Raises:
        FileProblem: The file cannot be read, or lacks the mesh, the skin or the joints.
    """
    return _read_described(Path(path)) if Path(path).suffix.lower() == ".toml" else read_skinned(path)


def _read_described(path: Path) -> Character:
    described = read_tables(path, "Give a TOML with `mesh` and `[joints]`.")
    unknown = set(described) - {"mesh", "unit", "up", "joints"}
    if unknown:
        remedy = "The known keys are mesh, unit, up and joints."
        raise FileProblem(path, f"has the unknown key {sorted(unknown)[0]!r}", remedy)
    unit, up, centres = described.get("unit", "m"), described.get("up", "z"), described.get("joints")
    if unit not in METRES or up not in _WORLD_FROM_UP:
        remedy = 'The unit should be "m", "cm" or "mm", and up "z" or "y".'
        raise FileProblem(path, f"has unit = {unit!r} and up = {up!r}", remedy)
    if not isinstance(centres, dict) or "mesh" not in described:
        raise FileProblem(path, "lacks `mesh` or `[joints]`", "Name the mesh, and give each joint as name = [x, y, z].")
    vertices, faces = read_mesh(path.parent / str(described["mesh"]))
    change = METRES[unit] * _WORLD_FROM_UP[up]
    segment_of = {joint: segment for segment, joint in JOINT_OF_SEGMENT.items()}
    placed = {}
    for name, centre in centres.items():
        segment = segment_of.get(name, name)
        if segment not in PARENTS or np.shape(centre) != (3,):
            remedy = f"The known joints are {', '.join(_joints())}; each should have 3 numbers."
            raise FileProblem(path, f"has the joint {name!r} = {centre}", remedy)
        placed[segment] = change @ np.asarray(centre, float)
    names = {segment: JOINT_OF_SEGMENT.get(segment, segment) for segment in placed}
    return Character(vertices=vertices @ change.T, faces=faces, joint_centres=placed, weights=None, node_names=names)


def _joints() -> list[str]:
    """Return the names of the joints that the TOML may give."""
    return [JOINT_OF_SEGMENT.get(segment, segment) for segment in PARENTS]


def read_mesh(path: Path | str) -> tuple[Floats, Integers]:
    """Read a triangle mesh (OBJ, PLY, STL, GLB and others) and merge equal vertices.

    Args:
        path: The file.

    Returns:
        Vertices (V, 3) in the unit and axes of the file, faces (T, 3).

    Raises:
        FileProblem: The file cannot be read or has no faces.
    """
    import trimesh

    try:
        mesh: Any = trimesh.load(path, force="mesh")
        mesh.merge_vertices(merge_tex=True, merge_norm=True)
    except Exception as error:  # the readers of trimesh raise many kinds of errors
        raise FileProblem(path, f"cannot be read as a mesh ({error})", "Give an OBJ, PLY, STL or GLB.") from error
    if not len(mesh.faces):
        raise FileProblem(path, "has no faces", "Give a triangle mesh.")
    return np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)


def read_skinned(path: Path | str) -> Character:
    """Read a skinned GLB in the pose that the file shows, rotated so that Z is up.

    The skin of a node that is not a segment (a finger, a twist bone) is assigned to the nearest segment above it.

    Args:
        path: The file.

    Returns:
        The character at rest.

    Raises:
        FileProblem: The file is not a GLB, has no skin, or no joint with a known name.
    """
    gltf = Gltf(path)
    skinned = gltf.skinned()
    try:
        return _character(gltf, skinned)
    except (KeyError, IndexError, ValueError, TypeError, AttributeError) as error:
        wrong = f"is damaged or uses an unsupported feature of glTF ({error!r})"
        raise FileProblem(path, wrong, "Export the character again.") from error


def _character(gltf: Gltf, skinned: list[tuple[int, int]]) -> Character:
    """Read the skinned meshes of a file."""
    world, named = gltf.world_from_nodes(), named_joints(gltf, {})
    owner = _owners(gltf, skinned, named)
    vertices, faces, weights, start = [], [], [], 0
    for mesh, skin in skinned:
        for primitive in gltf.document["meshes"][mesh]["primitives"]:
            points, shares = _posed(gltf, primitive, gltf.document["skins"][skin], world)
            vertices.append(points)
            weights.append(shares)
            count = len(points)
            index = gltf.array(primitive["indices"]).ravel() if "indices" in primitive else np.arange(count)
            if count == 0 or index.min() < 0 or index.max() >= count:
                raise IndexError("a triangle has a vertex that does not exist")
            faces.append(index.reshape(-1, 3) + start)
            start += count
    return _assemble(
        np.concatenate(vertices), np.concatenate(faces), np.concatenate(weights), owner, named, gltf, world
    )


def skin_joints(gltf: Gltf, skinned: list[tuple[int, int]]) -> list[int]:
    """Return the nodes to which skin is bound, and all nodes above them."""
    joints = {node for _, skin in skinned for node in gltf.document["skins"][skin]["joints"]}
    parents = gltf.parents()
    return sorted({above for node in joints for above in path_up(node, parents)})


def vrm_joints(gltf: Gltf) -> dict[str, int]:
    """Return the nodes that a VRM file, version 1 or 0, declares to be segments; empty for other files."""
    extensions = gltf.document.get("extensions", {})
    bones = extensions.get("VRMC_vrm", {}).get("humanoid", {}).get("humanBones", {})
    declared = {name: bone.get("node") for name, bone in bones.items()} if isinstance(bones, dict) else {}
    older = extensions.get("VRM", {}).get("humanoid", {}).get("humanBones", [])
    declared |= {bone.get("bone"): bone.get("node") for bone in older if isinstance(bone, dict)}
    return {VRM_BONES[name]: node for name, node in declared.items() if name in VRM_BONES and isinstance(node, int)}


def named_joints(gltf: Gltf, known: Mapping[str, int]) -> dict[str, int]:
    """Return the node of each segment; see `name_joints`. Declarations in a VRM file take precedence over names."""
    nodes = skin_joints(gltf, gltf.skinned())
    names = {node: gltf.name(node) for node in nodes}
    return name_joints(names, gltf.parents(), vrm_joints(gltf) | dict(known))


def _owners(gltf: Gltf, skinned: list[tuple[int, int]], named: dict[str, int]) -> dict[int, str]:
    """Return the segment of each joint node: its own, or that of the nearest node above that has one."""
    joints = {node for _, skin in skinned for node in gltf.document["skins"][skin]["joints"]}
    if not named:
        names = listed(sorted(gltf.name(n) for n in joints), most=_LISTED)
        remedy = f"Name the joints {', '.join(PARENTS)}."
        raise FileProblem(gltf.path, f"has no joint with a known name (it has {names})", remedy)
    segments = {node: segment for segment, node in named.items()}
    parents, top = gltf.parents(), next(iter(named))
    above = {node: next((n for n in path_up(node, parents) if n in segments), None) for node in joints}
    return {node: segments[n] if n is not None else top for node, n in above.items()}


def posed_skin(gltf: Gltf) -> list[tuple[Floats, Floats]]:
    """Return, for each skinned primitive, its vertices (V, 3) in the scene and their weights by node (V, n).

    Raises:
        FileProblem: The file uses compressed or sparse arrays.
    """
    world = gltf.world_from_nodes()
    return [
        _posed(gltf, primitive, gltf.document["skins"][skin], world)
        for mesh, skin in gltf.skinned()
        for primitive in gltf.document["meshes"][mesh]["primitives"]
    ]


def _posed(gltf: Gltf, primitive: dict[str, Any], skin: dict[str, Any], world: Floats) -> tuple[Floats, Floats]:
    """Return the posed vertices of a primitive (V, 3) in the scene, and their weights by node (V, n)."""
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
    vertices: Floats,
    faces: Integers,
    shares: Floats,
    owner: dict[int, str],
    named: dict[str, int],
    gltf: Gltf,
    world: Floats,
) -> Character:
    """Combine the nodes of each segment and rotate the character so that Z is up."""
    back = np.asarray(GLTF_FROM_WORLD).T
    return Character(
        vertices=change_point_axes(back, vertices),
        faces=faces,
        joint_centres={s: change_point_axes(back, world[n, :3, 3]) for s, n in named.items()},
        weights={s: shares[:, [n for n, o in owner.items() if o == s]].sum(1) for s in named},
        node_names={s: gltf.name(n) for s, n in named.items()},
    )
