"""Reading the rig of a character from a glTF file, and writing a motion into a copy of the file."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from marey.arrays import Floats
from marey.body.articulation.skeleton import JOINT_OF_SEGMENT, PARENTS
from marey.errors import FileProblem, MareyError
from marey.geometry import rotations
from marey.io.axes import GLTF_FROM_WORLD
from marey.io.documents import read_tables
from marey.io.gltf.character import named_joints, posed_skin, skin_joints
from marey.io.gltf.gltf import Gltf, GltfAdditions, local_matrix
from marey.io.gltf.rig_shape import find_joints_by_position
from marey.io.gltf.rig_twists import find_twists
from marey.motion.motion import BodyMotion
from marey.motion.retarget import REQUIRED_SEGMENTS, CharacterRig, RigMotion, retarget
from marey.wording import listed

_ANIMATION = "marey"
"""Name of the animation in the copy."""
_LISTED = 40
"""Largest number of joints that an error message lists; chosen by hand."""


def read_map(path: Path | str) -> dict[str, str]:
    """Read the joint of each segment from a TOML with `[joints]` and lines `segment = "name in the character"`.

    A segment may also be given by the name of its joint: `left_knee` means `left_shank`.

    Args:
        path: The file.

    Returns:
        The name of the joint by segment.

    Raises:
        FileProblem: The file cannot be read, or names an unknown segment.
    """
    remedy = 'Give a TOML with [joints] and lines such as left_thigh = "name in the character".'
    described = read_tables(path, remedy)
    joints = described.get("joints")
    if not isinstance(joints, dict) or set(described) != {"joints"}:
        remedy = 'Give only [joints], with lines such as left_thigh = "name in the character".'
        raise FileProblem(path, "does not contain exactly one table [joints]", remedy)
    segment_of = {joint: segment for segment, joint in JOINT_OF_SEGMENT.items()} | {name: name for name in PARENTS}
    unknown = [key for key in joints if key not in segment_of]
    if unknown:
        remedy = f"The known segments are {', '.join(PARENTS)}."
        raise FileProblem(path, f"names the unknown segment {unknown[0]!r}", remedy)
    return {segment_of[key]: str(name) for key, name in joints.items()}


def read_rig(path: Path | str, named: Mapping[str, str] | None = None) -> tuple[Gltf, CharacterRig]:
    """Read the skeleton of a character; the pose in the file is its rest posture.

    Args:
        path: A GLB or glTF with a skinned mesh.
        named: Maps a segment to the name of its joint in the file, for joints with unknown names.

    Returns:
        The file, and the skeleton.

    Raises:
        FileProblem: The file is not such a file, or required joints were found neither by name nor by position.
    """
    gltf = Gltf(path)
    try:
        known = _known(gltf, named or {})
        by_name = named_joints(gltf, known)
        complete = all(segment in by_name for segment in REQUIRED_SEGMENTS)
        found = by_name if complete else _with_guessed_joints(gltf, known, by_name)
        missing = [segment for segment in REQUIRED_SEGMENTS if segment not in found]
        if missing:
            raise FileProblem(path, _describe_missing(gltf, found, missing), _HOW_TO_NAME)
        return gltf, _rig(gltf, found, tuple(segment for segment in found if segment not in by_name))
    except (KeyError, IndexError, ValueError, TypeError, AttributeError) as error:
        raise FileProblem(path, f"is damaged ({error!r})", "Export the character again.") from error


def _with_guessed_joints(gltf: Gltf, known: Mapping[str, int], by_name: dict[str, int]) -> dict[str, int]:
    """Add joints found by position, if the guess agrees with all required joints that were found by name."""
    world = gltf.world_from_nodes()
    joints = sorted({node for _, skin in gltf.skinned() for node in gltf.document["skins"][skin]["joints"]})
    guess = find_joints_by_position({node: world[node, :3, 3] for node in joints}, gltf.parents(), by_name)
    if not guess or any(
        guess.get(segment, node) != node for segment, node in by_name.items() if segment in REQUIRED_SEGMENTS
    ):
        return by_name
    taken = set(by_name.values())
    return named_joints(gltf, dict(known) | by_name | {s: n for s, n in guess.items() if n not in taken})


def _rig(gltf: Gltf, found: Mapping[str, int], guessed: tuple[str, ...]) -> CharacterRig:
    """Return the skeleton of a file with the nodes of the segments."""
    parents, count = gltf.parents(), len(gltf.nodes)
    parts = [_decompose(gltf, node) for node in range(count)]
    skin = _skin_at_rest(gltf)
    names = {node: gltf.name(node) for node in skin_joints(gltf, gltf.skinned())}
    return CharacterRig(
        parents=np.array([parents.get(node, -1) for node in range(count)]),
        translation=np.array([t for t, _, _ in parts]),
        rotation=np.array([r for _, r, _ in parts]),
        scale=np.array([s for _, _, s in parts]),
        nodes=found,
        scene_from_world=np.asarray(GLTF_FROM_WORLD),
        skin=None if skin is None else np.concatenate([points for points, _ in skin]),
        guessed=guessed,
        twists=find_twists(found, names, parents, gltf.world_from_nodes()[:, :3, 3], skin),
    )


_HOW_TO_NAME = (
    'Name the joints in a TOML file (--map) with [joints] and lines such as left_thigh = "name in the character".'
)
"""Remedy for joints that were not found."""


def _known(gltf: Gltf, named: Mapping[str, str]) -> dict[str, int]:
    """Return the nodes whose names were given for segments."""
    known = {}
    for segment, name in named.items():
        fitting = [node for node in range(len(gltf.nodes)) if gltf.name(node) == name]
        if len(fitting) != 1:
            wrong = f"has {len(fitting) or 'no'} joint{'s' if fitting else ''} named {name!r}, given for {segment}"
            raise FileProblem(gltf.path, wrong, f"It has {_node_names(gltf, skin_joints(gltf, gltf.skinned()))}.")
        known[segment] = fitting[0]
    return known


def _describe_missing(gltf: Gltf, found: Mapping[str, int], missing: list[str]) -> str:
    """Describe which joints are missing, which were found, and which remain."""
    known = ", ".join(f"{segment} = {gltf.name(node)}" for segment, node in found.items()) or "none"
    taken = set(found.values())
    left = [node for node in skin_joints(gltf, gltf.skinned()) if node not in taken]
    return (
        f"has no joint that is recognised by name or position as {', '.join(missing)}; recognised joints: {known}; "
        f"other joints: {_node_names(gltf, left)}"
    )


def _node_names(gltf: Gltf, nodes: list[int]) -> str:
    """Join the names of nodes for a message."""
    return listed((gltf.name(node) for node in nodes), most=_LISTED)


def _decompose(gltf: Gltf, node: int) -> tuple[Floats, Floats, Floats]:
    """Decompose the matrix of a node into translation (3,), rotation (3, 3) and scale (3,)."""
    matrix = local_matrix(gltf.nodes[node])
    scale = np.linalg.norm(matrix[:3, :3], axis=0)
    if not (scale > 0).all():
        wrong = f"has the node {gltf.name(node)!r} with a scale of zero"
        raise FileProblem(gltf.path, wrong, "Give it a scale greater than zero.")
    if "matrix" not in gltf.nodes[node]:
        scale = np.asarray(gltf.nodes[node].get("scale", (1, 1, 1)), float)
    elif np.linalg.det(matrix[:3, :3]) < 0:
        scale = scale * [-1, 1, 1]
    return matrix[:3, 3], rotations.nearest(matrix[:3, :3] / scale), scale


def _skin_at_rest(gltf: Gltf) -> list[tuple[Floats, Floats]] | None:
    """Return the skin and its weights in the scene, or None if they are stored in an unsupported way."""
    try:
        return posed_skin(gltf)
    except (FileProblem, KeyError, IndexError, ValueError, TypeError):
        return None


def retargeted(
    gltf: Gltf, rig: CharacterRig, motion: BodyMotion, *, floor: float | None, grounded: bool = True,
    planted: bool = False,
) -> RigMotion:  # fmt: skip
    """Transfer a motion to the skeleton of a character's file.

    Args:
        gltf: The character.
        rig: Skeleton of the character.
        motion: The motion.
        floor: Height of the lowest vertex relative to the pelvis at rest [m]; see `marey.motion.retarget.retarget`.
        grounded: See `marey.motion.retarget.retarget`.
        planted: See `marey.motion.retarget.retarget`.

    Returns:
        The motion of the character's nodes.

    Raises:
        FileProblem: The motion cannot be transferred to this skeleton.
    """
    try:
        return retarget(motion, rig, floor=floor, grounded=grounded, planted=planted)
    except MareyError as error:
        wrong = f"cannot be animated with this motion ({str(error).rstrip('.')})"
        raise FileProblem(gltf.path, wrong, _HOW_TO_NAME) from error


def write_rig_motion(path: Path | str, gltf: Gltf, rig: CharacterRig, moved: RigMotion) -> None:
    """Write a copy of a character's file with an additional animation; nothing else changes.

    Frames without a pose have no key, so that a viewer interpolates. The `extras` of the animation contain `gaps`, the
    pairs of times [s] between which nothing was measured.

    Args:
        path: The copy, GLB or glTF as the original.
        gltf: The character.
        rig: Skeleton of the character.
        moved: The motion of its nodes.
    """
    additions = GltfAdditions(gltf)
    time = additions.add(moved.time[:, None], "SCALAR", bounds=True)
    samplers: list[dict[str, Any]] = []
    channels: list[dict[str, Any]] = []

    def track(node: int, what: str, values: Floats, shape: str) -> None:
        channels.append({"sampler": len(samplers), "target": {"node": node, "path": what}})
        samplers.append({"input": time, "output": additions.add(values, shape), "interpolation": "LINEAR"})

    track(moved.root, "translation", moved.translation, "VEC3")
    for node, quaternions in moved.rotation.items():
        track(node, "rotation", quaternions[:, [1, 2, 3, 0]], "VEC4")
    for node in {moved.root, *moved.rotation}:
        _without_matrix(additions.document["nodes"][node], rig, node)
    animation: dict[str, Any] = {"name": _ANIMATION, "samplers": samplers, "channels": channels}
    if moved.gaps:
        animation["extras"] = {"gaps": [list(gap) for gap in moved.gaps]}
    additions.document.setdefault("animations", []).append(animation)
    additions.write(path)


def is_animated_copy(path: Path) -> bool:
    """Return whether a file is a glTF into which `write_rig_motion` has written a motion.

    Args:
        path: The file.
    """
    try:
        animations = Gltf(path).document.get("animations")
    except MareyError:
        return False
    each = animations if isinstance(animations, list) else []
    return any(isinstance(animation, dict) and animation.get("name") == _ANIMATION for animation in each)


def _without_matrix(node: dict[str, Any], rig: CharacterRig, number: int) -> None:
    """Replace the matrix of a node by translation, rotation and scale, because only these can be animated."""
    if node.pop("matrix", None) is not None:
        w, x, y, z = rotations.to_quaternion(rig.rotation[number]).tolist()
        node |= {"translation": rig.translation[number].tolist(), "rotation": [x, y, z, w]}
        node |= {"scale": rig.scale[number].tolist()}
