"""Identification of the joints of an upright character by their positions, if their names are unknown."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats
from marey.io.gltf.rig_names import common_ancestor, path_up

_SIDES = ("left", "right")
"""Names of the sides, in the order of the limbs."""


@dataclass(frozen=True, kw_only=True)
class RigShapeSettings:
    """Thresholds for the identification of joints by position; chosen by hand."""

    leg_end_height: float = 0.2
    """Fraction of the height of the character below which legs end."""
    arm_depth: float = 0.1
    """Largest depth of the ends of arms below the pelvis, as a fraction of the height."""
    least_reach: float = 0.1
    """Smallest distance of the ends of arms from the pelvis to either side, as a fraction of the height."""
    divided_joints: int = 5
    """Smallest number of joints of a limb whose long bones may be divided."""
    undivided_fraction: float = 0.55
    """Fraction of a limb's length above which its two longest bones are taken as undivided."""
    direction_change: float = 40.0
    """Angle between bones above which they belong to different segments [degrees]."""
    most_children: int = 1
    """Joints of an arm with more children than this are hands, because fingers branch off."""
    arm_ratio: float = 1.15
    """Usual ratio of the lengths of upper arm and forearm."""
    leg_ratio: float = 1.05
    """Usual ratio of the lengths of thigh and shank."""
    ratio_tolerance: float = 0.45
    """Largest plausible deviation from the usual ratio, as a difference of natural logarithms."""


def find_joints_by_position(
    places: Mapping[int, Floats], parents: Mapping[int, int], known: Mapping[str, int],
    settings: RigShapeSettings = RigShapeSettings(),
) -> dict[str, int]:  # fmt: skip
    """Guess the joints of the segments from the positions of joints, Y up.

    Legs end near the floor on both sides of one joint, the pelvis; arms extend farthest to the sides from a joint above
    it. In each limb, the two longest consecutive bones are thigh and shank, or upper arm and forearm; if the long bones
    are divided, the joints are chosen so that the ratio of the two lengths is nearest to the usual one. The left side
    is that of joints that are known to be left; otherwise it follows from the direction of the toes, or, without toes,
    from the assumption that the character faces along Z.

    Args:
        places: Maps a node to its position (3,) in the scene, at rest.
        parents: Maps a node to its parent.
        known: Maps a segment to its node, for known segments.
        settings: Thresholds.

    Returns:
        The node of each segment; empty if the joints are not those of an upright person.
    """
    children = _children(places, parents)
    ends = [node for node in places if not children[node]]
    heights = np.array([place[1] for place in places.values()])
    tall = float(np.ptp(heights)) if len(heights) else 0.0
    low = [end for end in ends if tall and places[end][1] < heights.min() + settings.leg_end_height * tall]
    legs = _pair(low, places, parents)
    if legs is None:
        return {}
    pelvis, leg_ends = legs
    middle, across = places[pelvis], places[leg_ends[0]] - places[leg_ends[1]]
    across = across * [1, 0, 1] / max(float(np.linalg.norm(across * [1, 0, 1])), 1e-12)
    upper = [end for end in ends if end not in low and places[end][1] > places[pelvis][1] - settings.arm_depth * tall]
    reach = {end: float((places[end] - middle) @ across) for end in upper}
    least = settings.least_reach * tall
    if not reach or max(reach.values()) < least or min(reach.values()) > -least:
        return {}
    arm_ends = [max(reach, key=lambda end: reach[end]), min(reach, key=lambda end: reach[end])]
    chest, top = common_ancestor(arm_ends, parents, proper=True), pelvis
    if chest is None:
        return {}
    # If the legs are attached to a joint beside the spine, the pelvis is the joint above it and the chest.
    pelvis = next((node for node in path_up(top, parents) if node in path_up(chest, parents)), -1)
    if pelvis not in places or chest not in places:
        return {}
    limbs = [
        _limbs(leg, arm, (top, chest), places, parents, settings) for leg, arm in zip(leg_ends, arm_ends, strict=True)
    ]
    if any(not limb for limb in limbs):
        return {}
    if _first_is_right(limbs, places, known):
        limbs = limbs[::-1]
    found = {"pelvis": pelvis} | ({"thorax": chest} if chest != pelvis else {})
    for side, limb in zip(_SIDES, limbs, strict=True):
        found |= {f"{side}_{segment}": node for segment, node in limb.items()}
    return found | _head(chest, arm_ends, ends, places, parents)


def _children(places: Mapping[int, Floats], parents: Mapping[int, int]) -> dict[int, list[int]]:
    """Return the children of each node."""
    children: dict[int, list[int]] = {node: [] for node in places}
    for node in places:
        if parents.get(node) in children:
            children[parents[node]].append(node)
    return children


def _pair(
    ends: list[int], places: Mapping[int, Floats], parents: Mapping[int, int]
) -> tuple[int, tuple[int, int]] | None:
    """Return the joint from which the legs branch, and the ends of the legs: the pair that is deepest and widest."""
    best, found = 0.0, None
    for k, first in enumerate(ends):
        for second in ends[k + 1 :]:
            top = common_ancestor((first, second), parents, proper=True)
            apart = float(np.linalg.norm((places[first] - places[second]) * [1, 0, 1]))
            if top is None or top not in places:
                continue
            # The product prefers two legs, which branch high, to two toes of one foot, which branch low.
            deep = min(places[top][1] - places[end][1] for end in (first, second))
            if deep * apart > best:
                best, found = deep * apart, (top, (first, second))
    return found


def _limbs(
    leg_end: int, arm_end: int, tops: tuple[int, int], places: Mapping[int, Floats], parents: Mapping[int, int],
    settings: RigShapeSettings,
) -> dict[str, int]:  # fmt: skip
    """Return the joints of one leg and one arm, or nothing if a limb has too few joints."""
    found: dict[str, int] = {}
    plan = (
        (leg_end, tops[0], ("thigh", "shank", "foot"), "toes", None),
        (arm_end, tops[1], ("upperarm", "forearm", "hand"), None, "clavicle"),
    )
    children = _children(places, parents)
    for end, top, segments, beyond, before in plan:
        path = path_up(end, parents)
        path = path[: path.index(top)][::-1]
        if len(path) < 3:
            return {}
        first, middle, last = _two_bones(path, places, children, settings, leg=beyond is not None)
        found |= dict(zip(segments, (path[first], path[middle], path[last]), strict=True))
        if beyond is not None and last + 1 < len(path):
            found[beyond] = path[last + 1]
        if before is not None and first > 0:
            found[before] = path[first - 1]
    return found


def _two_bones(
    path: Sequence[int], places: Mapping[int, Floats], children: Mapping[int, Sequence[int]],
    settings: RigShapeSettings, *, leg: bool,
) -> tuple[int, int, int]:  # fmt: skip
    """Return the ends of the two long bones of a limb, as three indices into its path.

    Usually these are the two longest consecutive bones. If they make up little more than half of the limb, or differ
    too much in length, the long bones are divided into several joints. Then the limb ends at the ankle, where the path
    turns forward, or at the wrist, where fingers branch off or the path ends; the other two joints are those for which
    the ratio of the lengths is nearest to the usual one.
    """
    at = np.array([places[node] for node in path])
    bones = np.linalg.norm(np.diff(at, axis=0), axis=1)
    pairs = np.minimum(bones[:-1], bones[1:])
    best = int(np.argmax(pairs))
    way = np.concatenate([[0.0], np.cumsum(bones)])

    def unusual(first: int, middle: int, last: int) -> float:
        usual = settings.leg_ratio if leg else settings.arm_ratio
        return abs(float(np.log((way[middle] - way[first]) / (way[last] - way[middle]) / usual)))

    undivided = bones[best] + bones[best + 1] > settings.undivided_fraction * bones.sum()
    undivided = undivided and unusual(best, best + 1, best + 2) < settings.ratio_tolerance
    if len(path) < settings.divided_joints or undivided:
        return best, best + 1, best + 2
    same_direction = np.cos(np.radians(settings.direction_change))
    directions = np.diff(at, axis=0) / np.maximum(bones, 1e-12)[:, None]
    if leg:
        forward = np.flatnonzero(directions[:, 1] > -same_direction)
        last = int(forward[forward > 1][0]) if (forward > 1).any() else len(path) - 1
    else:
        fingers = [k for k, node in enumerate(path) if len(children[node]) > settings.most_children and k > 1]
        last = fingers[0] if fingers else len(path) - 1
    # The path may begin with a bone of the trunk, at the hip or the shoulder, which has another direction.
    along = directions[:last] @ directions[last - 1]
    begins = [k for k in range(last - 1) if along[k] > same_direction][:2]
    return min(((k, m, last) for k in begins or [0] for m in range(k + 1, last)), key=lambda ends: unusual(*ends))


def _first_is_right(limbs: list[dict[str, int]], places: Mapping[int, Floats], known: Mapping[str, int]) -> bool:
    """Return whether the first of the two sides is the right one."""
    across = places[limbs[0]["thigh"]] - places[limbs[1]["thigh"]]
    pairs = [(known[n], known.get(n.replace("left_", "right_"))) for n in known if n.startswith("left_")]
    left = [places[a] - places[b] for a, b in pairs if b is not None and a in places and b in places]
    if left:
        return bool(np.sum(left, axis=0) @ across < 0)
    toes = [places[limb["toes"]] - places[limb["foot"]] for limb in limbs if "toes" in limb]
    forward = np.sum(toes, axis=0) if toes else np.array([0.0, 0.0, 1.0])
    return bool(np.cross(np.array([0.0, 1.0, 0.0]), forward) @ across < 0)


def _head(
    chest: int, arms: list[int], ends: list[int], places: Mapping[int, Floats], parents: Mapping[int, int]
) -> dict[str, int]:
    """Return neck and head: the first joints from the chest toward the highest end that belongs to no arm."""
    of_arms = {node for end in arms for node in path_up(end, parents)[: path_up(end, parents).index(chest)]}
    free = [end for end in ends if chest in path_up(end, parents)[1:] and not of_arms & set(path_up(end, parents))]
    if not free:
        return {}
    path = path_up(max(free, key=lambda end: places[end][1]), parents)
    path = path[: path.index(chest)][::-1]
    return {"neck": path[0], "head": path[1]} if len(path) > 1 else {"head": path[0]}
