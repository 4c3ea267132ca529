"""Fit the generic metaballs of both levels to the skin of the mean body, draw them, and write metaballs.npz.

Development only: PYTHONPATH=src python bodies/fit_metaballs.py [--out FILE]. Check the drawing beside the file before
replacing the one that is shipped.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from draw import VIEWS, draw
from scipy.cluster.vq import kmeans2
from scipy.spatial import cKDTree

from marey.body.articulation.surface import Body, ShapeSpace
from marey.body.metaballs.metaball_person import vertex_limbs
from marey.body.metaballs.metaballs import ANY_LIMB, Metaballs
from marey.body.people.family import distal_ends, load_family
from marey.body.people.person import family_body

OUT = Path(__file__).parents[1] / "src" / "marey" / "body" / "metaballs.npz"

SIMPLE = {"pelvis": 2, "abdomen": 3, "thorax": 2, "neck": 1, "head": 3, "clavicle": 1, "hand": 3, "foot": 3, "toes": 1}
SIMPLE |= {"upperarm": 3, "forearm": 3, "thigh": 3, "shank": 3}
FULL = {"pelvis": 3, "abdomen": 6, "thorax": 3, "neck": 2, "head": 5, "clavicle": 2, "hand": 9, "foot": 6, "toes": 3}
FULL |= {"upperarm": 6, "forearm": 5, "thigh": 7, "shank": 7}
LEVELS = {"simple": SIMPLE, "full": FULL}
"""Number of balls of each segment, by detail; on the trunk, number of pairs. Chosen by hand."""

FILLED = 0.007
"""Edge of the cells that fill the body, among which the balls are placed [m]."""
SKIN_SD, CENTRE_SD, SIZE_SD = 0.002, 0.4, 0.4
"""Standard deviations of the skin [m], of a ball's position from its start (in mean initial radii), and of its
size from its start (relative)."""
CELL, SHELLS, CLEAR, KEPT, SPACE_SD = 0.025, (-0.012, 0.012, 0.03), 0.011, 0.2, 0.005
"""Step of a grid and offsets of shells about the skin [m]; their points farther from the skin than the third value [m]
must have at least the fourth value's share of their distance, on their side, with the last value as the standard
deviation [m]. The skin's points alone do not constrain thin discs that protrude between them."""
INSIDE_SD = 0.001
"""Standard deviation of a ball's centre outside the skin [m]. Far from the skin's points, and deep inside, where
distances are bounded (`metaball_field.CORE`), nothing else constrains a ball whose size and position
compensate each other."""
DEEPEST = 0.15
"""Upper limit of a point's depth in the body [m]."""
THINNEST = 0.008
"""Smallest radius [m]: points on the edge of a thinner disc do not converge to the surface."""
ITERATIONS, LONGEST, GROWTH = 80, 0.004, 0.15
"""Number of steps, and limits of a ball's motion [m] and growth (logarithm) per step: a ball that leaves the body does
not return."""


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
    away, face = cKDTree(body.vertices[body.faces].mean(1)).query(points)
    inside = np.zeros(len(points), bool)
    inside[away < DEEPEST] = surrounded(body, points[away < DEEPEST])
    return np.where(inside, -away, away), face


def surrounded(body: Body, points: np.ndarray) -> np.ndarray:
    """Whether points lie within the skin: a line straight up leaves it once more than it enters.

    The normal of the nearest face is unsuitable: between toes and fingers, and beyond their tips, it may point away.
    """
    columns, column = np.unique(points[:, :2] + [1.1e-7, 1.7e-7], axis=0, return_inverse=True)
    a, b, c = body.vertices[body.faces].transpose(1, 0, 2)
    along, beside = b - a, c - a
    size = along[:, 0] * beside[:, 1] - along[:, 1] * beside[:, 0]
    a, along, beside, size = (part[np.abs(size) > 1e-12] for part in (a, along, beside, size))
    order = np.argsort(column, kind="stable")
    first = np.searchsorted(column[order], np.arange(len(columns) + 1))
    odd = np.zeros(len(points), bool)
    for i, (x, y) in enumerate(columns):
        dx, dy = x - a[:, 0], y - a[:, 1]
        s, t = (dx * beside[:, 1] - dy * beside[:, 0]) / size, (dy * along[:, 0] - dx * along[:, 1]) / size
        hit = (s >= 0.0) & (t >= 0.0) & (s + t <= 1.0)
        height = a[hit, 2] + s[hit] * along[hit, 2] + t[hit] * beside[hit, 2]
        own = order[first[i] : first[i + 1]]
        odd[own] = np.sum(height > points[own, 2, None], axis=1) % 2 == 1
    return odd


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
    """Move the centres and scale the radii of both halves by a step (6 M / 2,), no ball farther than `LONGEST`."""
    moved, grown = step.reshape(2, len(balls) // 2, 3)
    moved = moved * np.minimum(1.0, LONGEST / np.maximum(np.linalg.norm(moved, axis=1), 1e-9))[:, None]
    return replace(
        balls,
        centre=balls.centre + np.concatenate([moved, moved * [-1, 1, 1]]),
        radii=np.maximum(balls.radii * np.exp(np.clip(np.concatenate([grown, grown]), -GROWTH, GROWTH)), THINNEST),
    )


class Fit:
    """Fit of balls to the mean skin, with constraints beside the skin and a prior at the initial balls."""

    def __init__(self, first: Metaballs, body: Body):
        self.first = first
        self.points, area, self.limb = samples(body)
        self.share = area / area.mean()
        self.grid, self.off = surroundings(body)
        self.body, self.centres = body, body.vertices[body.faces].mean(1)
        half = len(first) // 2
        near = CENTRE_SD * np.repeat(first.radii[:half].mean(1), 3)
        self.prior = np.concatenate([near**-2.0, np.full(3 * half, SIZE_SD**-2.0)])

    def from_start(self, balls: Metaballs) -> np.ndarray:
        """How far centres [m] and radii (relative) are from where they started: (6 M / 2,)."""
        first, half = self.first, len(balls) // 2
        moved, grown = balls.centre - first.centre, np.log(balls.radii / first.radii)
        return np.concatenate([moved[:half].ravel(), grown[:half].ravel()])

    def trespass(self, distance: np.ndarray, off: np.ndarray) -> np.ndarray:
        """By how much the distance of grid points is too small on their side [m]."""
        return np.minimum(distance * np.sign(off) - KEPT * np.abs(off), 0.0) * np.sign(off)

    def strayed(self, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How far balls (M, 3) of the left half lie outside the skin, zero inside, and the direction to there."""
        half = place[: len(place) // 2]
        off, face = outside(self.body, half)
        way = (half - self.centres[face]) / np.maximum(np.abs(off), 1e-9)[:, None]
        return np.maximum(off, 0.0), way

    def cost(self, balls: Metaballs) -> float:
        """Half the sum of squares."""
        posed = balls.at_rest()
        stray = self.strayed(posed.place)[0] / INSIDE_SD
        skin = posed.distance(self.points, self.limb) / SKIN_SD
        space = self.trespass(posed.distance(self.grid), self.off) / SPACE_SD
        prior = self.prior @ self.from_start(balls) ** 2
        return 0.5 * float(self.share @ skin**2 + np.sum(space**2) + np.sum(stray**2) + prior)

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
        gradient = jacobian.T @ (weight * residual) + self.prior * self.from_start(balls)
        off, way = self.strayed(posed.place)
        for m in np.flatnonzero(off):
            own = slice(3 * m, 3 * m + 3)
            normal[own, own] += np.outer(way[m], way[m]) / INSIDE_SD**2
            gradient[own] += off[m] * way[m] / INSIDE_SD**2
        return normal, gradient

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


def drawn(fitted: dict[str, Metaballs], body: Body, path: Path) -> None:
    """Draw the skin over each detail's balls from three sides, and print the number of folded faces."""
    import matplotlib.pyplot as plt

    palette = np.array(plt.get_cmap("tab20").colors)
    figure, axes = plt.subplots(len(fitted), 3, figsize=(15, 9 * len(fitted)))
    for row, (level, balls) in zip(axes, fitted.items(), strict=True):
        vertices = balls.at_rest().onto_surface(body.vertices, vertex_limbs(body))
        turned = np.einsum("ta,ta->t", normals(replace(body, space=moved_to(body, vertices))), normals(body)) < 0.0
        names = np.array(body.skeleton.segment_names)[body.face_segment[turned]]
        print(f"{level}: folded faces {dict(zip(*np.unique(names, return_counts=True), strict=True))}")
        for place, view in zip(row, VIEWS, strict=True):
            draw(place, vertices, body.faces, palette[body.face_segment % 20], view)
    figure.subplots_adjust(0, 0, 1, 1, 0, 0)
    figure.savefig(path, dpi=60)


def moved_to(body: Body, vertices: np.ndarray) -> ShapeSpace:
    """The shapes of a body whose mean skin is another."""
    return replace(body.space, vertex_mean=vertices - np.tensordot(body.numbers, body.space.vertex_modes, 1))


def report_fit(level: str, balls: Metaballs, body: Body) -> None:
    """Print how well balls fit, overall and by segment."""
    points, area, limb = samples(body)
    owner = body.face_segment[body.vertices[body.faces].mean(1)[:, 0] > 0.0]
    off = balls.at_rest().distance(points, limb)
    rms = np.sqrt(np.average(off**2, weights=area))
    most = np.quantile(np.abs(off), 0.95)
    print(f"{level}: {len(balls)} balls, {1e3 * rms:.1f} mm RMS, 95 % within {1e3 * most:.1f} mm")
    for k, name in enumerate(body.skeleton.segment_names):
        own = owner == k
        if own.any():
            print(f"  {name}: {1e3 * np.sqrt(np.average(off[own] ** 2, weights=area[own])):.1f}")


def main() -> None:
    """Fit both levels, print the residuals, draw them, and write the file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=OUT, help="NPZ; the drawing gets its name")
    path = parser.parse_args().out
    family, body = load_family("fine"), family_body("fine")
    ends = distal_ends(family)
    bones = {name: ends[i] - family.joints_mean[i] for i, name in enumerate(family.segment_names)}
    arrays, fitted = {"segment_names": np.array(body.skeleton.segment_names)}, {}
    for level, counts in LEVELS.items():
        balls = fitted[level] = Fit(start(body, bones, counts), body).run()
        report_fit(level, balls, body)
        arrays |= {f"{level}_{name}": getattr(balls, name) for name in ("segment", "centre", "rotation", "radii")}
    np.savez_compressed(path, **arrays)
    drawn(fitted, body, Path(path.stem + ".png") if path == OUT else path.with_suffix(".png"))


if __name__ == "__main__":
    main()
