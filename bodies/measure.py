"""How well the family describes other people, and rendered takes: tables of docs/explanation/body.md.

Development only. New people are drawn (with other seeds than those learned from); errors are of corresponding points,
an upper bound of the distance between surfaces. The takes' part needs marey itself: PYTHONPATH=src.
"""

import argparse
import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
from learn_family import components, four_weights, hidden_vertices, symmetric, triangulate, vertex_areas

import people as crowd

NUMBERS = (1, 4, 8, 12, 16, 24)
JOINTS = {"hip": "thigh", "knee": "shank", "ankle": "foot", "shoulder": "upperarm", "elbow": "forearm", "wrist": "hand"}


def fitted(flat: np.ndarray, modes: np.ndarray) -> np.ndarray:
    """Numbers (N, K) that bring the surface closest to each person's in least squares."""
    return np.linalg.lstsq(modes.T, flat.T, rcond=None)[0].T


def row(errors: np.ndarray, joint_errors: np.ndarray, weight: np.ndarray) -> tuple[float, float, float]:
    """Mean and 95th percentile of the surface's error, each point by its area, and mean error of the joints, mm."""
    order = np.argsort(errors.ravel())
    cumulated = np.cumsum(np.tile(weight, len(errors))[order])
    p95 = errors.ravel()[order][np.searchsorted(cumulated, 0.95 * cumulated[-1])]
    return float(errors.mean(0) @ weight / weight.sum() * 1e3), float(p95 * 1e3), float(joint_errors.mean() * 1e3)


def left_out(model, learned: crowd.People, count: int) -> None:
    """Print the table of people left out of the learning."""
    seen = learned.used & ~hidden_vertices(model)
    mean = symmetric(learned.vertices.mean(0, dtype=float), learned.mirror)
    area = vertex_areas(mean, triangulate(learned.quads[learned.used[learned.quads].all(1)], mean, learned.mirror))
    skin, modes, joints, joint_modes, _ = components(learned, area, seen, max(NUMBERS))
    new = [crowd.sample(model, np.random.default_rng(1000 + i), count, share) for i, share in enumerate((0.0, 1.0))]
    root = np.sqrt(area[seen])[:, None]
    print("| numbers | phenotypes only: surface mean / p95, joints | local changes: surface mean / p95, joints |")
    print("|---|---|---|")
    for numbers in NUMBERS:
        cells, by_joint = [], []
        for someone in new:
            off = someone.vertices[:, seen] - skin[seen]
            few = modes[:numbers, seen]
            b = fitted((off * root).reshape(count, -1), (few * root).reshape(numbers, -1))
            errors = np.linalg.norm(off - np.tensordot(b, few, 1), axis=2)
            joint_errors = np.linalg.norm(someone.joints - joints - np.tensordot(b, joint_modes[:numbers], 1), axis=2)
            cells.append("{:.1f} / {:.1f}, {:.1f}".format(*row(errors, joint_errors[:, 1:], area[seen])))
            index = [list(crowd.SEGMENTS).index("left_" + s) for s in JOINTS.values()]
            by_joint.append(joint_errors[:, index].mean(0) * 1e3)
        print(f"| {numbers} | {cells[0]} | {cells[1]} |")
        if numbers == 16:
            sixteen = " ".join(f"{j} {a:.1f}/{b:.1f}" for j, a, b in zip(JOINTS, *by_joint, strict=True))
    print(f"\nJoints with 16 numbers, phenotypes / local changes, mm: {sixteen}\n")


def rotation(vector: np.ndarray) -> np.ndarray:
    """Rotation matrices (..., 3, 3) of rotation vectors."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(vector.reshape(-1, 3)).as_matrix().reshape(*vector.shape[:-1], 3, 3)


class Fit:
    """A posed family body fitted to the true skin of one frame: every segment turns freely."""

    def __init__(self, skin, modes, joints, joint_modes, weights):
        self.skin, self.modes, self.joints, self.joint_modes, self.weights = skin, modes, joints, joint_modes, weights
        self.parents = crowd.segment_parents()

    def place(self, root, turns, b):
        """Skin (V, 3) and joint centres (S, 3) in the world."""
        skin, joints = self.skin + np.tensordot(b, self.modes, 1), self.joints + np.tensordot(b, self.joint_modes, 1)
        turned, at = np.empty_like(turns), np.empty_like(joints)
        for k, parent in enumerate(self.parents):
            turned[k] = turns[k] if parent < 0 else turned[parent] @ turns[k]
            at[k] = root if parent < 0 else at[parent] + turned[parent] @ (joints[k] - joints[parent])
        shift = at - np.einsum("kij,kj->ki", turned, joints)
        blended = np.einsum("vk,kij->vij", self.weights, turned)
        return np.einsum("vij,vj->vi", blended, skin) + self.weights @ shift, at

    def solve(self, truth: np.ndarray, rounds: int = 40):
        """Root, turns and numbers by Gauss-Newton with differences; a weak prior on turns and numbers."""
        count, numbers = len(self.joints), len(self.modes)
        source, target = self.skin - self.skin.mean(0), truth - truth.mean(0)
        u, _, vt = np.linalg.svd(source.T @ target)
        turns = np.tile(np.eye(3), (count, 1, 1))
        turns[0] = vt.T @ np.diag([1, 1, np.linalg.det(vt.T @ u.T)]) @ u.T
        root, b = truth.mean(0) - turns[0] @ self.skin.mean(0), np.zeros(numbers)
        size = 3 + 3 * count + numbers
        for turn in range(rounds):
            now, at = self.place(root, turns, b)
            jacobian = np.empty((truth.size, size))
            for column in range(size):
                step = np.zeros(size)
                step[column] = 1e-5
                moved, _ = self.place(root + step[:3], turns @ rotation(step[3 : 3 + 3 * count].reshape(count, 3)),
                                      b + step[3 + 3 * count :])  # fmt: skip
                jacobian[:, column] = (moved - now).ravel() / 1e-5
            damping = np.concatenate([np.zeros(6), np.full(3 * count - 3, 1e-2), np.full(numbers, 1e-4)])
            if turn < 8:  # pose first
                jacobian[:, 3 + 3 * count :] = 0
            step = np.linalg.solve(jacobian.T @ jacobian + np.diag(damping + 1e-9), jacobian.T @ (truth - now).ravel()
                                   - np.concatenate([np.zeros(3 + 3 * count), 1e-4 * b]))  # fmt: skip
            limit = np.clip(step[3 : 3 + 3 * count], -0.5, 0.5).reshape(count, 3)
            root, turns, b = root + step[:3], turns @ rotation(limit), b + step[3 + 3 * count :]
        now, at = self.place(root, turns, b)
        return now, at, b


def beyond(family_like, numbers: int, endings: tuple[str, ...]):
    """Modes of skin and joints: the family's first ones, and those of `departures` whose names end so."""
    from marey.body.people.departures import departure_modes

    more = departure_modes(family_like).keep(*endings).standardised()
    keep = len(more) if endings else 0
    skin = np.concatenate([family_like.vertices_modes[:numbers], more.vertices[:keep]])
    return skin, np.concatenate([family_like.joints_modes[:numbers], more.joints[:keep]])


def subsampled(learned: crowd.People, seen: np.ndarray, pick: np.ndarray):
    """The family on some of anny's own vertices as marey's record; its faces mean nothing."""
    from marey.body.people.family import load_family

    skin, modes, joints, joint_modes, _ = components(learned, np.ones(len(seen)), seen, 16)
    weights, segments = four_weights(learned.weights[pick])
    return replace(
        load_family("coarse"),
        vertices_mean=skin[pick],
        vertices_modes=modes[:, pick],
        joints_mean=joints,
        joints_modes=joint_modes,
        vertex_segments=segments.astype(np.int64),
        vertex_weights=weights / 255,
        faces=np.arange(len(pick) // 3 * 3).reshape(-1, 3),
    )


def rendered(model, learned: crowd.People, folder: Path, takes: list[str], frames: list[int], spaces) -> None:
    """Print how far the joints lie from the truth when the skin is fitted to the true skin."""
    seen = learned.used & ~hidden_vertices(model)
    names = list(crowd.SEGMENTS)
    print(
        "| take, frame | shape numbers | skin | joints | hip | knee | ankle | shoulder | elbow | wrist | neck | head |"
        " largest b |"
    )
    print("|" + "---|" * 13)
    for take in takes:
        truth = np.load(folder / take / "truth" / "truth.npz")
        every = np.arange(0, len(seen), int(truth["vertex_step"]))
        use = np.flatnonzero(seen[every])[::2]
        family = subsampled(learned, seen, every[use])
        given = list(truth["joint_names"])
        for frame, (numbers, endings) in itertools.product(frames, spaces):
            modes, joint_modes = beyond(family, numbers, endings)
            fit = Fit(family.vertices_mean, modes, family.joints_mean, joint_modes, learned.weights[every[use]])
            skin = truth["vertices"][frame][use].astype(float)
            now, at, b = fit.solve(skin)
            cells, everything = [], []
            for joint, segment in [*JOINTS.items(), ("neck", "neck"), ("head", "head")]:
                pairs = [(f"{s[0]}_{joint}", f"{s}_{segment}") for s in ("left", "right")]
                pairs = [(joint, segment)] if segment in names else pairs
                away = [at[names.index(k)] - truth["joints"][frame][given.index(j)] for j, k in pairs]
                everything += [np.linalg.norm(a) * 1e3 for a in away]
                cells.append(f"{np.mean(everything[-len(pairs) :]):.1f}")
            off = np.linalg.norm(now - skin, axis=1).mean() * 1e3
            cells = [f"{off:.1f}", f"{np.mean(everything):.1f}", *cells, f"{np.abs(b).max():.1f}"]
            what = " + ".join([str(numbers), *(f"{e[1:]}s" for e in endings)])
            print(f"| {take} {frame} | {what} | {' | '.join(cells)} |", flush=True)


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=60, help="people left out, of each kind")
    parser.add_argument("--takes", type=Path, help="folder of rendered takes with their truth")
    arguments = parser.parse_args()
    model = crowd.load_model()
    learned = crowd.sample(model, np.random.default_rng(1), 800)
    left_out(model, learned, arguments.count)
    if arguments.takes:
        rendered(model, learned, arguments.takes, ["walk", "reach", "jacks", "stealth"], [20, 70], [(16, ())])
        spaces = [(8, ()), (8, ("_length",)), (8, ("_length", "_girth")), (16, ("_length",))]
        rendered(model, learned, arguments.takes, ["stealth", "reach"], [20], spaces)


if __name__ == "__main__":
    main()
