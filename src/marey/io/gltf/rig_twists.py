"""Twist joints of rigs: the joints that share the rotation of a limb about its own axis, and their shares."""

from collections.abc import Mapping, Sequence

import numpy as np

from marey.arrays import Floats
from marey.io.gltf.rig_names import path_up, words_of

LIMBS = (("upperarm", "forearm"), ("forearm", "hand"), ("thigh", "shank"), ("shank", "foot"))
"""Segments that may have twist joints, each with the next segment."""
_TWIST_WORDS = ("twist", "roll")
"""Words in the names of twist joints."""
_LARGEST_OFFSET = 0.3
"""Largest distance of a twist joint from the axis of its limb, and beyond its ends, relative to the limb's length;
chosen by hand."""


def find_twists(
    found: Mapping[str, int],
    names: Mapping[int, str],
    parents: Mapping[int, int],
    places: Floats,
    skin: Sequence[tuple[Floats, Floats]] | None,
) -> dict[int, tuple[str, float]]:
    """Find the joints that share the twist of each limb: those on its path, and branches named twist or roll.

    The share of a joint is the mean position along the limb of the skin that is bound to it: the skin of the forearm
    rotates with the hand at the wrist, and not at the elbow. If the skin is unknown, the position of the joint is used.

    Args:
        found: Maps a segment to its node.
        names: Maps a node to its name, for nodes to which skin is bound and all nodes above them.
        parents: Maps a node to its parent.
        places: (n, 3) positions of all nodes in the scene, at rest.
        skin: For each skinned primitive the vertices (V, 3) in the scene, at rest, and their weights by node (V, n).

    Returns:
        Segment and share of its twist, from 0 to 1, by node, for limbs with more than one such joint.
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
    """Return the joints that rotate a limb: its own, those on the path to its end, and twist joints that branch off."""
    path = path_up(far, parents)
    nodes = path[1 : path.index(near) + 1][::-1] if near in path else [near]
    axis = places[far] - places[near]
    length = float(np.linalg.norm(axis))
    for node in sorted(set(names) - ours - set(nodes), key=lambda n: len(path_up(n, parents))):
        words = words_of(names[node])[1]
        if parents.get(node) in nodes and any(word in words for word in _TWIST_WORDS) and length > 0:
            from_start = places[node] - places[near]
            along = float(from_start @ axis) / length**2
            offset = float(np.linalg.norm(from_start - along * axis)) / length
            if -_LARGEST_OFFSET < along < 1 + _LARGEST_OFFSET and offset < _LARGEST_OFFSET:
                nodes.append(node)
    return nodes


def _along(places: Floats, near: int, far: int) -> tuple[Floats, Floats]:
    """Return the start of a limb (3,), and the vector (3,) that maps an offset from it to a position from 0 to 1."""
    axis = places[far] - places[near]
    return places[near], axis / (axis @ axis)


def _share(
    node: int, nodes: Sequence[int], along: tuple[Floats, Floats], places: Floats,
    skin: Sequence[tuple[Floats, Floats]] | None,
) -> float:  # fmt: skip
    """Return the position along the limb, from 0 to 1, of the skin of a joint, or of the joint itself."""
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
    # Without skin, the joint is taken to move the part of the limb up to the next joint.
    return 0.5 * (own_place + min([o for o in others if o > own_place], default=own_place))
