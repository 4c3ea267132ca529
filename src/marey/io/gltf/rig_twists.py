"""Twist joints of rigs: which joints a limb has to turn about its own axis, and how much of the turn each one takes."""

from collections.abc import Mapping, Sequence

import numpy as np

from marey.arrays import Floats
from marey.io.gltf.rig_names import path_up, words_of

LIMBS = (("upperarm", "forearm"), ("forearm", "hand"), ("thigh", "shank"), ("shank", "foot"))
_WORDS = ("twist", "roll")
_BESIDE = 0.3
"""How far a twist joint may lie beside its limb, and before or behind it, as a share of the limb's length."""


def find_twists(
    found: Mapping[str, int],
    names: Mapping[int, str],
    parents: Mapping[int, int],
    places: Floats,
    skin: Sequence[tuple[Floats, Floats]] | None,
) -> dict[int, tuple[str, float]]:
    """Tell which joints share a limb's twist: those on the way to its end, and branches named twist or roll.

    Each takes as much of the twist as the skin that it carries lies along the limb: the wrist's end of the forearm
    turns with the hand, the elbow's end does not. Where skin is not known, its own place on the limb counts.

    Args:
        found: By segment: its node.
        names: By node that carries skin or lies above one that does.
        parents: By node.
        places: (n, 3) of all nodes in the scene, at rest.
        skin: Of every skinned piece the vertices (V, 3) in the scene, at rest, and their weights by node (V, n).

    Returns:
        By node, of limbs that have more than one: the segment, and the share of its twist from 0 to 1.
    """
    shares: dict[int, tuple[str, float]] = {}
    for side in ("left", "right"):
        for start, end in LIMBS:
            segment, beyond = f"{side}_{start}", f"{side}_{end}"
            if segment in found and beyond in found:
                nodes = _on_limb(found[segment], found[beyond], set(found.values()), names, parents, places)
                if len(nodes) > 1:
                    along = _along(places, found[segment], found[beyond])
                    shares |= {node: (segment, _share(node, nodes, along, places, skin)) for node in nodes}
    return shares


def _on_limb(
    near: int, far: int, ours: set[int], names: Mapping[int, str], parents: Mapping[int, int], places: Floats
) -> list[int]:
    """List the joints that turn a limb: its own, those on the way to its end, and twist joints that branch off."""
    path = path_up(far, parents)
    nodes = path[1 : path.index(near) + 1][::-1] if near in path else [near]
    axis = places[far] - places[near]
    length = float(np.linalg.norm(axis))
    for node in sorted(set(names) - ours - set(nodes), key=lambda n: len(path_up(n, parents))):
        words = words_of(names[node])[1]
        if parents.get(node) in nodes and any(word in words for word in _WORDS) and length > 0:
            away = places[node] - places[near]
            along = float(away @ axis) / length**2
            beside = float(np.linalg.norm(away - along * axis)) / length
            if -_BESIDE < along < 1 + _BESIDE and beside < _BESIDE:
                nodes.append(node)
    return nodes


def _along(places: Floats, near: int, far: int) -> tuple[Floats, Floats]:
    """Give a limb's beginning, and the vector whose product with what lies from there says how far along that is."""
    axis = places[far] - places[near]
    return places[near], axis / (axis @ axis)


def _share(
    node: int, nodes: Sequence[int], along: tuple[Floats, Floats], places: Floats,
    skin: Sequence[tuple[Floats, Floats]] | None,
) -> float:  # fmt: skip
    """Say where along the limb, from 0 to 1, the skin of a joint lies, or the joint itself."""
    start, axis = along
    total = weight = 0.0
    for points, shares in skin or ():
        own = shares[:, node]
        total += float(own @ np.clip((points - start) @ axis, 0, 1))
        weight += float(own.sum())
    if weight > 0:
        return total / weight
    others = [float(np.clip((places[n] - start) @ axis, 0, 1)) for n in nodes if n != node]
    own_place = float(np.clip((places[node] - start) @ axis, 0, 1))
    # Without skin: a joint on the way holds the piece up to the next one.
    return 0.5 * (own_place + min([o for o in others if o > own_place], default=own_place))
