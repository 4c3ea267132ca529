"""Rigs: the skeleton of a character in a glTF file, and a motion written into a copy of the file."""

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from marey.arrays import Floats
from marey.body.articulation.skeleton import JOINT_OF_SEGMENT, PARENTS
from marey.errors import FileProblem, MareyError
from marey.geometry import rotations
from marey.io.axes import GLTF_FROM_WORLD
from marey.io.gltf.character import named_joints, posed_skin, skin_joints
from marey.io.gltf.gltf import Additions, Gltf, local_matrix
from marey.io.gltf.rig_shape import place_joints
from marey.io.gltf.rig_twists import find_twists
from marey.motion.motion import BodyMotion
from marey.motion.retarget import REQUIRED_SEGMENTS, CharacterRig, RigMotion, retarget

_LISTED = 40


def read_map(path: Path | str) -> dict[str, str]:
    """Read which joint each segment is: a TOML with `[joints]` and `segment = "name in the file"`.

    A segment may also be called by its joint: `left_knee` is `left_shank`.

    Args:
        path: The file.

    Raises:
        FileProblem: It cannot be read, or names no segment.
    """
    try:
        described = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise FileProblem(
            path, f"cannot be read ({error})", 'Give a TOML with [joints] and segment = "name".'
        ) from error
    joints = described.get("joints")
    if not isinstance(joints, dict) or set(described) != {"joints"}:
        raise FileProblem(path, "does not hold [joints] and nothing else", 'Give [joints] and segment = "name".')
    segment_of = {joint: segment for segment, joint in JOINT_OF_SEGMENT.items()} | {name: name for name in PARENTS}
    unknown = [key for key in joints if key not in segment_of]
    if unknown:
        raise FileProblem(path, f"names the unknown segment {unknown[0]!r}", f"Known are {', '.join(PARENTS)}.")
    return {segment_of[key]: str(name) for key, name in joints.items()}


def read_rig(path: Path | str, named: Mapping[str, str] | None = None) -> tuple[Gltf, CharacterRig]:
    """Read a character's skeleton, as the file poses it: that is its rest posture.

    Args:
        path: A GLB or glTF with a skinned mesh.
        named: By segment: what the file calls its joint, where the name does not tell.

    Raises:
        FileProblem: It is no such file, or joints are missing that neither names nor places tell.
    """
    gltf = Gltf(path)
    try:
        known = _known(gltf, named or {})
        by_name = named_joints(gltf, known)
        found = by_name if all(segment in by_name for segment in REQUIRED_SEGMENTS) else _guessed(gltf, known, by_name)
        missing = [segment for segment in REQUIRED_SEGMENTS if segment not in found]
        if missing:
            raise FileProblem(path, _what_is_missing(gltf, found, missing), _HOW_TO_NAME)
        return gltf, _rig(gltf, found, tuple(segment for segment in found if segment not in by_name))
    except (KeyError, IndexError, ValueError, TypeError, AttributeError) as error:
        raise FileProblem(path, f"is damaged ({error!r})", "Export it again.") from error


def _guessed(gltf: Gltf, known: Mapping[str, int], by_name: dict[str, int]) -> dict[str, int]:
    """Add the joints that their places tell, where those agree with all that have telling names."""
    world = gltf.world_from_nodes()
    joints = sorted({node for _, skin in gltf.skinned() for node in gltf.document["skins"][skin]["joints"]})
    guess = place_joints({node: world[node, :3, 3] for node in joints}, gltf.parents(), by_name)
    if not guess or any(
        guess.get(segment, node) != node for segment, node in by_name.items() if segment in REQUIRED_SEGMENTS
    ):
        return by_name
    taken = set(by_name.values())
    return named_joints(gltf, dict(known) | by_name | {s: n for s, n in guess.items() if n not in taken})


def _rig(gltf: Gltf, found: Mapping[str, int], guessed: tuple[str, ...]) -> CharacterRig:
    parents, count = gltf.parents(), len(gltf.nodes)
    parts = [_parted(gltf, node) for node in range(count)]
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


_HOW_TO_NAME = 'Give --map FILE.toml with [joints] and lines such as left_thigh = "name in the character".'


def _known(gltf: Gltf, named: Mapping[str, str]) -> dict[str, int]:
    """Find the nodes that are named for segments."""
    known = {}
    for segment, name in named.items():
        fitting = [node for node in range(len(gltf.nodes)) if gltf.name(node) == name]
        if len(fitting) != 1:
            wrong = f"has {len(fitting) or 'no'} joint{'s' if fitting else ''} named {name!r}, given for {segment}"
            raise FileProblem(gltf.path, wrong, f"It has {_listed(gltf, skin_joints(gltf, gltf.skinned()))}.")
        known[segment] = fitting[0]
    return known


def _what_is_missing(gltf: Gltf, found: Mapping[str, int], missing: list[str]) -> str:
    known = ", ".join(f"{segment} = {gltf.name(node)}" for segment, node in found.items()) or "none"
    taken = set(found.values())
    left = [node for node in skin_joints(gltf, gltf.skinned()) if node not in taken]
    return (
        f"has no joint whose name or place tells that it is {', '.join(missing)}; known are {known}; "
        f"left are {_listed(gltf, left)}"
    )


def _listed(gltf: Gltf, nodes: list[int]) -> str:
    names = [gltf.name(node) for node in nodes]
    return ", ".join(names[:_LISTED]) + (f" and {len(names) - _LISTED} more" if len(names) > _LISTED else "")


def _parted(gltf: Gltf, node: int) -> tuple[Floats, Floats, Floats]:
    """Part a node's matrix into translation (3,), rotation (3, 3) and scale (3,)."""
    matrix = local_matrix(gltf.nodes[node])
    scale = np.linalg.norm(matrix[:3, :3], axis=0)
    if not (scale > 0).all():
        raise FileProblem(gltf.path, f"has the node {gltf.name(node)!r} of no size", "Scale it by more than 0.")
    if "matrix" not in gltf.nodes[node]:
        scale = np.asarray(gltf.nodes[node].get("scale", (1, 1, 1)), float)
    elif np.linalg.det(matrix[:3, :3]) < 0:
        scale = scale * [-1, 1, 1]
    return matrix[:3, 3], rotations.nearest(matrix[:3, :3] / scale), scale


def _skin_at_rest(gltf: Gltf) -> list[tuple[Floats, Floats]] | None:
    """Give the skin and its weights in the scene, or None where it is packed in a way that is not read here."""
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
        rig: Its skeleton.
        motion: The motion.
        floor: see `marey.motion.retarget.retarget`.
        grounded: see there.
        planted: see there.

    Returns:
        The motion of the character's nodes.

    Raises:
        FileProblem: The motion cannot be transferred to this skeleton.
    """
    try:
        return retarget(motion, rig, floor=floor, grounded=grounded, planted=planted)
    except MareyError as error:
        wrong = f"cannot take the motion ({str(error).rstrip('.')})"
        raise FileProblem(gltf.path, wrong, _HOW_TO_NAME) from error


def write_rig_motion(path: Path | str, gltf: Gltf, rig: CharacterRig, moved: RigMotion) -> None:
    """Write a copy of a character's file with a further animation; nothing else of it changes.

    Frames without an answer have no key: a viewer interpolates over them. Their times are in the animation's `extras`:
    `gaps`, pairs of the times [s] between which nothing was measured.

    Args:
        path: The copy; GLB or glTF as the character.
        gltf: The character.
        rig: Its skeleton.
        moved: The motion of its nodes.
    """
    additions = Additions(gltf)
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
    animation: dict[str, Any] = {"name": "marey", "samplers": samplers, "channels": channels}
    if moved.gaps:
        animation["extras"] = {"gaps": [list(gap) for gap in moved.gaps]}
    additions.document.setdefault("animations", []).append(animation)
    additions.write(path)


def _without_matrix(node: dict[str, Any], rig: CharacterRig, number: int) -> None:
    """Write a node's matrix as translation, rotation and scale: only these can be animated."""
    if node.pop("matrix", None) is not None:
        w, x, y, z = rotations.to_quaternion(rig.rotation[number]).tolist()
        node |= {"translation": rig.translation[number].tolist(), "rotation": [x, y, z, w]}
        node |= {"scale": rig.scale[number].tolist()}
