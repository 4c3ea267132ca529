"""Named sizes of a body (stature, lengths, girths), bodies of given sizes, and published sizes."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Floats, Integers
from marey.body.articulation.surface import ShapeSpace
from marey.body.people.family import BodyFamily, distal_ends
from marey.errors import SettingProblem

LENGTHS = {
    "upperarm_length": ("upperarm", "forearm"), "forearm_length": ("forearm", "hand"),
    "thigh_length": ("thigh", "shank"), "shank_length": ("shank", "foot"), "clavicle_length": ("clavicle", "upperarm"),
    "neck_length": ("neck", "head"), "thorax_length": ("thorax", "neck"), "abdomen_length": ("abdomen", "thorax"),
}  # fmt: skip
"""Lengths between the joint centres of two segments."""
WIDTHS = {"hip_width": "thigh", "shoulder_width": "upperarm"}
"""Widths between the joint centres of both sides."""
HEIGHTS = {"shoulder_height": "upperarm", "hip_height": "thigh", "knee_height": "shank", "ankle_height": "foot"}
"""Heights of a joint centre above the sole, upright."""
GIRTHS = {
    "head_girth": ("head", 0.65), "neck_girth": ("neck", 0.5), "chest_girth": ("abdomen", 0.85),
    "waist_girth": ("abdomen", 0.3), "hip_girth": ("pelvis", -0.6), "upperarm_girth": ("upperarm", 0.55),
    "forearm_girth": ("forearm", 0.2), "wrist_girth": ("forearm", 0.97), "thigh_girth": ("thigh", 0.3),
    "knee_girth": ("shank", 0.0), "calf_girth": ("shank", 0.3), "ankle_girth": ("shank", 0.9),
}  # fmt: skip
"""Girths around a segment, at this share of the way from its joint centre to its distal end."""
KALMAN_ITERATIONS = 8
"""Iterations of the extended Kalman update in `condition`. Chosen by hand."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Measure:
    """One size: the summed length of straight pieces between points, divided by the number of sides measured.

    Points are indexed through the skin's vertices and, after them, the joint centres; each lies at a share of the way
    from its first to its second.

    Attributes:
        first, second: (n,) indices of vertices or joint centres.
        share: (n,) share of the way.
        pieces: (m, 2) the points that each piece joins.
        sides: Number of sides to which the pieces belong; the size is their mean.
        upright: Whether only the height between the points counts.
    """

    first: Integers
    second: Integers
    share: Floats
    pieces: Integers
    sides: int
    upright: bool = False

    def points(self, everything: Floats) -> Floats:
        """Return the points (..., n, 3) from vertices and joint centres (..., V + S, 3), or from their modes."""
        start, end = everything[..., self.first, :], everything[..., self.second, :]
        return start + self.share[:, None] * (end - start)

    def value(self, everything: Floats) -> float:
        """Return the size [m]."""
        along = np.diff(self.points(everything)[self.pieces], axis=1)[:, 0]
        return float(np.sum(np.abs(along[:, 2]) if self.upright else np.linalg.norm(along, axis=1)) / self.sides)

    def derivative(self, everything: Floats, modes: Floats) -> Floats:
        """Return the derivatives (M,) of the size by the numbers, for modes (M, V + S, 3)."""
        along = np.diff(self.points(everything)[self.pieces], axis=1)[:, 0]
        unit = np.sign(along) * [0, 0, 1] if self.upright else along / np.linalg.norm(along, axis=1, keepdims=True)
        change = np.diff(self.points(modes)[:, self.pieces], axis=2)[:, :, 0]
        return np.asarray(np.einsum("mpa,pa->m", change, unit) / self.sides)


def sides(family: BodyFamily, plain: str) -> list[int]:
    """Return the indices of the segments with a plain name: one of the trunk, left and right of a limb."""
    names = [plain] if plain in family.segment_names else [f"left_{plain}", f"right_{plain}"]
    return [family.segment(name) for name in names]


def measures(family: BodyFamily) -> dict[str, Measure]:
    """Return every size of a body of the family, by name: stature, lengths, widths, heights, girths."""
    joint = len(family.vertices_mean)
    highest, lowest = int(family.vertices_mean[:, 2].argmax()), int(family.vertices_mean[:, 2].argmin())
    known = {"stature": _between([(highest, lowest)], 1, upright=True)}
    for name, (start, end) in LENGTHS.items():
        pairs = list(zip(sides(family, start), sides(family, end), strict=True))
        known[name] = _between([(joint + a, joint + b) for a, b in pairs], len(pairs))
    for name, plain in WIDTHS.items():
        left, right = sides(family, plain)
        known[name] = _between([(joint + left, joint + right)], 1)
    for name, plain in HEIGHTS.items():
        known[name] = _between([(joint + side, lowest) for side in sides(family, plain)], 2, upright=True)
    for name, (plain, share) in GIRTHS.items():
        known[name] = _tape(family, sides(family, plain), share)
    return known


def _between(pairs: list[tuple[int, int]], side_count: int, upright: bool = False) -> Measure:
    """Return a size of straight pieces between vertices or joint centres."""
    points = np.array(pairs).ravel()
    pieces = np.arange(len(points)).reshape(-1, 2)
    return Measure(
        first=points, second=points, share=np.zeros(len(points)), pieces=pieces, sides=side_count, upright=upright
    )


def _tape(family: BodyFamily, segments: list[int], share: float) -> Measure:
    """Return the girth of one or two segments at a share of their length; it moves with the skin's points."""
    ends = distal_ends(family)
    edges: list[Integers] = []
    shares: list[Floats] = []
    pieces: list[Integers] = []
    for segment in segments:
        start, along = family.joints_mean[segment], ends[segment] - family.joints_mean[segment]
        edge, part = _ring(family, start + share * along, along / np.linalg.norm(along))
        count = sum(map(len, edges))
        ring = count + np.arange(len(edge))
        edges.append(edge)
        shares.append(part)
        pieces.append(np.stack([ring, np.roll(ring, -1)], axis=1))
    every = np.concatenate(edges)
    return Measure(
        first=every[:, 0],
        second=every[:, 1],
        share=np.concatenate(shares),
        pieces=np.concatenate(pieces),
        sides=len(segments),
    )


def _ring(family: BodyFamily, point: Floats, normal: Floats) -> tuple[Integers, Floats]:
    """Intersect the mean skin with a plane, and return the convex corners of the loop nearest to a point, in order.

    Returns:
        edges (n, 2) of vertices and the share (n,) of the way along each.
    """
    height = (family.vertices_mean - point) @ normal
    height[np.abs(height) < 1e-9] = 1e-9  # no vertex lies in the plane itself
    loops = _loops(family.faces, height > 0)
    best: tuple[float, Integers, Floats, np.ndarray] | None = None
    for edges in loops:
        share = height[edges[:, 0]] / (height[edges[:, 0]] - height[edges[:, 1]])
        start, end = family.vertices_mean[edges[:, 0]], family.vertices_mean[edges[:, 1]]
        corners = np.asarray(start + share[:, None] * (end - start), float)
        away = float(np.linalg.norm(corners.mean(0) - point))
        if best is None or away < best[0]:
            best = (away, edges, share, corners)
    assert best is not None, "the plane of a girth misses the body"
    _, ring, shares, tape = best
    across = np.asarray(np.linalg.svd(normal[None])[2][1:])
    taut = _hull((tape - tape.mean(0)) @ across.T)
    return ring[taut], shares[taut]


def _loops(faces: Integers, above: np.ndarray) -> list[Integers]:
    """Return closed loops of cut edges (n, 2), each edge from below to above."""
    follows: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for face in faces[above[faces].any(1) & ~above[faces].all(1)]:
        cut = [tuple(sorted((int(a), int(b)), key=lambda v: bool(above[v])))
               for a, b in zip(face, np.roll(face, -1), strict=True) if above[a] != above[b]]  # fmt: skip
        for one, other in (cut, cut[::-1]):
            follows.setdefault((one[0], one[1]), []).append((other[0], other[1]))
    loops = []
    while follows:
        loop = [next(iter(follows))]
        while ahead := [edge for edge in follows.pop(loop[-1]) if edge in follows]:
            loop.append(ahead[0])
        loops.append(np.array(loop))
    return loops


def _hull(points: Floats) -> Integers:
    """Return the indices of the convex hull's corners of points (n, 2) in the plane, in order around it."""
    order = np.lexsort(points.T)
    chains = []
    for walk in (order, order[::-1]):
        chain: list[int] = []
        for index in walk:
            while len(chain) > 1 and _turns_right(points[chain[-2]], points[chain[-1]], points[index]):
                chain.pop()
            chain.append(int(index))
        chains += chain[:-1]
    return np.array(chains)


def _turns_right(a: Floats, b: Floats, c: Floats) -> bool:
    """Return whether the path from a over b to c turns right, or not at all."""
    return bool((b[0] - a[0]) * (c[1] - b[1]) - (b[1] - a[1]) * (c[0] - b[0]) <= 0)


def sizes(known: Mapping[str, Measure], vertices: Floats, joints: Floats) -> dict[str, float]:
    """Return all sizes of a body at rest by name [m].

    Args:
        known: Result of `measures`, of the same level.
        vertices: (V, 3) skin in the rest posture.
        joints: (S, 3) joint centres in the rest posture.
    """
    everything = np.concatenate([vertices, joints])
    return {name: measure.value(everything) for name, measure in known.items()}


def condition(space: ShapeSpace, known: Mapping[str, Measure], given: Mapping[str, tuple[float, float]]) -> ShapeSpace:
    """Condition the prior of a shape space on known sizes.

    The numbers' prior is conditioned by the iterated extended Kalman update; for sizes linear in the numbers, such as
    the stature, that is exact.

    Args:
        space: Space with the prior of an unknown person.
        known: Result of `measures`.
        given: Size and its standard deviation [m] by name.

    Raises:
        SettingProblem: A size has an unknown name, or a value or deviation that is not positive.
    """
    for name, (value, sd) in given.items():
        if name not in known:
            raise SettingProblem(f"There is no size '{name}'. Known sizes are {', '.join(known)}.")
        if not (np.isfinite(value) and value > 0 and sd > 0):
            raise SettingProblem(
                f"The size '{name}' is {value} m with a standard deviation of {sd} m. Both must be positive."
            )
    if not given:
        return space
    modes = np.concatenate([space.vertex_modes, space.joint_modes], axis=1)
    wanted = np.array([value for value, _ in given.values()])
    noise = np.diag([sd**2 for _, sd in given.values()])
    mean, covariance = space.prior_mean, space.prior_covariance
    numbers = np.array(mean)
    for _ in range(KALMAN_ITERATIONS):
        everything = np.concatenate([space.vertices(numbers), space.joints(numbers)])
        now = np.array([known[name].value(everything) for name in given])
        slope = np.stack([known[name].derivative(everything, modes) for name in given])
        gain = np.linalg.solve(slope @ covariance @ slope.T + noise, slope @ covariance).T
        numbers = mean + gain @ (wanted - now - slope @ (mean - numbers))
    remaining = covariance - gain @ slope @ covariance
    return replace(space, prior_mean=numbers, prior_covariance=(remaining + remaining.T) / 2)


@dataclass(frozen=True, kw_only=True)
class Published:
    """A published size of adults.

    Attributes:
        share: Share of the stature.
        error: Error of that share: the stated one, or LANDMARKS or half the difference between men and women, whichever
            is larger.
        source: Key in docs/references.bib.
    """

    share: float
    error: float
    source: str


LANDMARKS = 0.01
"""Distance of landmarks on the skin from the joints they represent, as a share of the stature. Chosen by hand."""


SPINE_UP_SHARE, SPINE_UP_M = 0.078, 0.009
"""Height of the anterior superior iliac spine above the centre of the hip: a share of the leg length, and a constant
[m] ([Hara2016])."""


def _both_sexes(men_mm: float, women_mm: float) -> tuple[float, float]:
    """Return the share of the stature, mean of the sexes, and its error ([deLeva1996]: statures 1741 and 1735 mm)."""
    men, women = men_mm / 1741, women_mm / 1735
    return (men + women) / 2, max(LANDMARKS, abs(men - women) / 2)


def published(measured: Mapping[str, float]) -> dict[str, Published]:
    """Return published sizes between joint centres for a body, by name.

    Lengths between joint centres are those of [deLeva1996], table 4 (its shank ends at the lateral malleolus); heights
    are those of [Winter2009], figure 4.1, after Drillis and Contini. The distance of the hips is twice the lateral
    offset of [Hara2016], 8 + 0.086 leg length mm, with its error of 4.4 mm per side.

    Args:
        measured: Sizes of the body from `sizes`; the regression of the hips requires its leg.
    """
    expected = {}
    for name, men, women in (
        ("upperarm_length", 281.7, 275.1),
        ("forearm_length", 268.9, 264.3),
        ("thigh_length", 422.2, 368.5),
        ("shank_length", 434.0, 432.3),
    ):
        share, error = _both_sexes(men, women)
        expected[name] = Published(share=share, error=error, source="deLeva1996")
    for name, share in (("hip_height", 0.530), ("knee_height", 0.285), ("ankle_height", 0.039)):
        expected[name] = Published(share=share, error=LANDMARKS, source="Winter2009")
    expected["shoulder_height"] = Published(share=0.818, error=LANDMARKS, source="Winter2009")
    stature = measured["stature"]
    half = 0.008 + 0.086 * leg_length(measured)
    expected["hip_width"] = Published(share=2 * half / stature, error=2 * 0.0044 / stature, source="Hara2016")
    return expected


def leg_length(measured: Mapping[str, float]) -> float:
    """Return the leg length from the anterior superior iliac spine to the ankle [m], which the skin does not show.

    The spine lies 9 mm and 0.078 of this length above the hip's centre ([Hara2016]), which determines the length.
    """
    return (measured["hip_height"] - measured["ankle_height"] + SPINE_UP_M) / (1 - SPINE_UP_SHARE)
