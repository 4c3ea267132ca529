"""Identification of the joints of a character by their names and their positions in the tree."""

import re
from collections.abc import Mapping, Sequence

from marey.body.articulation.skeleton import PARENTS

_SIDES = {"left": "left", "l": "left", "lft": "left", "right": "right", "r": "right", "rgt": "right"}
"""Side by the word that names it."""
_PREFIXES = frozenset(
    {
        "mixamorig", "def", "org", "j", "bip", "biped", "valvebiped", "valve", "c", "cc", "base", "bone", "joint",
        "jnt", "bn", "b", "sk", "skel", "skeleton", "character", "rig",
    }
)  # fmt: skip
"""Words without meaning that exporters put into the names of joints."""
_LIMB_WORDS: dict[str, tuple[tuple[str, ...], ...]] = {
    "thigh": (("thigh", "upleg", "upperleg", "thighbend", "femur"), ("hip",), ("leg",)),
    "shank": (("shank", "shin", "calf", "lowerleg", "lowleg", "loleg", "crus"), ("leg",), ("knee",)),
    "foot": (("foot", "ankle"),),
    "toes": (("toes", "toe", "toebase", "ball"), ("foot",)),
    "upperarm": (("upperarm", "uparm", "shldrbend", "humerus"), ("arm",), ("shoulder", "shldr")),
    "clavicle": (("clavicle", "collar", "collarbone"), ("shoulder",)),
    "forearm": (("forearm", "lowerarm", "lowarm", "loarm", "forearmbend"), ("elbow",)),
    "hand": (("hand", "wrist"),),
}
"""Names of each limb segment in rigs, the least ambiguous first; searched in this order, each joint is used once."""
_TRUNK_WORDS = {
    "pelvis": ("pelvis", "hips", "hip"), "abdomen": ("abdomen",), "thorax": ("thorax",), "neck": ("neck", "neckroot"),
    "head": ("head",),
}  # fmt: skip
"""Names of each trunk segment in rigs."""
VRM_BONES = {
    "hips": "pelvis", "neck": "neck", "head": "head",
    **{
        f"{side}{bone}": f"{side}_{segment}"
        for side in ("left", "right")
        for bone, segment in (
            ("Shoulder", "clavicle"), ("UpperArm", "upperarm"), ("LowerArm", "forearm"), ("Hand", "hand"),
            ("UpperLeg", "thigh"), ("LowerLeg", "shank"), ("Foot", "foot"), ("Toes", "toes"),
        )
    },
}  # fmt: skip
"""Segment by the name of the bone in a VRM humanoid; the spine is found by the tree, as for other rigs."""


def words_of(name: str) -> tuple[str | None, str]:
    """Split the name of a joint into side and remainder: "mixamorig:LeftUpLeg" into "left" and "upleg".

    Numbers and the usual prefixes of exporters are removed.
    """
    words = [w.lower() for w in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name.split(":")[-1])]
    if words and words[0].startswith("mixamorig"):
        words[0] = words[0].removeprefix("mixamorig")
    words = [w for w in words if w and w not in _PREFIXES]
    sides = [_SIDES[w] for w in words if w in _SIDES]
    rest = "".join(w for w in words if w not in _SIDES)
    # Some exporters write "leftupleg", without a boundary between the words.
    for side in ("left", "right"):
        if not sides and rest.startswith(side):
            return side, rest.removeprefix(side)
    return (sides[0] if len(set(sides)) == 1 else None), rest


def name_joints(names: Mapping[int, str], parents: Mapping[int, int], known: Mapping[str, int]) -> dict[str, int]:
    """Identify the joint of each segment.

    The limbs, the pelvis, the neck and the head are found by name, the other segments of the trunk by the tree: the
    pelvis is the lowest joint above both legs and the thorax, the thorax the lowest above both arms, the abdomen the
    first joint from the pelvis toward the thorax, and the neck the first from the thorax toward the head.

    Args:
        names: Maps a node to its name.
        parents: Maps a node to its parent; roots have none.
        known: Maps a segment to its node, for segments that are already known and are not changed.

    Returns:
        The node of each segment, in the order of the skeleton; segments that were not found are missing.
    """
    found = dict(known)
    parted = {node: words_of(name) for node, name in names.items()}
    for side in ("left", "right"):
        for plain, ranks in _LIMB_WORDS.items():
            _take(f"{side}_{plain}", ranks, {n: w for n, (s, w) in parted.items() if s == side}, parents, found)
    middle = {node: words for node, (side, words) in parted.items() if side is None}
    for segment, synonyms in _TRUNK_WORDS.items():
        _take(segment, (synonyms,), middle, parents, found)
    _fill_trunk(middle, parents, known, found)
    return {segment: found[segment] for segment in PARENTS if segment in found}


def _take(
    segment: str,
    ranks: Sequence[tuple[str, ...]],
    words: Mapping[int, str],
    parents: Mapping[int, int],
    found: dict[str, int],
) -> None:
    """Assign to a segment the joint with the least ambiguous name, and of several the one nearest to the root."""
    if segment in found:
        return
    for rank in ranks:
        fitting = [node for node, word in words.items() if word in rank and node not in found.values()]
        if fitting:
            found[segment] = min(fitting, key=lambda node: (len(path_up(node, parents)), node))
            return


def path_up(node: int, parents: Mapping[int, int]) -> list[int]:
    """Return a node and all nodes above it, up to its root."""
    path = [node]
    while path[-1] in parents and parents[path[-1]] not in path:
        path.append(parents[path[-1]])
    return path


def common_ancestor(nodes: Sequence[int], parents: Mapping[int, int], *, proper: bool = False) -> int | None:
    """Return the lowest common ancestor of nodes.

    Args:
        nodes: One or more nodes.
        parents: Maps a node to its parent.
        proper: Whether the ancestor must differ from all the nodes.

    Returns:
        The node; None if the nodes have different roots.
    """
    paths = [path_up(node, parents)[int(proper) :] for node in nodes]
    return next((node for node in paths[0] if all(node in path for path in paths)), None)


def _fill_trunk(
    words: Mapping[int, str], parents: Mapping[int, int], given: Mapping[str, int], found: dict[str, int]
) -> None:
    """Find pelvis, abdomen, thorax, neck and head by the tree if they are unknown or their names contradict it."""
    thighs, arms = ([found.get(f"{side}_{limb}") for side in ("left", "right")] for limb in ("thigh", "upperarm"))
    arms = [found.get(f"{side}_clavicle", arm) for side, arm in zip(("left", "right"), arms, strict=True)]
    chest = common_ancestor([n for n in arms if n is not None], parents) if None not in arms else None
    if "thorax" not in found and chest is not None:
        # If the arms are children of the neck, the thorax is the parent of the neck.
        chest = parents.get(chest) if chest == found.get("neck") else chest
        if chest is not None and chest not in found.values():
            found["thorax"] = chest
    if "pelvis" not in given and None not in thighs:
        above = [found.get("pelvis"), *thighs, found.get("thorax")]
        pelvis = common_ancestor([n for n in above if n is not None], parents)
        if pelvis is not None:
            found["pelvis"] = pelvis
    if "thorax" in found and "head" not in found:
        _follow_spine(words, parents, found)
    for segment, below, top in (("abdomen", "pelvis", "thorax"), ("neck", "thorax", "head")):
        if segment in found or below not in found or top not in found:
            continue
        path = path_up(found[top], parents)
        between = path[1 : path.index(found[below])] if found[below] in path else []
        if between:
            found[segment] = between[-1]


def _follow_spine(words: Mapping[int, str], parents: Mapping[int, int], found: dict[str, int]) -> None:
    """Assign to the head the last joint of a spine that continues beyond the thorax under the same name."""
    node, taken = found["thorax"], set(found.values())
    while True:
        above = [n for n, word in words.items() if parents.get(n) == node and word in ("spine", "neck")]
        if len(above) != 1:
            break
        node = above[0]
    if node not in taken:
        found["head"] = node
