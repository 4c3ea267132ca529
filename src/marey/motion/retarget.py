"""Retargeting: a motion carried over to another character's tree of joints, whatever its names, sizes and axes."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise

import numpy as np

from marey.arrays import Floats, Integers, freeze_fields
from marey.body.articulation.skeleton import PARENTS
from marey.errors import MareyError
from marey.geometry import rotations
from marey.motion.motion import BodyMotion
from marey.motion.planted_feet import Leg, planted_feet, standing, turns_of_leg
from marey.motion.twist import untwisted

NEEDED = (
    "pelvis",
    *(
        f"{side}_{limb}"
        for side in ("left", "right")
        for limb in ("thigh", "shank", "foot", "upperarm", "forearm", "hand")
    ),
)
"""Segments without which a character cannot take up a motion."""
_TRUNK = ("pelvis", "abdomen", "thorax", "neck", "head")
_NEXT = {"thigh": "shank", "shank": "foot", "upperarm": "forearm", "forearm": "hand"}
_LEGS = (("thigh", "shank"), ("shank", "foot"))
_SIDES = ("left", "right")
_UPRIGHT = np.cos(np.radians(35.0))
_LOWEST = 0.02
"""Share of the frames in which a foot is lower than what counts as the ground."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CharacterRig:
    """A character's nodes at rest, n of them, and which of them are our segments."""

    parents: Integers
    """(n,) -1 for roots."""
    translation: Floats
    """(n, 3) in the parent [the scene's unit]."""
    rotation: Floats
    """(n, 3, 3) in the parent."""
    scale: Floats
    """(n, 3)."""
    nodes: Mapping[str, int]
    """By segment: its node."""
    scene_from_world: Floats
    """(3, 3) the scene's axes, in which the motion shall be seen."""
    skin: Floats | None = None
    """(V, 3) at rest in the scene; None where nobody knows."""
    guessed: tuple[str, ...] = ()
    """Segments whose joints were guessed by their places, not named."""
    twists: Mapping[int, tuple[str, float]] = field(default_factory=dict)
    """By node of a limb that several nodes turn about its axis: the segment, and the share of its twist."""

    def __post_init__(self) -> None:
        freeze_fields(self, "parents", dtype=np.int64)
        freeze_fields(self, "translation", "rotation", "scale", "scene_from_world")

    @cached_property
    def order(self) -> list[int]:
        """The nodes, parents before children."""
        depth = [len(self.above(n)) for n in range(len(self.parents))]
        return [int(n) for n in np.argsort(depth, kind="stable")]

    def above(self, node: int) -> list[int]:
        """List the nodes above one, the nearest first."""
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
    """Nodes in the scene in F frames."""

    linear: Floats
    """(F, n, 3, 3) rotation and scale."""
    position: Floats
    """(F, n, 3)."""
    local: dict[int, Floats]
    """By node that was turned: its rotation (F, 3, 3) in its parent."""
    shift: Floats
    """(F, 3) translation in its parent of the node that was moved, or of none."""

    def middle(self, nodes: list[int]) -> Floats:
        """Give the middle (F, 3) of nodes in the scene."""
        return np.asarray(self.position[:, nodes].mean(1))


@dataclass(frozen=True, eq=False, kw_only=True)
class RigMotion:
    """What moves a rig: rotations of nodes in their parents, and the place of one of them, in K frames."""

    time: Floats
    """(K,) [s]."""
    rotation: dict[int, Floats]
    """By node: unit quaternions (K, 4) as w, x, y, z, without jumps of sign."""
    root: int
    """The node that is moved."""
    translation: Floats
    """(K, 3) of the root in its parent."""
    gaps: tuple[tuple[float, float], ...]
    """Times of the last key before and the first key after frames without an answer [s]."""
    slides: tuple[float, float] | None = None
    """How far standing feet slide, root mean square, without and with planted feet [scene's unit]; None where none
    stands."""


def pose_rig(rig: CharacterRig, frames: int, turns: Mapping[int, Floats], moved: tuple[int, Floats] | None) -> PosedRig:
    """Pose a rig: some nodes are turned in the scene, all others stay in their parents as at rest.

    Below scales that differ by axis no rotation does exactly what is wanted; the nearest one is taken.

    Args:
        rig: n nodes.
        frames: F.
        turns: By node: how it is turned (F, 3, 3) in the scene from its rest.
        moved: A node and its place (F, 3) in the scene; its parent must stand still or be turned only.
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
    """Give the joint centres (S, 3) of a motion's body in the rest posture, from the pelvis [m].

    They are fixed in the parent segment, so that every answered frame tells them.

    Raises:
        MareyError: No frame is answered, or a parent segment is missing.
    """
    names, known = motion.segment_names, np.flatnonzero(motion.answered)
    if not len(known):
        raise MareyError("The motion has no answered frame.")
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
class _Fit:
    """How a rig at rest stands beside the motion's body at rest."""

    rig: CharacterRig
    motion: BodyMotion
    floor: float | None
    """Height of the body's lowest skin above its pelvis at rest [m], below 0."""

    @cached_property
    def own(self) -> dict[str, Floats]:
        """By segment: the body's joint centre at rest [m], from the pelvis."""
        return dict(zip(self.motion.segment_names, rest_joints(self.motion), strict=True))

    @cached_property
    def world_from_scene(self) -> Floats:
        """The turn (3, 3) that stands the character upright, looking along -Y as the body does at rest."""
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
            raise MareyError("its left and right joints lie in the same place")
        left = left / np.linalg.norm(left)
        return np.stack([left, np.cross(up, left), up])

    @cached_property
    def their_floor(self) -> float | None:
        """Height of the character's lowest skin, in the body's axes; None where nobody knows."""
        skin = self.rig.skin
        return None if skin is None or not len(skin) else float((skin @ self.world_from_scene[2]).min())

    @cached_property
    def theirs(self) -> dict[str, Floats]:
        """By segment: the character's joint centre at rest [scene's unit], in the body's axes."""
        return {s: self.world_from_scene @ self.rig.at_rest.position[0, n] for s, n in self.rig.nodes.items()}

    @cached_property
    def size(self) -> float:
        """The character's legs beside the body's [scene's unit / m]."""
        lengths = [
            sum(np.linalg.norm(at[f"{s}_{b}"] - at[f"{s}_{a}"]) for s in ("left", "right") for a, b in _LEGS)
            for at in (self.theirs, self.own)
        ]
        return float(lengths[0] / lengths[1])

    @cached_property
    def turns(self) -> dict[str, Floats]:
        """By segment: the turn (3, 3) from the character's rest posture to the body's.

        The bones of arms and legs are laid along the body's by the shortest turn of each; hands follow the forearms.
        Feet stay flat and are headed as the body's. Trunk, head and clavicles stay as they are.
        """
        found: dict[str, Floats] = {}
        for name, parent in PARENTS.items():
            if name not in self.rig.nodes:
                continue
            side, _, kind = name.rpartition("_")
            above = found.get(parent or "", np.eye(3))
            if not side or kind == "clavicle":
                found[name] = np.eye(3)
            elif kind in _NEXT:
                end = f"{side}_{_NEXT[kind]}"
                theirs, own = self.theirs[end] - self.theirs[name], self.own[end] - self.own[name]
                found[name] = rotations.shortest(above @ theirs, own) @ above
            elif kind == "foot":
                found[name] = self._heading(side)
            else:
                found[name] = above
        return found

    def _heading(self, side: str) -> Floats:
        """Turn a foot about the vertical, so that it is headed as the body's."""
        if f"{side}_toes" not in self.theirs or f"{side}_toes" not in self.own:
            return np.eye(3)
        flat = np.array([1.0, 1.0, 0.0])
        theirs, own = ((at[f"{side}_toes"] - at[f"{side}_foot"]) * flat for at in (self.theirs, self.own))
        shortest = min(np.linalg.norm(theirs), np.linalg.norm(own))
        return rotations.shortest(theirs, own) if shortest > 1e-9 else np.eye(3)

    def in_scene(self, turns: Floats, segment: str | None = None) -> Floats:
        """Give how a node is turned (F, 3, 3) in the scene from its segment's rotations (F, 3, 3) in the world."""
        laid = self.turns[segment] if segment is not None else np.eye(3)
        return self.rig.scene_from_world @ turns @ laid @ self.world_from_scene


def retarget(
    motion: BodyMotion, rig: CharacterRig, *, floor: float | None = None, grounded: bool = True, planted: bool = False
) -> RigMotion:
    """Carry a motion over to a rig.

    Every joint that is one of our segments turns in the world as the segment does, counted from a common rest posture:
    so the bones of arms and legs point where the body's do, whatever the character's own rest posture. Joints of the
    spine and neck between two of ours share the turn between them evenly; where several joints turn a limb about its
    axis, each takes its share of that; all others stay in their parents as they are. The hips go the body's way,
    enlarged as the legs are long.

    Args:
        motion: The body's. Frames without an answer have no key.
        rig: The character's.
        floor: Height of the body's lowest skin above its pelvis at rest [m]; where it is not known, the character's
            ankles stand above its soles in proportion as the body's do.
        grounded: whether the character is shifted up or down in each frame until its lower foot is as high above the
            floor as the body's, enlarged as the legs are long. It differs where thighs and shanks, or ankles and
            toes, have other proportions.
        planted: whether feet that stand still in the motion stand still on the character: legs bend for that.

    Raises:
        MareyError: A joint is missing or out of order, or the character does not stand upright.
    """
    _check(rig)
    fit = _Fit(rig, motion, floor)
    known = np.flatnonzero(motion.answered)
    turns = _turns(fit, known)
    hips = _hips(fit, known)
    posed = _place(fit, turns, hips)
    # Where the legs do not hang from the pelvis itself, its turn alone does not bring the hips to their place.
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
    """Refuse a rig that lacks joints, or whose joints hang together otherwise than a body's."""
    missing = [name for name in NEEDED if name not in rig.nodes]
    if missing:
        raise MareyError(f"no joint is known for {', '.join(missing)}")
    for name, node in rig.nodes.items():
        parent = PARENTS[name]
        while parent is not None and parent not in rig.nodes:
            parent = PARENTS[parent]
        if parent is not None and rig.nodes[parent] not in rig.above(node):
            raise MareyError(f"the joint of {name} does not hang from that of {parent}")


def _turns(fit: _Fit, known: Integers) -> dict[int, Floats]:
    """Give the rotations (K, 3, 3) in the scene of all nodes that are turned."""
    motion, rig = fit.motion, fit.rig
    by_segment = {name: motion.segment(name)[known] for name in rig.nodes if name in motion.segment_names}
    turned = {rig.nodes[name]: fit.in_scene(turns, name) for name, turns in by_segment.items()}
    for node, (name, share) in rig.twists.items():
        parent = PARENTS[name]
        if name in by_segment and parent in motion.segment_names:
            side, _, kind = name.rpartition("_")
            axis = fit.own[f"{side}_{_NEXT[kind]}"] - fit.own[name]
            turns = untwisted(motion.segment(str(parent))[known], by_segment[name], axis, share)
            turned[node] = fit.in_scene(turns, name)
    trunk = [name for name in _TRUNK if name in by_segment]
    for lower, upper in pairwise(trunk):
        path = rig.above(rig.nodes[upper])
        between = path[: path.index(rig.nodes[lower])][::-1]
        first = by_segment[lower]
        vector = rotations.log(np.swapaxes(first, 1, 2) @ by_segment[upper])
        for k, node in enumerate(between):
            share = (k + 1) / (len(between) + 1)
            turned[node] = fit.in_scene(first @ rotations.exp(share * vector))
    return turned


def _feet(rig: CharacterRig, motion: BodyMotion) -> dict[str, str]:
    """Give by side the joint on which a foot stands: the toes', or the ankle where one of the two lacks toes."""
    toes = {side: f"{side}_toes" for side in _SIDES}
    return {s: t if t in rig.nodes and t in motion.segment_names else f"{s}_foot" for s, t in toes.items()}


def _stands(fit: _Fit, known: Integers) -> dict[str, list[slice]]:
    """Find by side when the body's foot stands still, as rows of the known frames."""
    motion, feet = fit.motion, _feet(fit.rig, fit.motion)
    paths = {side: motion.segment_origin[known, motion.segment_names.index(name)] for side, name in feet.items()}
    ground = min(float(np.quantile(path[:, 2], _LOWEST)) for path in paths.values())
    return {side: standing(motion.time[known], path, ground) for side, path in paths.items()}


def _slide(fit: _Fit, posed: PosedRig, stands: Mapping[str, list[slice]]) -> float | None:
    """Say how far standing feet slide from where they stand, root mean square; None where none stands."""
    off = [
        place[rows] - np.median(place[rows], axis=0)
        for side, name in _feet(fit.rig, fit.motion).items()
        for place in [posed.position[:, fit.rig.nodes[name]]]
        for rows in stands[side]
    ]
    return float(np.sqrt(np.mean(np.sum(np.concatenate(off) ** 2, axis=1)))) if off else None


def _planted(
    fit: _Fit, posed: PosedRig, turns: Mapping[int, Floats], stands: Mapping[str, list[slice]]
) -> dict[int, Floats]:
    """Give the legs' turns with which feet that stand still do so on the rig."""
    rig = fit.rig
    changed: dict[int, Floats] = {}
    for side, name in _feet(rig, fit.motion).items():
        shift = planted_feet(posed.position[:, rig.nodes[name]], stands[side])
        thigh, shank, foot = (rig.nodes[f"{side}_{part}"] for part in ("thigh", "shank", "foot"))
        hinge = turns[thigh] @ rig.scene_from_world[:, 0]
        leg = Leg(posed.position[:, thigh], posed.position[:, shank], posed.position[:, foot], hinge)
        for part, turn in zip(("thigh", "shank"), turns_of_leg(leg, shift), strict=True):
            own = f"{side}_{part}"
            nodes = [rig.nodes[own], *(node for node, (segment, _) in rig.twists.items() if segment == own)]
            changed |= {node: turn @ turns[node] for node in nodes}
    return changed


def _hips(fit: _Fit, known: Integers) -> Floats:
    """Give where the middle between the hips goes (K, 3) in the scene."""
    motion, size = fit.motion, fit.size
    middle = np.mean([motion.segment_origin[known, motion.segment_names.index(f"{s}_thigh")] for s in _SIDES], axis=0)
    ankles = _ankle_heights(fit)
    higher = ankles[0] - size * ankles[1] if ankles else 0.0
    return (size * middle + np.array([0.0, 0.0, higher])) @ fit.rig.scene_from_world.T


def _ankle_heights(fit: _Fit) -> tuple[float, float] | None:
    """Give how high the ankles stand above the soles at rest, the character's and the body's, where both are known."""
    if fit.floor is None or fit.their_floor is None:
        return None
    theirs, own = (np.mean([at[f"{side}_foot"][2] for side in _SIDES]) for at in (fit.theirs, fit.own))
    return float(theirs - fit.their_floor), float(own - fit.floor)


def _thighs(rig: CharacterRig) -> list[int]:
    return [rig.nodes[f"{side}_thigh"] for side in _SIDES]


def _place(fit: _Fit, turns: dict[int, Floats], hips: Floats) -> PosedRig:
    """Pose the rig with its pelvis where the middle between its hips would come to lie at places (K, 3)."""
    rig, root = fit.rig, fit.rig.nodes["pelvis"]
    away = rig.at_rest.middle(_thighs(rig))[0] - rig.at_rest.position[0, root]
    return pose_rig(rig, len(hips), turns, (root, hips - turns[root] @ away))


def _lift(fit: _Fit, posed: PosedRig, hips: Floats, known: Integers) -> Floats:
    """Give how much higher (K,) the character must be for its lower foot to be as high as the body's.

    Args:
        fit: The rig and the body.
        posed: The rig with all its turns, somewhere.
        hips: (K, 3) where the middle between the hips shall be in the scene.
        known: (K,) frames.
    """
    motion, rig, size = fit.motion, fit.rig, fit.size
    names, up = motion.segment_names, rig.scene_from_world[:, 2]
    heights = _ankle_heights(fit)
    own, theirs = (np.mean([at[f"{side}_foot"][2] for side in _SIDES]) for at in (fit.own, fit.theirs))
    both = size * own - theirs + (heights[0] - size * heights[1] if heights else 0.0)
    feet = [f"{side}_{part}" for side in _SIDES for part in ("foot", "toes")]
    feet = [name for name in feet if name in rig.nodes and name in names]
    thighs = posed.middle(_thighs(rig))
    # How high each joint has risen above where it stands at rest, the character's and the body's, enlarged.
    is_now = [(posed.position[:, rig.nodes[n]] - thighs + hips) @ up - fit.theirs[n][2] for n in feet]
    shall = [size * (motion.segment_origin[known, names.index(n), 2] - fit.own[n][2]) + both for n in feet]
    return np.asarray(np.min(shall, axis=0) - np.min(is_now, axis=0))
