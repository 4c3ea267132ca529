"""Draw the family's mean body at both levels, at rest and bent: docs/pictures/body.png."""

import argparse
from pathlib import Path

import matplotlib
import numpy as np

from marey.body.people.family import BodyFamily, load_family
from marey.geometry import rotations

matplotlib.use("Agg")
VIEWS = {"front": ((1, 0, 0), (0, 1, 0)), "side": ((0, -1, 0), (-1, 0, 0)), "back": ((-1, 0, 0), (0, -1, 0))}
ARM = np.array([0.67, -0.02, -0.74]) / np.linalg.norm([0.67, -0.02, -0.74])
RIGHT = np.array([-1, 1, 1])


def turn(axis, degrees: float) -> np.ndarray:
    """Rotation about an axis."""
    return rotations.exp(np.asarray(axis, float) * np.deg2rad(degrees))


def between(start, end) -> np.ndarray:
    """The smallest rotation from one direction to another."""
    axis = np.cross(start, end)
    return rotations.exp(axis / np.linalg.norm(axis) * np.arctan2(np.linalg.norm(axis), np.dot(start, end)))


def posed(family: BodyFamily, turns: dict[str, np.ndarray]) -> np.ndarray:
    """Skin (V, 3) with some segments turned on their parents."""
    count, joints = len(family.segment_names), family.joints_mean
    rotation, at, out = np.empty((count, 3, 3)), np.zeros((count, 3)), np.zeros_like(family.vertices_mean)
    for k, (name, parent) in enumerate(zip(family.segment_names, family.parents, strict=True)):
        own = turns.get(name, np.eye(3))
        rotation[k] = own if parent < 0 else rotation[parent] @ own
        at[k] = 0 if parent < 0 else at[parent] + rotation[parent] @ (joints[k] - joints[parent])
    for column in range(4):
        k = family.vertex_segments[:, column]
        moved = np.einsum("vij,vj->vi", rotation[k], family.vertices_mean - joints[k]) + at[k]
        out += family.vertex_weights[:, column, None] * moved
    return out


def poses(family: BodyFamily) -> list[tuple[dict[str, np.ndarray], str]]:
    """Postures that show bad weights, each with the view to see it from."""
    elbow, wrist = (family.hinge_axes[family.segment("left_" + s)] for s in ("forearm", "hand"))
    kneeling = {"left_forearm": turn(elbow, 90), "left_shank": turn([1, 0, 0], 90)}
    kneeling |= {"right_thigh": turn([-1, 0, 0], 90), "right_shank": turn([1, 0, 0], 90)}
    hanging = {"left_upperarm": between(ARM, [0.1, 0, -1]), "right_upperarm": between(ARM * RIGHT, [-0.05, 0, -1])}
    raised = {"left_clavicle": turn([0, -1, 0], 20), "left_upperarm": between(ARM, [0.3, 0, 1])}
    raised |= {"right_upperarm": between(ARM * RIGHT, [-1, 0, 0])}
    bent = {"left_upperarm": between(ARM, [0.1, -1, 0]), "abdomen": turn([1, 0, 0], 30), "head": turn([0, 0, 1], 40)}
    twisted = {"left_forearm": turn(ARM, 70), "left_hand": turn(wrist, 60), "right_upperarm": turn(ARM * RIGHT, 80)}
    twisted |= {"left_thigh": turn([0, -1, 0], 40), "right_foot": turn([-1, 0, 0], 25)}
    return [({}, "front"), ({}, "side"), ({}, "back"), (kneeling, "side"), (hanging, "front"), (raised, "back"),
            (bent, "side"), (twisted, "front")]  # fmt: skip


def draw(axes, vertices: np.ndarray, faces: np.ndarray, colours: np.ndarray, view: str) -> None:
    """Paint the triangles from far to near."""
    from matplotlib.collections import PolyCollection

    right, away = (np.array(v, float) for v in VIEWS[view])
    flat = np.stack([vertices @ right, vertices[:, 2]], axis=1)
    corner = vertices[faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    facing = -normal @ away
    order = np.argsort(-(corner.mean(1) @ away))
    order = order[facing[order] > 0]
    light = np.clip(0.4 + 0.35 * normal @ [-0.4, -0.5, 0.75] + 0.25 * facing, 0, 1)[:, None]
    axes.add_collection(PolyCollection(flat[faces[order]], facecolors=np.clip(colours * light * 1.2, 0, 1)[order],
                                       edgecolors=(0, 0, 0, 0.2), linewidths=0.2))  # fmt: skip
    axes.set_xlim(-0.78, 0.78)
    axes.set_ylim(-0.95, 1.25)
    axes.set_aspect("equal")
    axes.axis("off")


def main() -> None:
    """Draw both levels."""
    import matplotlib.pyplot as plt

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "docs/pictures/body.png")
    arguments = parser.parse_args()
    palette = np.array(plt.get_cmap("tab20").colors)
    figure, axes = plt.subplots(2, 8, figsize=(20, 7.5))
    for row, level in zip(axes, ("fine", "coarse"), strict=True):
        family = load_family(level)
        colour = palette[family.vertex_segments % 20]
        blended = np.sum(family.vertex_weights[:, :, None] * colour, axis=1)[family.faces].mean(1)
        for place, (turns, view) in zip(row, poses(family), strict=True):
            draw(place, posed(family, turns), family.faces, blended, view)
    figure.subplots_adjust(0, 0, 1, 1, 0, 0)
    figure.savefig(arguments.out, dpi=70)


if __name__ == "__main__":
    main()
