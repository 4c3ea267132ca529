"""Retargeting: transfer of a motion to a character's joint hierarchy with other names, sizes and axes."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise

import numpy as np

from marey.arrays import Floats, Integers, freeze_fields
from marey.body.articulation.skeleton import PARENTS
from marey.errors import MareyError
from marey.geometry import rotations
from marey.motion.anatomical import NEXT_DISTAL
from marey.motion.motion import BodyMotion
from marey.motion.planted_feet import LegJoints, leg_rotations, planted_feet, standing
from marey.motion.twist import reduce_twist

REQUIRED_SEGMENTS = (
    "pelvis",
    *(
        f"{side}_{limb}"
        for side in ("left", "right")
        for limb in ("thigh", "shank", "foot", "upperarm", "forearm", "hand")
    ),
)
"""Segments that a character must have."""
_TRUNK = ("pelvis", "abdomen", "thorax", "neck", "head")
"""Segments of the trunk from the pelvis to the head."""
_LEGS = (("thigh", "shank"), ("shank", "foot"))
"""Pairs of neighbouring segments of a leg."""
_SIDES = ("left", "right")
"""Names of the two sides."""
_UPRIGHT = np.cos(np.radians(35.0))
"""Cosine of the largest angle between the spine and the vertical axis at rest. Chosen by hand."""
_GROUND_QUANTILE = 0.02
"""Quantile of the foot's height that counts as the ground. Chosen by hand."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CharacterRig:
    """The n nodes of a character at rest, and the assignment of our segments to them."""

    parents: Integers
    """(n,) index of each node's parent; -1 for roots."""
    translation: Floats
    """(n, 3) translation relative to the parent [the scene's unit]."""
    rotation: Floats
    """(n, 3, 3) rotation relative to the parent."""
    scale: Floats
    """(n, 3) scale factors."""
    nodes: Mapping[str, int]
    """Maps each segment to its node."""
    scene_from_world: Floats
    """(3, 3) rotation from the motion's world to the scene."""
    skin: Floats | None = None
    """(V, 3) vertices at rest in the scene; None if unknown."""
    guessed: tuple[str, ...] = ()
    """Segments whose joints were inferred from their positions rather than their names."""
    twists: Mapping[int, tuple[str, float]] = field(default_factory=dict)
    """Maps each twist node of a limb to the segment, and to the node's share of the segment's twist."""

    def __post_init__(self) -> None:
        freeze_fields(self, "parents", dtype=np.int64)
        freeze_fields(self, "translation", "rotation", "scale", "scene_from_world")

    @cached_property
    def order(self) -> list[int]:
        """The nodes, parents before children."""
        depth = [len(self.ancestors(n)) for n in range(len(self.parents))]
        return [int(n) for n in np.argsort(depth, kind="stable")]

    def ancestors(self, node: int) -> list[int]:
        """List the ancestors of a node, the nearest first."""
        path: list[int] = []
        while self.parents[node] >= 0:
            node = int(self.parents[node])
            path.append(node)
        return path

    @cached_property
    def at_rest(self) -> "PosedRig":
        """All nodes in the scene, at rest."""
        return pose_rig(self, 1, {}, None)


@dataclass(frozen=True, eq=False, kw_only=True)
class PosedRig:
    """The poses of all nodes in the scene in F frames."""

    linear: Floats
    """(F, n, 3, 3) rotation and scale in the scene."""
    position: Floats
    """(F, n, 3) position in the scene [scene's unit]."""
    local: dict[int, Floats]
    """Maps each rotated node to its rotation (F, 3, 3) relative to its parent."""
    shift: Floats
    """(F, 3) translation of the moved node relative to its parent; zero if none was moved."""

    def middle(self, nodes: list[int]) -> Floats:
        """Return the mean position (F, 3) of nodes in the scene."""
        return np.asarray(self.position[:, nodes].mean(1))


@dataclass(frozen=True, eq=False, kw_only=True)
class RigMotion:
    """Animation of a rig: rotations of nodes relative to their parents, and the position of one node, in K frames."""

    time: Floats
    """(K,) times of the keys [s]."""
    rotation: dict[int, Floats]
    """Maps each node to unit quaternions (K, 4) as w, x, y, z, without changes of sign."""
    root: int
    """The translated node."""
    translation: Floats
    """(K, 3) position of the root relative to its parent [scene's unit]."""
    gaps: tuple[tuple[float, float], ...]
    """Times of the last key before and the first key after each gap of the motion [s]."""
    slides: tuple[float, float] | None = None
    """RMS sliding of planted feet without and with correction [scene's unit]; None without planted feet."""


def pose_rig(rig: CharacterRig, frames: int, turns: Mapping[int, Floats], moved: tuple[int, Floats] | None) -> PosedRig:
    """Pose a rig with given rotations of some nodes in the scene; all others keep their rest pose in their parents.

    Below nodes with anisotropic scale no rotation is exact; the nearest one is used.

    Args:
        rig: Rig with n nodes.
        frames: Number F of frames.
        turns: Maps nodes to their rotations (F, 3, 3) in the scene relative to the rest pose.
        moved: A node and its position (F, 3) in the scene; its parent must not be translated.

    Returns:
        The poses of all nodes.
    """
    count = len(rig.parents)
    linear, position = np.zeros((frames, count, 3, 3)), np.zeros((frames, count, 3))
    local: dict[int, Floats] = {}
    shift: Floats = np.zeros((frames, 3))
    for n in rig.order:
        up = rig.parents[n]
        base = linear[:, up] if up >= 0 else np.broadcast_to(np.eye(3), (frames, 3, 3))
        start = position[:, up] if up >= 0 else np.zeros((frames, 3))
        own: Floats = np.broadcast_to(rig.rotation[n], (frames, 3, 3))
        if n in turns:
            wanted = turns[n] @ rig.at_rest.linear[0, n] / rig.scale[n]
            own = local[n] = rotations.nearest(np.linalg.solve(base, wanted))
        step = np.broadcast_to(rig.translation[n], (frames, 3))
        if moved is not None and n == moved[0]:
            step = shift = np.linalg.solve(base, (moved[1] - start)[..., None])[..., 0]
        linear[:, n] = base @ (own * rig.scale[n])
        position[:, n] = start + np.einsum("fab,fb->fa", base, step)
    return PosedRig(linear=linear, position=position, local=local, shift=shift)


def rest_joints(motion: BodyMotion) -> Floats:
    """Return the joint centres (S, 3) of a motion's body in the rest posture, relative to the pelvis [m].

    They are fixed in the parent segment; the median over all frames with poses is used.

    Raises:
        MareyError: No frame has poses, or a parent segment is missing.
    """
    names, known = motion.segment_names, np.flatnonzero(motion.answered)
    if not len(known):
        raise MareyError("The motion has no frame with poses.")
    joints = np.zeros((len(names), 3))
    for k, name in enumerate(names):
        parent = PARENTS.get(name)
        if parent is None:
            continue
        if parent not in names[:k]:
            raise MareyError(f"The motion has the segment {name} without {parent} before it.")
        up = names.index(parent)
        away = motion.segment_origin[known, k] - motion.segment_origin[known, up]
        joints[k] = joints[up] + np.median(np.einsum("fba,fb->fa", motion.segment_rotation[known, up], away), axis=0)
    return joints


@dataclass(frozen=True, eq=False)
class _RestAlignment:
    """Alignment of a rig at rest with the motion's body at rest."""

    rig: CharacterRig
    motion: BodyMotion
    floor: float | None
    """Height of the body's lowest vertex relative to its pelvis at rest [m], negative."""

    @cached_property
    def own(self) -> dict[str, Floats]:
        """The body's joint centre of each segment at rest, relative to the pelvis [m]."""
        return dict(zip(self.motion.segment_names, rest_joints(self.motion), strict=True))

    @cached_property
    def world_from_scene(self) -> Floats:
        """The rotation (3, 3) that makes the character upright and face -Y, as the body does at rest."""
        place = {s: self.rig.at_rest.position[0, n] for s, n in self.rig.nodes.items()}
        pairs = [(place[f"left_{limb}"], place[f"right_{limb}"]) for limb in ("thigh", "upperarm")]
        left = np.sum([a - b for a, b in pairs], axis=0)
        spine = np.mean([a + b for a, b in pairs[1:]], axis=0) - np.mean([a + b for a, b in pairs[:1]], axis=0)
        axes = np.concatenate([np.eye(3), -np.eye(3)])[[1, 2, 0, 4, 5, 3]]
        up = axes[np.argmax(axes @ spine)]
        if not up @ spine > _UPRIGHT * np.linalg.norm(spine):
            raise MareyError("the character does not stand upright in its rest posture")
        left = left - (left @ up) * up
        if np.linalg.norm(left) < 1e-6 * np.linalg.norm(spine):
            raise MareyError("its left and right joints have the same position")
        left = left / np.linalg.norm(left)
        return np.stack([left, np.cross(up, left), up])

    @cached_property
    def their_floor(self) -> float | None:
        """Height of the character's lowest vertex in the body's axes [scene's unit]; None if unknown."""
        skin = self.rig.skin
        return None if skin is None or not len(skin) else float((skin @ self.world_from_scene[2]).min())

    @cached_property
    def theirs(self) -> dict[str, Floats]:
        """The character's joint centre of each segment at rest, in the body's axes [scene's unit]."""
        return {s: self.world_from_scene @ self.rig.at_rest.position[0, n] for s, n in self.rig.nodes.items()}

    @cached_property
    def size(self) -> float:
        """Ratio of the character's leg length to the body's [scene's unit / m]."""
        lengths = [
            sum(np.linalg.norm(at[f"{s}_{b}"] - at[f"{s}_{a}"]) for s in ("left", "right") for a, b in _LEGS)
            for at in (self.theirs, self.own)
        ]
        return float(lengths[0] / lengths[1])

    @cached_property
    def turns(self) -> dict[str, Floats]:
        """The rotation (3, 3) of each segment from the character's rest posture to the body's.

        The bones of arms and legs are aligned with the body's by the shortest rotation; hands follow the forearms. Feet
        stay flat and get the body's heading. Trunk, head and clavicles are unchanged.
        """
        found: dict[str, Floats] = {}
        for name, parent in PARENTS.items():
            if name not in self.rig.nodes:
                continue
            side, _, kind = name.rpartition("_")
            parent_turn = found.get(parent or "", np.eye(3))
            if not side or kind == "clavicle":
                found[name] = np.eye(3)
            elif kind in NEXT_DISTAL:
                end = f"{side}_{NEXT_DISTAL[kind]}"
                theirs, own = self.theirs[end] - self.theirs[name], self.own[end] - self.own[name]
                found[name] = rotations.shortest(parent_turn @ theirs, own) @ parent_turn
            elif kind == "foot":
                found[name] = self._heading(side)
            else:
                found[name] = parent_turn
        return found

    def _heading(self, side: str) -> Floats:
        """Return the rotation of a foot about the vertical that gives it the body's heading."""
        if f"{side}_toes" not in self.theirs or f"{side}_toes" not in self.own:
            return np.eye(3)
        flat = np.array([1.0, 1.0, 0.0])
        theirs, own = ((at[f"{side}_toes"] - at[f"{side}_foot"]) * flat for at in (self.theirs, self.own))
        shortest = min(np.linalg.norm(theirs), np.linalg.norm(own))
        return rotations.shortest(theirs, own) if shortest > 1e-9 else np.eye(3)

    def in_scene(self, turns: Floats, segment: str | None = None) -> Floats:
        """Convert a segment's rotations (F, 3, 3) in the world to its node's rotations (F, 3, 3) in the scene."""
        alignment = self.turns[segment] if segment is not None else np.eye(3)
        return self.rig.scene_from_world @ turns @ alignment @ self.world_from_scene


def retarget(
    motion: BodyMotion, rig: CharacterRig, *, floor: float | None = None, grounded: bool = True, planted: bool = False
) -> RigMotion:
    """Transfer a motion to a rig.

    Every joint that corresponds to one of our segments has the segment's rotation in the world, relative to a common
    rest posture: the bones of arms and legs have the body's directions, for any rest posture of the character.
    Joints of the spine and neck between two of ours share the rotation between them equally; twist joints of a limb
    take their share of its twist; all others keep their rest pose in their parents. The path of the hips is scaled by
    the ratio of leg lengths.

    Args:
        motion: Motion of the body. Frames without poses have no key.
        rig: Rig of the character.
        floor: Height of the body's lowest vertex relative to its pelvis at rest [m]; if unknown, the height of the
            character's ankles above its soles is assumed proportional to the body's.
        grounded: Whether the character is shifted vertically in each frame so that its lower foot has the body's height
            above the floor, scaled by leg length. This matters for other proportions of thighs and shanks, or of ankles
            and toes.
        planted: Whether feet that are planted in the motion are also planted on the character, by bending the legs.

    Returns:
        The animation of the rig.

    Raises:
        MareyError: A joint is missing or misplaced in the hierarchy, or the character is not upright at rest.
    """
    _check(rig)
    fit = _RestAlignment(rig, motion, floor)
    known = np.flatnonzero(motion.answered)
    turns = _turns(fit, known)
    hips = _hips(fit, known)
    posed = _place(fit, turns, hips)
    # Where the legs are not children of the pelvis, its rotation alone does not move the hips to their position.
    place = hips + (hips - posed.middle(_thighs(rig)))
    if grounded:
        place = place + _lift(fit, posed, hips, known)[:, None] * rig.scene_from_world[:, 2]
    posed = _place(fit, turns, place)
    stands = _stands(fit, known)
    slides = [_slide(fit, posed, stands)]
    if planted:
        turns = turns | _planted(fit, posed, turns, stands)
        posed = _place(fit, turns, place)
    slides.append(_slide(fit, posed, stands))
    root = rig.nodes["pelvis"]
    quaternions = {n: rotations.continuous(rotations.to_quaternion(local)) for n, local in posed.local.items()}
    gaps = tuple((float(motion.time[a - 1]), float(motion.time[b])) for a, b in motion.gaps())
    return RigMotion(
        time=motion.time[known], rotation=quaternions, root=root, translation=posed.shift, gaps=gaps,
        slides=None if slides[0] is None or slides[1] is None else (slides[0], slides[1]),
    )  # fmt: skip


def _check(rig: CharacterRig) -> None:
    """Check that a rig has the required joints in the hierarchy of a body."""
    missing = [name for name in REQUIRED_SEGMENTS if name not in rig.nodes]
    if missing:
        raise MareyError(f"no joint is known for {', '.join(missing)}")
    for name, node in rig.nodes.items():
        parent = PARENTS[name]
        while parent is not None and parent not in rig.nodes:
            parent = PARENTS[parent]
        if parent is not None and rig.nodes[parent] not in rig.ancestors(node):
            raise MareyError(f"the joint of {name} is not a descendant of that of {parent}")


def _turns(fit: _RestAlignment, known: Integers) -> dict[int, Floats]:
    """Return the rotations (K, 3, 3) in the scene of all rotated nodes."""
    motion, rig = fit.motion, fit.rig
    by_segment = {name: motion.segment(name)[known] for name in rig.nodes if name in motion.segment_names}
    turned = {rig.nodes[name]: fit.in_scene(turns, name) for name, turns in by_segment.items()}
    for node, (name, share) in rig.twists.items():
        parent = PARENTS[name]
        if name in by_segment and parent in motion.segment_names:
            side, _, kind = name.rpartition("_")
            axis = fit.own[f"{side}_{NEXT_DISTAL[kind]}"] - fit.own[name]
            turns = reduce_twist(motion.segment(str(parent))[known], by_segment[name], axis, share)
            turned[node] = fit.in_scene(turns, name)
    trunk = [name for name in _TRUNK if name in by_segment]
    for lower, upper in pairwise(trunk):
        path = rig.ancestors(rig.nodes[upper])
        between = path[: path.index(rig.nodes[lower])][::-1]
        first = by_segment[lower]
        vector = rotations.log(np.swapaxes(first, 1, 2) @ by_segment[upper])
        for k, node in enumerate(between):
            share = (k + 1) / (len(between) + 1)
            turned[node] = fit.in_scene(first @ rotations.exp(share * vector))
    return turned


def _feet(rig: CharacterRig, motion: BodyMotion) -> dict[str, str]:
    """Return each side's supporting joint: the toes, or the ankle if rig or motion has no toes."""
    toes = {side: f"{side}_toes" for side in _SIDES}
    return {s: t if t in rig.nodes and t in motion.segment_names else f"{s}_foot" for s, t in toes.items()}


def _stands(fit: _RestAlignment, known: Integers) -> dict[str, list[slice]]:
    """Find each side's stances of the body's foot, as ranges of the known frames."""
    motion, feet = fit.motion, _feet(fit.rig, fit.motion)
    paths = {side: motion.segment_origin[known, motion.segment_names.index(name)] for side, name in feet.items()}
    ground = min(float(np.quantile(path[:, 2], _GROUND_QUANTILE)) for path in paths.values())
    return {side: standing(motion.time[known], path, ground) for side, path in paths.items()}


def _slide(fit: _RestAlignment, posed: PosedRig, stands: Mapping[str, list[slice]]) -> float | None:
    """Return the RMS sliding of planted feet [scene's unit]; None without planted feet."""
    off = [
        place[rows] - np.median(place[rows], axis=0)
        for side, name in _feet(fit.rig, fit.motion).items()
        for place in [posed.position[:, fit.rig.nodes[name]]]
        for rows in stands[side]
    ]
    return float(np.sqrt(np.mean(np.sum(np.concatenate(off) ** 2, axis=1)))) if off else None


def _planted(
    fit: _RestAlignment, posed: PosedRig, turns: Mapping[int, Floats], stands: Mapping[str, list[slice]]
) -> dict[int, Floats]:
    """Return the rotations of the legs that keep planted feet in place on the rig."""
    rig = fit.rig
    changed: dict[int, Floats] = {}
    for side, name in _feet(rig, fit.motion).items():
        shift = planted_feet(posed.position[:, rig.nodes[name]], stands[side])
        thigh, shank, foot = (rig.nodes[f"{side}_{part}"] for part in ("thigh", "shank", "foot"))
        hinge = turns[thigh] @ rig.scene_from_world[:, 0]
        leg = LegJoints(posed.position[:, thigh], posed.position[:, shank], posed.position[:, foot], hinge)
        for part, turn in zip(("thigh", "shank"), leg_rotations(leg, shift), strict=True):
            own = f"{side}_{part}"
            nodes = [rig.nodes[own], *(node for node, (segment, _) in rig.twists.items() if segment == own)]
            changed |= {node: turn @ turns[node] for node in nodes}
    return changed


def _hips(fit: _RestAlignment, known: Integers) -> Floats:
    """Return the path (K, 3) of the midpoint between the hips in the scene."""
    motion, size = fit.motion, fit.size
    middle = np.mean([motion.segment_origin[known, motion.segment_names.index(f"{s}_thigh")] for s in _SIDES], axis=0)
    ankles = _ankle_heights(fit)
    higher = ankles[0] - size * ankles[1] if ankles else 0.0
    return np.asarray((size * middle + np.array([0.0, 0.0, higher])) @ fit.rig.scene_from_world.T)


def _ankle_heights(fit: _RestAlignment) -> tuple[float, float] | None:
    """Return the heights of the ankles above the soles at rest, of character and body; None if one is unknown."""
    if fit.floor is None or fit.their_floor is None:
        return None
    theirs, own = (np.mean([at[f"{side}_foot"][2] for side in _SIDES]) for at in (fit.theirs, fit.own))
    return float(theirs - fit.their_floor), float(own - fit.floor)


def _thighs(rig: CharacterRig) -> list[int]:
    return [rig.nodes[f"{side}_thigh"] for side in _SIDES]


def _place(fit: _RestAlignment, turns: dict[int, Floats], hips: Floats) -> PosedRig:
    """Pose the rig so that the midpoint between its hips would be at positions (K, 3)."""
    rig, root = fit.rig, fit.rig.nodes["pelvis"]
    away = rig.at_rest.middle(_thighs(rig))[0] - rig.at_rest.position[0, root]
    return pose_rig(rig, len(hips), turns, (root, hips - turns[root] @ away))


def _lift(fit: _RestAlignment, posed: PosedRig, hips: Floats, known: Integers) -> Floats:
    """Return the vertical shift (K,) with which the character's lower foot has the height of the body's.

    Args:
        fit: The rig and the body.
        posed: The rig with all its rotations, at an arbitrary position.
        hips: (K, 3) wanted midpoint between the hips in the scene.
        known: (K,) indices of the frames with poses.
    """
    motion, rig, size = fit.motion, fit.rig, fit.size
    names, up = motion.segment_names, rig.scene_from_world[:, 2]
    heights = _ankle_heights(fit)
    own, theirs = (np.mean([at[f"{side}_foot"][2] for side in _SIDES]) for at in (fit.own, fit.theirs))
    both = size * own - theirs + (heights[0] - size * heights[1] if heights else 0.0)
    feet = [f"{side}_{part}" for side in _SIDES for part in ("foot", "toes")]
    feet = [name for name in feet if name in rig.nodes and name in names]
    thighs = posed.middle(_thighs(rig))
    # Height of each joint relative to rest, of the character and of the scaled body.
    is_now = [(posed.position[:, rig.nodes[n]] - thighs + hips) @ up - fit.theirs[n][2] for n in feet]
    shall = [size * (motion.segment_origin[known, names.index(n), 2] - fit.own[n][2]) + both for n in feet]
    return np.asarray(np.min(shall, axis=0) - np.min(is_now, axis=0))
