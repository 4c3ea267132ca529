"""Random adults of the free parametric body `anny`, all in one posture, from which the family is learned.

Development only: needs `anny` (0.6.2 was used), `torch`, `numpy` and `scipy`; marey itself needs none of them.
"""

import argparse
import re
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

BATCH = 20
LOCAL_SD = 0.15
LOCAL_SHARE = 0.6
ARM = np.array([0.67, -0.02, -0.74]) / np.linalg.norm([0.67, -0.02, -0.74])
LEG = np.array([0.0, 0.0, -1.0])
# Which of anny's local changes matter for a body at this scale; the face is left out, and so are the changes
# called "trans-out", which push the trunk to one side, and a pregnancy.
LOCAL = re.compile(
    r"lowerarm|upperarm|breast|buttocks|foot|^.-hand|wrist|ankle|^head-|hip|leg|knee|calf|thigh|neck|torso|stomach"
    r"|pelvis|bust|waist|shoulder|chest|measure-"
)
LEFT_OUT = re.compile(r"pregnant|double|age-incr|trans-out$")
OTHER_SIDE = {"Left": "Right", "Right": "Left", "L": "R", "R": "L"}

# anny's bones of the cmu_mb rig that make one segment; the first bone's head is the segment's proximal joint centre.
SEGMENTS = {
    "pelvis": ("Hips", "LHipJoint", "RHipJoint"),
    "abdomen": ("LowerBack", "Spine"),
    "thorax": ("Spine1",),
    "neck": ("Neck", "Neck1"),
    "head": ("Head",),
    "left_clavicle": ("LeftShoulder",),
    "left_upperarm": ("LeftArm",),
    "left_forearm": ("LeftForeArm",),
    "left_hand": ("LeftHand", "LThumb", "LeftFingerBase", "LeftHandFinger1"),
    "left_thigh": ("LeftUpLeg",),
    "left_shank": ("LeftLeg",),
    "left_foot": ("LeftFoot",),
    "left_toes": ("LeftToeBase",),
    "right_clavicle": ("RightShoulder",),
    "right_upperarm": ("RightArm",),
    "right_forearm": ("RightForeArm",),
    "right_hand": ("RightHand", "RThumb", "RightFingerBase", "RightHandFinger1"),
    "right_thigh": ("RightUpLeg",),
    "right_shank": ("RightLeg",),
    "right_foot": ("RightFoot",),
    "right_toes": ("RightToeBase",),
}
PARENTS = {
    "pelvis": "", "abdomen": "pelvis", "thorax": "abdomen", "neck": "thorax", "head": "neck",
    "clavicle": "thorax", "upperarm": "clavicle", "forearm": "upperarm", "hand": "forearm",
    "thigh": "pelvis", "shank": "thigh", "foot": "shank", "toes": "foot",
}  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True)
class People:
    """People posed alike, in metres.

    vertices (N, V, 3), joints (N, S, 3), elbow_axes (N, 2, 3), toe_tips (N, 2, 3), local (N,) whether a person has
    local changes; of the mesh weights (V, S), quads (Q, 4), mirror (V,), used (V,) (no eyes, no tongue).
    """

    vertices: np.ndarray
    joints: np.ndarray
    elbow_axes: np.ndarray
    toe_tips: np.ndarray
    local: np.ndarray
    weights: np.ndarray
    quads: np.ndarray
    mirror: np.ndarray
    used: np.ndarray


def segment_parents() -> list[int]:
    """Index of each segment's parent, -1 for the pelvis."""
    names = list(SEGMENTS)
    parents = []
    for name in names:
        side, _, plain = name.rpartition("_")
        parent = PARENTS[plain]
        sided = f"{side}_{parent}"
        parents.append(names.index(sided) if sided in names else names.index(parent) if parent else -1)
    return parents


def load_model():
    """Anny with the cmu_mb rig, quads, eyes and tongue as loose parts."""
    import anny

    warnings.simplefilter("ignore")
    return anny.create_fullbody_model(
        rig="cmu_mb", topology="default", local_changes="default", all_phenotypes=True, triangulate_faces=False
    )


def draw_phenotypes(rng: np.random.Generator, count: int, sex: float | None = None) -> dict[str, np.ndarray]:
    """Random adults; statures about 1.79 m for men and 1.65 m for women, standard deviation 0.09 m."""
    gender = rng.beta(0.4, 0.4, count) if sex is None else np.full(count, sex)
    phenotype = {"gender": gender, "age": rng.uniform(0.55, 0.92, count)}
    phenotype["height"] = np.clip(rng.normal(0.375, 0.085, count), 0.12, 0.65)
    for name in ("muscle", "weight", "proportions"):
        phenotype[name] = rng.uniform(0.05, 0.95, count)
    for name in ("cupsize", "firmness"):
        phenotype[name] = np.clip(rng.normal(0.5, 0.15, count), 0.05, 0.95)
    mixture = rng.dirichlet([2.0, 2.0, 2.0], count)
    for column, name in enumerate(("african", "asian", "caucasian")):
        phenotype[name] = mixture[:, column]
    return phenotype


def draw_local_changes(rng: np.random.Generator, labels: list[str], count: int, share: float) -> dict[str, np.ndarray]:
    """Random local changes in a share of the people, the same on both sides."""
    chosen = [label for label in labels if LOCAL.search(label) and not LEFT_OUT.search(label)]
    both_sides = sorted({re.sub(r"^[lr]-", "", label) for label in chosen})
    changed = rng.random(count) < share
    values = {name: rng.normal(0, LOCAL_SD, count) * changed for name in both_sides}
    return {label: values[re.sub(r"^[lr]-", "", label)] for label in chosen}


def turn(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """The smallest rotation (3, 3) that turns one direction onto another."""
    start, end = start / np.linalg.norm(start), end / np.linalg.norm(end)
    axis, cosine = np.cross(start, end), float(start @ end)
    hat = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + hat + hat @ hat / (1 + cosine)


def yaw(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """The rotation about the vertical that turns one direction's horizontal part onto another's."""
    flat = np.array([1.0, 1.0, 0.0])
    return turn(start * flat, end * flat)


def rest_rotations(labels: list[str], heads: np.ndarray, tails: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """World rotation of every bone (B, 3, 3) into the common rest posture, and the elbows' axes (2, 3) there."""
    bone = {label: index for index, label in enumerate(labels)}
    rotation = np.tile(np.eye(3), (len(labels), 1, 1))
    axes = []
    for side, letter, sign in (("Left", "L", 1.0), ("Right", "R", -1.0)):
        arm = ARM * [sign, 1, 1]
        along = {part: heads[bone[side + after]] - heads[bone[side + part]]
                 for part, after in (("Arm", "ForeArm"), ("ForeArm", "Hand"), ("UpLeg", "Leg"), ("Leg", "Foot"),
                                     ("Foot", "ToeBase"))}  # fmt: skip
        upper = turn(along["Arm"], arm)
        # the forearm's smallest turn onto the upper arm is about the rig's own elbow axis; flexion is positive
        axes.append(upper @ np.cross(along["Arm"], along["ForeArm"]))
        fore = turn(upper @ along["ForeArm"], arm) @ upper
        hand = turn(fore @ (tails[bone[side + "FingerBase"]] - heads[bone[side + "Hand"]]), arm) @ fore
        rotation[bone[side + "Arm"]], rotation[bone[side + "ForeArm"]] = upper, fore
        for part in (side + "Hand", letter + "Thumb", side + "FingerBase", side + "HandFinger1"):
            rotation[bone[part]] = hand
        rotation[bone[side + "UpLeg"]] = turn(along["UpLeg"], LEG)
        rotation[bone[side + "Leg"]] = turn(along["Leg"], LEG)
        rotation[bone[side + "Foot"]] = rotation[bone[side + "ToeBase"]] = yaw(along["Foot"], np.array([0.0, -1, 0]))
    axes = np.array(axes)
    return rotation, axes / np.linalg.norm(axes, axis=1, keepdims=True)


def pose_alike(labels, parents, weights, vertices, heads, tails):
    """One person in the common rest posture: vertices (V, 3), bone heads (B, 3), elbow axes (2, 3), toe tips (2, 3)."""
    rotation, axes = rest_rotations(labels, heads, tails)
    moved = np.empty_like(heads)
    for index, parent in enumerate(parents):
        moved[index] = 0 if parent < 0 else moved[parent] + rotation[parent] @ (heads[index] - heads[parent])
    shift = moved - np.einsum("bij,bj->bi", rotation, heads)
    blended = np.einsum("vb,bij->vij", weights, rotation)
    toes = [labels.index("LeftToeBase"), labels.index("RightToeBase")]
    tips = moved[toes] + np.einsum("bij,bj->bi", rotation[toes], tails[toes] - heads[toes])
    return np.einsum("vij,vj->vi", blended, vertices) + weights @ shift, moved, axes, tips


def largest_part(quads: np.ndarray, count: int) -> np.ndarray:
    """Mask (V,) of the largest connected part of the mesh: the skin without eyes and tongue."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    ends = np.concatenate([quads[:, [i, (i + 1) % 4]] for i in range(4)])
    graph = coo_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), (count, count))
    _, part = connected_components(graph, directed=False)
    return part == np.bincount(part).argmax()


def merge_weights(labels: list[str], dense: np.ndarray) -> np.ndarray:
    """Weights (V, S) of the segments from those of the bones."""
    return np.stack([dense[:, [labels.index(b) for b in bones]].sum(1) for bones in SEGMENTS.values()], axis=1)


def bone_weights(model) -> tuple[np.ndarray, np.ndarray]:
    """Weights (V, B) of anny's bones, those of a vertex and its mirror image averaged, and the mirror image (V,)."""
    from scipy.spatial import cKDTree

    labels, template = list(model.bone_labels), model.template_vertices.numpy()
    dense = np.zeros((len(template), len(labels)))
    rows = np.arange(len(template))[:, None]
    np.add.at(dense, (rows, model.vertex_bone_indices.numpy()), model.vertex_bone_weights.numpy())
    mirror = cKDTree(template).query(template * [-1, 1, 1])[1]
    swap = [labels.index(re.sub("^(Left|L(?=H|T)|Right|R(?=H|T))", lambda m: OTHER_SIDE[m[0]], b)) for b in labels]
    return (dense + dense[mirror][:, swap]) / 2, mirror


def sample(model, rng: np.random.Generator, count: int, share: float = LOCAL_SHARE, sex: float | None = None) -> People:
    """Draw people and pose them alike."""
    labels, parents = list(model.bone_labels), list(model.bone_parents)
    dense, mirror = bone_weights(model)
    phenotype = draw_phenotypes(rng, count, sex)
    changes = draw_local_changes(rng, list(model.local_change_labels), count, share)
    roots = [labels.index(bones[0]) for bones in SEGMENTS.values()]
    posed = []
    for start in range(0, count, BATCH):
        part = slice(start, start + BATCH)
        with torch.no_grad():
            out = model(
                phenotype_kwargs={k: torch.tensor(v[part]) for k, v in phenotype.items()},
                local_changes_kwargs={k: torch.tensor(v[part]) for k, v in changes.items()},
                return_bone_ends=True,
            )
        rest = (out[name].numpy() for name in ("rest_vertices", "rest_bone_heads", "rest_bone_tails"))
        for person in zip(*rest, strict=True):
            skin, moved, axes, tips = pose_alike(labels, parents, dense, *person)
            posed.append((skin.astype(np.float32), moved[roots], axes, tips))
    vertices, joints, axes, tips = (np.array(values) for values in zip(*posed, strict=True))
    quads = np.asarray(model.faces)
    return People(
        vertices=vertices,
        joints=joints,
        elbow_axes=axes,
        toe_tips=tips,
        local=np.any([v != 0 for v in changes.values()], axis=0),
        weights=merge_weights(labels, dense),
        quads=quads,
        mirror=mirror,
        used=largest_part(quads, len(mirror)),
    )


def main() -> None:
    """Draw the people to learn from and those to test with, and keep them in one file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--count", type=int, default=800)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--share", type=float, default=LOCAL_SHARE, help="share of people with local changes")
    arguments = parser.parse_args()
    people = sample(load_model(), np.random.default_rng(arguments.seed), arguments.count, arguments.share)
    np.savez(arguments.out, **vars(people))


if __name__ == "__main__":
    main()
