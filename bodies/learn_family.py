"""Learn the family of bodies that marey ships: principal components of skin and joint centres together.

Development only, see README.md beside this file. Writes src/marey/body/family.npz.
"""

import argparse
from pathlib import Path

import numpy as np
from decimate import decimate, triangulate
from scipy.sparse import coo_matrix, diags, eye
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

import people as crowd

JOINT_WEIGHT = 3.0
COUNTS = (2600, 800)
STAY = 0.1
MEAN_STEP, MODE_STEP = 4e-5, 2e-5


def symmetric(values: np.ndarray, mirror: np.ndarray) -> np.ndarray:
    """The mean of points (..., V, 3) and their mirror image."""
    return (values + values[..., mirror, :] * [-1, 1, 1]) / 2


def vertex_areas(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """A third of the area of the triangles around each vertex, (V,) m2."""
    corner = points[triangles]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1) / 2
    return np.bincount(triangles.ravel(), np.repeat(area / 3, 3), len(points))


def closest_on_mesh(points: np.ndarray, vertices: np.ndarray, triangles: np.ndarray):
    """Sparse barycentric coordinates (N, V) of the points of a mesh that lie closest to given points."""
    from trimesh.triangles import closest_point, points_to_barycentric

    corners = vertices[triangles]
    _, near = cKDTree(corners.mean(1)).query(points, k=24)
    flat = closest_point(corners[near.ravel()], np.repeat(points, 24, axis=0)).reshape(len(points), 24, 3)
    best = np.argmin(np.linalg.norm(flat - points[:, None], axis=2), axis=1)
    rows = np.arange(len(points))
    face = near[rows, best]
    weights = np.clip(points_to_barycentric(corners[face], flat[rows, best]), 0, 1)
    weights /= weights.sum(1, keepdims=True)
    shape = (len(points), len(vertices))
    return coo_matrix((weights.ravel(), (np.repeat(rows, 3), triangles[face].ravel())), shape).tocsr()


class Fitting:
    """Linear map from the skin of all vertices to the vertices of a small mesh that lies as close to it as it can.

    A small mesh whose vertices lie on a round limb has its faces inside the limb, and its silhouette is too thin. Its
    vertices are therefore moved such that the whole mesh fits in least squares. The map is linear, so it commutes with
    the linear modes.
    """

    def __init__(self, skin: np.ndarray, seen: np.ndarray, area: np.ndarray, order: np.ndarray, triangles: np.ndarray):
        self.seen, self.order = seen, order
        self.onto = closest_on_mesh(skin[seen], skin[order], triangles)
        self.weighted = diags(area[seen] / area[seen].sum() * len(order)) @ self.onto
        self.solve = splu((self.onto.T @ self.weighted + STAY * eye(len(order))).tocsc()).solve

    def __call__(self, skin: np.ndarray) -> np.ndarray:
        """Vertices (n, 3) of the small mesh for a skin, or a mode of it, (V, 3)."""
        return self.solve(np.asarray(self.weighted.T @ skin[self.seen] + STAY * skin[self.order]))


def components(people: crowd.People, area: np.ndarray, seen: np.ndarray, numbers: int):
    """Mean and modes of unit variance of skin (K, V, 3) and joints (K, S, 3), largest first, and each one's share.

    Each vertex counts with the area around it (together COUNTS[0] points), each joint centre with JOINT_WEIGHT squared.
    """
    weight = np.sqrt(np.where(seen, area, 0) / area[seen].sum() * COUNTS[0])
    skin, joints = people.vertices.mean(0, dtype=float), people.joints.mean(0)
    count = len(people.vertices)
    flat = np.concatenate(
        [((people.vertices - skin) * weight[:, None]).reshape(count, -1),
         ((people.joints - joints) * JOINT_WEIGHT).reshape(count, -1)], axis=1)  # fmt: skip
    values, vectors = np.linalg.eigh(flat @ flat.T)
    first = np.argsort(-values)[:numbers]
    # unit variance: the coefficients are the vectors times the square root of the number of people
    coefficients = vectors[:, first] * np.sqrt(count - 1)
    share = values[first] / values.sum()
    inverse = coefficients.T / (count - 1)
    modes = np.tensordot(inverse, people.vertices - skin, axes=1)
    joint_modes = np.tensordot(inverse, people.joints - joints, axes=1)
    top, bottom = skin[:, 2].argmax(), np.where(seen, skin[:, 2], np.inf).argmin()
    taller = np.sign(modes[:, top, 2] - modes[:, bottom, 2])[:, None, None]
    return skin, modes * taller, joints, joint_modes * taller, share


def joint_spread(people: crowd.People, weight: np.ndarray, skin, modes, joints, joint_modes) -> np.ndarray:
    """Root mean square distance of joint centres from those predicted by the skin, by axis (K + 1, S) [m].

    Row k: the first k numbers are those that fit each person's skin in least squares, weighted by vertex.
    """
    root = np.sqrt(weight)[:, None]
    flat = (modes * root).reshape(len(modes), -1)
    normal = flat @ flat.T
    along = np.stack([flat @ ((person - skin) * root).ravel() for person in people.vertices])
    rows = []
    for count in range(len(modes) + 1):
        numbers = np.linalg.solve(normal[:count, :count], along[:, :count].T).T
        off = people.joints - joints - np.tensordot(numbers, joint_modes[:count], axes=1)
        rows.append(np.sqrt(np.mean(off**2, axis=(0, 2))))
    return np.array(rows)


def four_weights(dense: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The four largest weights of each vertex in 255ths that add up to 255, and their segments."""
    segments = np.argsort(-dense, axis=1, kind="stable")[:, :4]
    weights = np.take_along_axis(dense, segments, axis=1)
    weights = weights / weights.sum(1, keepdims=True) * 255
    whole = np.floor(weights + 0.5).astype(int)
    whole[:, 0] += 255 - whole.sum(1)
    segments[whole == 0] = 0
    return whole.astype(np.uint8), segments.astype(np.uint8)


def hinge_axes(people: crowd.People, skin: np.ndarray, dense: np.ndarray) -> np.ndarray:
    """Unit axes (S, 3) of the hinges in the rest posture, NaN for other joints; a positive turn is flexion.

    Knee: the shank goes back. Elbow: the rig's own. Wrist: to the palm. Ankle and toes: they rise (dorsiflexion).
    """
    names = list(crowd.SEGMENTS)
    axes = np.full((len(names), 3), np.nan)
    elbow = people.elbow_axes.mean(0)
    elbow = (elbow[0] + elbow[1] * [1, -1, -1]) / 2
    hand = skin[dense[:, names.index("left_hand")] > 0.9]
    # the palm's normal is where the hand is thinnest, towards the body's middle
    palm = np.linalg.svd(hand - hand.mean(0), full_matrices=False)[2][2]
    palm = palm * -np.sign(palm[0])
    wrist = np.cross(crowd.ARM, palm)
    left = {"forearm": elbow, "hand": wrist, "shank": np.array([1.0, 0, 0]), "foot": np.array([-1.0, 0, 0]),
            "toes": np.array([-1.0, 0, 0])}  # fmt: skip
    for name, axis in left.items():
        axes[names.index("left_" + name)] = axis / np.linalg.norm(axis)
        # a turn seen in a mirror is an axial vector: what lies in the mirror changes sign
        axes[names.index("right_" + name)] = axis / np.linalg.norm(axis) * [1, -1, -1]
    return axes


def whole_steps(values: np.ndarray, step: float) -> np.ndarray:
    """Values in whole steps as int16."""
    steps = np.round(values / step)
    if np.abs(steps).max() > 32767:
        raise ValueError("the step is too small for int16")
    return steps.astype(np.int16)


def learn(people: crowd.People, hidden: np.ndarray, numbers: int) -> dict[str, np.ndarray]:
    """All arrays of family.npz."""
    mirror, seen = people.mirror, people.used & ~hidden
    names = list(crowd.SEGMENTS)
    swap = [names.index(n.replace("left_", "#").replace("right_", "left_").replace("#", "right_")) for n in names]
    mean = symmetric(people.vertices.mean(0, dtype=float), mirror)
    quads = people.quads[people.used[people.quads].all(1)]
    triangles = triangulate(quads, mean, mirror)
    order, (fine, coarse) = decimate(mean, triangles, mirror, hidden, COUNTS)
    area = vertex_areas(mean, triangles)
    skin, modes, joints, joint_modes, share = components(people, area, seen, numbers)
    skin, modes = symmetric(skin, mirror), symmetric(modes, mirror)
    joints, joint_modes = symmetric(joints, np.array(swap)), symmetric(joint_modes, np.array(swap))
    spread = joint_spread(people, np.where(seen, area, 0), skin, modes, joints, joint_modes)
    weights, segments = four_weights(people.weights[order])
    few = int(coarse.max()) + 1
    place = np.full(len(mirror), -1)
    place[order] = np.arange(len(order))
    arrays = {
        "segment_names": np.array(names),
        "parents": np.array(crowd.segment_parents(), np.int8),
        "joints_mean": joints.astype(np.float32),
        "joints_modes": joint_modes.astype(np.float32),
        "joints_sd": np.sqrt((spread**2 + spread[:, swap] ** 2) / 2).astype(np.float32),
        "share": share.astype(np.float32),
        "hinge_axes": hinge_axes(people, mean, people.weights).astype(np.float32),
        "vertex_weights": weights,
        "vertex_segments": segments,
        "mirror": place[mirror[order]].astype(np.uint16),
        "faces_fine": fine.astype(np.uint16),
        "faces_coarse": coarse.astype(np.uint16),
        "steps": np.array([MEAN_STEP, MODE_STEP]),
    }
    for level, faces, part in (("fine", fine, order), ("coarse", coarse, order[:few])):
        fit = Fitting(mean, seen, area, part, faces)
        fitted = symmetric(np.stack([fit(m) for m in (skin, *modes)]), place[mirror[part]])
        arrays[f"vertices_mean_{level}"] = whole_steps(fitted[0], MEAN_STEP)
        arrays[f"vertices_modes_{level}"] = whole_steps(fitted[1:], MODE_STEP)
    return arrays


def hidden_vertices(model) -> np.ndarray:
    """Mask (V,) of anny's vertices inside the mouth, the nose and the eye sockets."""
    import torch
    from anny.paths import get_anny_root_dir

    cavities = torch.load(get_anny_root_dir() / "data" / "template_mesh_internal_cavities.pth", weights_only=True)
    return np.isin(model.base_mesh_vertex_indices.numpy(), cavities["vertex_indices"])


def main() -> None:
    """Draw people, learn the family, write it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=800)
    parser.add_argument("--numbers", type=int, default=16)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "src/marey/body/family.npz")
    arguments = parser.parse_args()
    model = crowd.load_model()
    people = crowd.sample(model, np.random.default_rng(arguments.seed), arguments.count)
    arrays = learn(people, hidden_vertices(model), arguments.numbers)
    np.savez_compressed(arguments.out, **arrays)
    shares = " ".join(f"{100 * s:.1f}" for s in arrays["share"])
    print(f"{arguments.out}: {arguments.out.stat().st_size / 1000:.0f} kB; variance in per cent: {shares}")


if __name__ == "__main__":
    main()
