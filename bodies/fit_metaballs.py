"""Fits the generic metaballs of both levels to the skin of the mean body, and writes src/marey/body/metaballs.npz.

Development only: PYTHONPATH=src python bodies/fit_metaballs.py
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.cluster.vq import kmeans2
from scipy.spatial import cKDTree

from marey.body.family import distal_ends, load_family
from marey.body.metaballs import ANY_LIMB, Metaballs
from marey.body.person import family_body
from marey.body.surface import Body

OUT = Path(__file__).parents[1] / "src" / "marey" / "body" / "metaballs.npz"

# How many balls a segment has; on the trunk as many pairs.
SIMPLE = {"pelvis": 2, "abdomen": 3, "thorax": 2, "neck": 1, "head": 3, "clavicle": 1, "hand": 2, "foot": 3, "toes": 1}
SIMPLE |= {"upperarm": 3, "forearm": 3, "thigh": 3, "shank": 3}
FULL = {"pelvis": 3, "abdomen": 6, "thorax": 3, "neck": 2, "head": 4, "clavicle": 2, "hand": 6, "foot": 5, "toes": 2}
FULL |= {"upperarm": 6, "forearm": 5, "thigh": 7, "shank": 7}
LEVELS = {"simple": SIMPLE, "full": FULL}

FILLED = 0.007
"""Edge of the cells that fill the body, among which the balls are placed [m]."""
SKIN_SD, CENTRE_SD, SIZE_SD = 0.002, 0.015, 0.15
"""What pulls: the skin [m], the place where a ball started [m], its start size (relative)."""
CELL, SHELLS, CLEAR, KEPT, SPACE_SD = 0.025, (-0.012, 0.012, 0.03), 0.011, 0.2, 0.005
"""Points of a grid [m], and of shells about the skin [m], that lie this far off the skin [m] must read at least this
share of their distance, on their side [m].
The skin's points alone do not see thin discs that stand out between them."""
ITERATIONS = 40


def bone_frame(bone: np.ndarray) -> np.ndarray:
    """Axes (3, 3) in columns: across the bone about towards X and Y (Z where the bone itself runs so), and along it."""
    along = bone / np.linalg.norm(bone)
    depth = np.array([0.0, 0.0, 1.0] if abs(along[1]) > 0.7 else [0.0, 1.0, 0.0])
    depth -= (depth @ along) * along
    depth /= np.linalg.norm(depth)
    return np.stack([np.cross(depth, along), depth, along], 1)


def filled(body: Body) -> tuple[np.ndarray, np.ndarray]:
    """Cells of the body's left half, and the segment whose skin is nearest to each."""
    low, high = body.vertices.min(0), body.vertices.max(0)
    low[0] = FILLED / 2
    ranges = [np.arange(a, b, FILLED) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*ranges, indexing="ij"), -1).reshape(-1, 3)
    off, face = outside(body, grid)
    return grid[off < 0.0], body.face_segment[face][off < 0.0]


def outside(body: Body, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How far points lie outside the skin, by the nearest face's centre, and that face."""
    centres = body.vertices[body.faces].mean(1)
    away, face = cKDTree(centres).query(points)
    return away * np.sign(np.einsum("na,na->n", points - centres[face], normals(body)[face])), face


def normals(body: Body) -> np.ndarray:
    """Unit normals (T, 3) of the faces, outwards."""
    corners = body.vertices[body.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


def start(body: Body, bones: dict[str, np.ndarray], counts: dict[str, int]) -> Metaballs:
    """Place balls where clusters of cells lie, of the clusters' size: those of the left half, then the mirror image."""
    cells, owner = filled(body)
    segment, centre, rotation, radii = [], [], [], []
    for plain, count in counts.items():
        name = plain if plain in body.skeleton.segment_names else f"left_{plain}"
        k = body.skeleton.segment(name)
        axes = bone_frame(bones[name])
        own = (cells[owner == k] - body.joint_centres[k]) @ axes
        places, cluster = kmeans2(own, count, minit="++", seed=1, iter=50)
        for i, place in enumerate(places):
            segment.append(k)
            centre.append(axes @ place)
            rotation.append(axes)
            # Of a full ellipsoid the spread is its half axis over sqrt 5; the field of one ball reaches 0.59 radii.
            radii.append(np.sqrt(5.0) / 0.59 * np.maximum(own[cluster == i].std(0), FILLED / 2))
    flip = np.diag([-1.0, 1.0, 1.0])
    twin = body.skeleton.mirrored()[0][segment]
    return Metaballs(
        skeleton=body.skeleton, joint_centres=body.joint_centres, segment=np.append(segment, twin),
        centre=np.concatenate([centre, np.array(centre) @ flip]),
        rotation=np.concatenate([rotation, flip @ np.array(rotation) @ flip]),
        radii=np.concatenate([radii, radii]), weight=np.ones(2 * len(segment)),
    )  # fmt: skip


def samples(body: Body) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centres of the faces of the skin's left half, their areas, and their limbs."""
    corners = body.vertices[body.faces]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    left = corners.mean(1)[:, 0] > 0.0
    return corners.mean(1)[left], area[left], body.face_limb[left]


def surroundings(body: Body) -> tuple[np.ndarray, np.ndarray]:
    """Points of the left half inside and outside the body, clear of its skin, and how far outside they lie."""
    low, high = body.vertices.min(0) - 0.15, body.vertices.max(0) + 0.15
    low[0] = 0.0
    ranges = [np.arange(a, b, CELL) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*ranges, indexing="ij"), -1).reshape(-1, 3)
    centres, unit = body.vertices[body.faces].mean(1), normals(body)
    points = np.concatenate([grid, *(centres + off * unit for off in SHELLS)])
    points = points[points[:, 0] >= 0.0]
    off = outside(body, points)[0]
    return points[np.abs(off) > CLEAR], off[np.abs(off) > CLEAR]


def changed(balls: Metaballs, step: np.ndarray) -> Metaballs:
    """Move the centres and scale the radii of both halves by a step (6 M / 2,)."""
    moved, grown = step.reshape(2, len(balls) // 2, 3)
    return replace(
        balls,
        centre=balls.centre + np.concatenate([moved, moved * [-1, 1, 1]]),
        radii=balls.radii * np.exp(np.clip(np.concatenate([grown, grown]), -0.5, 0.5)),
    )


class Fit:
    """Centres and radii of balls, on the mean skin, with nothing beside it and the balls near where they started."""

    def __init__(self, first: Metaballs, body: Body):
        self.first = first
        self.points, area, self.limb = samples(body)
        self.share = area / area.mean()
        self.grid, self.off = surroundings(body)
        self.prior = np.repeat([CENTRE_SD**-2.0, SIZE_SD**-2.0], 3 * (len(first) // 2))

    def from_start(self, balls: Metaballs) -> np.ndarray:
        """How far centres [m] and radii (relative) are from where they started: (6 M / 2,)."""
        first, half = self.first, len(balls) // 2
        moved, grown = balls.centre - first.centre, np.log(balls.radii / first.radii)
        return np.concatenate([moved[:half].ravel(), grown[:half].ravel()])

    def trespass(self, distance: np.ndarray, off: np.ndarray) -> np.ndarray:
        """By how much points of the grid read too little for their side [m]."""
        return np.minimum(distance * np.sign(off) - KEPT * np.abs(off), 0.0) * np.sign(off)

    def cost(self, balls: Metaballs) -> float:
        """Half the sum of squares."""
        posed = balls.at_rest()
        skin = posed.distance(self.points, self.limb) / SKIN_SD
        space = self.trespass(posed.distance(self.grid), self.off) / SPACE_SD
        return 0.5 * float(self.share @ skin**2 + np.sum(space**2) + self.prior @ self.from_start(balls) ** 2)

    def normal_equations(self, balls: Metaballs) -> tuple[np.ndarray, np.ndarray]:
        """Normal matrix and gradient by centres and logarithms of radii."""
        posed = balls.at_rest()
        beside = self.trespass(posed.distance(self.grid), self.off)
        near = beside != 0.0
        limb = np.concatenate([self.limb, np.full(near.sum(), ANY_LIMB)])
        of = posed.distances(np.concatenate([self.points, self.grid[near]]), limb)
        half, by_size = len(balls) // 2, of.by_radii * balls.radii
        by_place = of.by_centre[:, :half] + of.by_centre[:, half:] * [-1, 1, 1]
        jacobian = np.concatenate([by_place, by_size[:, :half] + by_size[:, half:]], 1).reshape(len(limb), -1)
        count = len(self.points)
        weight = np.concatenate([self.share / SKIN_SD**2, np.full(near.sum(), SPACE_SD**-2.0)])
        residual = np.concatenate([of.residual[:count], beside[near]])
        normal = jacobian.T @ (weight[:, None] * jacobian) + np.diag(self.prior)
        return normal, jacobian.T @ (weight * residual) + self.prior * self.from_start(balls)

    def run(self) -> Metaballs:
        """Minimise by Levenberg-Marquardt."""
        balls, damping, best = self.first, 1.0, self.cost(self.first)
        for _ in range(ITERATIONS):
            normal, gradient = self.normal_equations(balls)
            while damping < 1e8:
                trial = changed(balls, -np.linalg.solve(normal + damping * np.diag(self.prior), gradient))
                value = self.cost(trial)
                if value < best:
                    balls, best, damping = trial, value, damping * 0.3
                    break
                damping *= 4.0
        return balls


def main() -> None:
    """Fit both levels, say how well, and write the file."""
    family, body = load_family("fine"), family_body("fine")
    ends = distal_ends(family)
    bones = {name: ends[i] - family.joints_mean[i] for i, name in enumerate(family.segment_names)}
    arrays = {"segment_names": np.array(body.skeleton.segment_names)}
    points, area, limb = samples(body)
    owner = body.face_segment[body.vertices[body.faces].mean(1)[:, 0] > 0.0]
    for level, counts in LEVELS.items():
        balls = Fit(start(body, bones, counts), body).run()
        off = balls.at_rest().distance(points, limb)
        rms = np.sqrt(np.average(off**2, weights=area))
        most = np.quantile(np.abs(off), 0.95)
        print(f"{level}: {len(balls)} balls, {1e3 * rms:.1f} mm RMS, 95 % within {1e3 * most:.1f} mm")
        for k, name in enumerate(body.skeleton.segment_names):
            own = owner == k
            if own.any():
                print(f"  {name}: {1e3 * np.sqrt(np.average(off[own] ** 2, weights=area[own])):.1f}")
        arrays |= {f"{level}_{name}": getattr(balls, name) for name in ("segment", "centre", "rotation", "radii")}
    np.savez_compressed(OUT, **arrays)


if __name__ == "__main__":
    main()
