"""Skin over metaballs as B-spline patches, one per part of the body, tessellated and joined without seams."""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.body.articulation.surface import Body, ShapeSpace
from marey.body.metaballs.cross_sections import AROUND_LIMB, AROUND_TRUNK, OPENING_ROWS, OPENINGS, SIDES, Caster
from marey.body.metaballs.limb_sections import sample_arm, sample_leg, sample_seam
from marey.body.metaballs.metaball_person import metaball_body, required_metaballs
from marey.body.metaballs.metaballs import Metaballs, PosedMetaballs
from marey.body.metaballs.spline_patch import SplinePatch, chord_lengths, curve_at
from marey.body.metaballs.trunk_sections import TrunkSections, sample_head, sample_trunk

BELOW_OPENING = 5
"""Rows of the trunk below the openings for the arms [units]."""
ABOVE_OPENING = 1
"""Rows of the trunk above the openings for the arms [units]."""
HEAD_ROWS = 4
"""Rows of the head [units]."""
LIMB_ROWS = {"arm": 12, "leg": 16}
"""Rows of a limb [units]."""
FINENESS = 3
"""Columns and rows of the tessellation per unit."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SkinSamples:
    """Points on the metaballs' surface, in rows around each part of the body; each part begins where another ends."""

    trunk: Floats
    """(B, 12 s, 3) from the hips up to the neck, with s samples per unit; samples in the openings are not skin."""
    opening: tuple[int, int]
    """The first and last row of the openings."""
    head: Floats
    """(B, 12 s, 3) from the neck to the crown, where a row is one point."""
    seam: Floats
    """(2 s + 1, 3) between the legs, from front to back."""
    limbs: dict[str, Floats]
    """By limb: (B, 8 s, 3), from the trunk to the tip, where a row is one point."""


def sample_skin(posed: PosedMetaballs, samples: int = 4) -> SkinSamples:
    """Sample the implicit surface along cross-sections by ray casting ([Plaenkers1999] section 3.1).

    Rays start at a centre line in each part and end where they first leave the field of the trunk and their own limb. A
    hand is a mitten (`limb_sections._hand`).

    Args:
        posed: The metaballs at rest.
        samples: Samples per unit; there are 12 units around trunk and head, and 8 around a limb.

    Raises:
        MareyError: A part has a gap.
    """
    sections = TrunkSections(Caster(posed, samples))
    trunk, opening = sample_trunk(sections)
    seam = sample_seam(sections)
    limbs = {name: sample_arm(sections, name) for name in OPENINGS}
    limbs |= {f"{side}_leg": sample_leg(sections, f"{side}_leg", trunk[0], seam) for side in SIDES}
    return SkinSamples(trunk=trunk, opening=opening, head=sample_head(sections.caster), seam=seam, limbs=limbs)


@dataclass(frozen=True, eq=False, kw_only=True)
class Skin:
    """A closed triangle mesh, with the limb of each vertex."""

    vertices: Floats
    """(V, 3) [m]."""
    faces: Integers
    """(T, 3) corners counter-clockwise as seen from outside."""
    part: tuple[str, ...]
    """(V,) "trunk" or the limb."""


class _Mesh:
    """A mesh under construction."""

    def __init__(self) -> None:
        self.vertices: list[Floats] = []
        self.quadrangles: list[Integers] = []
        self.tips: list[Integers] = []
        self.part: list[str] = []

    def add(self, points: Floats, part: str) -> Integers:
        """Append points (..., 3), and return their indices (...)."""
        flat = np.asarray(points).reshape(-1, 3)
        first = len(self.part)
        self.vertices.append(flat)
        self.part += [part] * len(flat)
        return np.arange(first, first + len(flat)).reshape(np.shape(points)[:-1])

    def join(self, lower: Integers, upper: Integers, kept: Mask | None = None) -> None:
        """Add a quadrangle between each pair of columns (a,) of two closed rows; only where kept (a,), if given."""
        corners = np.stack([lower, np.roll(lower, -1), np.roll(upper, -1), upper], -1)
        self.quadrangles.append(corners if kept is None else corners[kept])

    def tube(self, rows: Integers, tip: Integers) -> None:
        """Join the rows (b, a) of a part, and close it by triangles to its tip."""
        for lower, upper in pairwise(rows):
            self.join(lower, upper)
        self.tips.append(np.stack([rows[-1], np.roll(rows[-1], -1), np.full(rows.shape[1], tip)], -1))

    def skin(self) -> Skin:
        """Split the quadrangles along their shorter diagonals, and remove unused vertices."""
        points, corners = np.concatenate(self.vertices), np.concatenate(self.quadrangles)
        first, second = (np.linalg.norm(points[corners[:, k]] - points[corners[:, k + 2]], axis=1) for k in (0, 1))
        turned = np.where((second < first)[:, None], np.roll(corners, -1, axis=1), corners)
        faces = np.concatenate([turned[:, [0, 1, 2]], turned[:, [0, 2, 3]], *self.tips])
        used, index = np.unique(faces, return_inverse=True)
        return Skin(
            vertices=points[used], faces=index.reshape(-1, 3), part=tuple(str(p) for p in np.array(self.part)[used])
        )


def tessellate(samples: SkinSamples, fineness: int = FINENESS) -> Skin:
    """Fit B-spline patches to samples, and join their tessellations to one closed mesh.

    Each patch is closed around the part and open along it; its first row consists of the vertices of the part from
    which it comes, so that there is no seam ([Plaenkers1999] section 3.1). For the same fineness, vertices correspond
    between people; quadrangles are split along the shorter diagonal.

    Args:
        samples: Result of `sample_skin`.
        fineness: Columns and rows per unit; a body has about 600 vertices times its square.
    """
    mesh = _Mesh()
    trunk = _trunk(mesh, samples, fineness)
    s = _samples_per_unit(samples.trunk, AROUND_TRUNK)
    _part(mesh, "trunk", samples.head, AROUND_TRUNK, trunk[-1], HEAD_ROWS * fineness)
    for arm in OPENINGS:
        _part(mesh, arm, samples.limbs[arm], AROUND_LIMB, _rim(trunk, arm, fineness), LIMB_ROWS["arm"] * fineness)
    at = np.linspace(0.0, 2.0, 2 * fineness + 1)[1:-1]
    inner = mesh.add(curve_at(np.arange(2 * s + 1) / s, samples.seam, at), "trunk")
    row, half = np.concatenate([trunk[0], trunk[0, :1]]), AROUND_TRUNK // 2 * fineness
    rims = {
        "left_leg": np.concatenate([row[half::-1], inner]),
        "right_leg": np.concatenate([row[: half - 1 : -1], inner[::-1]]),
    }
    for leg, rim in rims.items():
        _part(mesh, leg, samples.limbs[leg], AROUND_LIMB, rim, LIMB_ROWS["leg"] * fineness)
    return mesh.skin()


def _samples_per_unit(points: Floats, units: int) -> int:
    return int(points.shape[1] // units)


def _patch(points: Floats, units: int) -> SplinePatch:
    s = _samples_per_unit(points, units)
    return SplinePatch(around=np.arange(units * s + 1) / s, along=chord_lengths(points), points=points)


def _trunk(mesh: _Mesh, samples: SkinSamples, fineness: int) -> Integers:
    """Add the trunk, and return the indices of its vertices (b, a); those inside the openings have no face."""
    patch = _patch(samples.trunk, AROUND_TRUNK)
    ends = patch.along[[0, samples.opening[0], samples.opening[1], -1]]
    counts = np.array([BELOW_OPENING, OPENING_ROWS, ABOVE_OPENING]) * fineness
    along = [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(ends[:-1], ends[1:], counts, strict=True)]
    around = np.arange(AROUND_TRUNK * fineness) / fineness
    rows = mesh.add(patch.at(around, np.concatenate([*along, ends[-1:]])), "trunk")
    open_rows = range(int(counts[0]), int(counts[0] + counts[1]))
    opened = np.concatenate([np.arange(a * fineness, b * fineness) for a, b in OPENINGS.values()])
    closed = ~np.isin(np.arange(len(around)), opened)
    for k in range(len(rows) - 1):
        mesh.join(rows[k], rows[k + 1], closed if k in open_rows else None)
    return rows


def _rim(trunk: Integers, arm: str, fineness: int) -> Integers:
    """Return the vertices round an opening of the trunk, in the order of an arm's rows."""
    first, last = (column * fineness for column in OPENINGS[arm])
    low, high = BELOW_OPENING * fineness, (BELOW_OPENING + OPENING_ROWS) * fineness
    down, up = trunk[high:low:-1, first], trunk[low:high, last]
    return np.concatenate([down, trunk[low, first:last], up, trunk[high, last:first:-1]])


def _part(mesh: _Mesh, name: str, points: Floats, units: int, rim: Integers, rows: int) -> None:
    """Add head or limb, from its first vertices to its tip."""
    patch = _patch(points, units)
    around = np.arange(len(rim)) / (len(rim) // units)
    along = np.linspace(0.0, patch.along[-1], rows + 1)[1:]
    found = patch.at(around, along)
    inner = mesh.add(found[:-1], name)
    mesh.tube(np.concatenate([rim[None], inner]), mesh.add(found[-1, 0], name))


def spline_skin(balls: Metaballs, fineness: int = FINENESS) -> Skin:
    """Make the skin over metaballs at rest, see `sample_skin` and `tessellate`.

    Raises:
        MareyError: A part of the body has a gap.
    """
    return tessellate(sample_skin(balls.at_rest()), fineness)


def spline_body(body: Body, fineness: int = FINENESS) -> Body:
    """Return a body over metaballs with the skin sampled from their cross-sections, closed and without seams.

    The body's uncertainty and the segments that it follows are kept. The skin moves with pose and numbers as that of
    `metaball_body` does. A segment without skin has none afterwards.

    Args:
        body: Body over metaballs.
        fineness: See `tessellate`.

    Raises:
        ValueError: The body has no metaballs.
        MareyError: A part of the body has a gap.
    """
    space = required_metaballs(body)
    skin = spline_skin(space.balls(body.numbers), fineness)
    carrier = {"trunk": "pelvis"} | {name: f"{name.removesuffix('arm')}upperarm" for name in OPENINGS}
    carrier |= {f"{side}_leg": f"{side}_thigh" for side in SIDES}
    segments = np.zeros((len(skin.part), 4), np.int64)
    segments[:, 0] = [body.skeleton.segment(carrier[part]) for part in skin.part]
    template = replace(
        body, faces=skin.faces, vertex_segments=segments, vertex_weights=np.eye(4)[np.zeros(len(segments), int)],
        space=_fixed(skin.vertices, body), numbers=np.zeros(0), outlined=None,
    )  # fmt: skip
    made = metaball_body(space, body.numbers, template, settle=False)
    made = replace(
        made, joint_sd=body.joint_sd, joint_offset_sd=body.joint_offset_sd,
        numbers_covariance=body.numbers_covariance,
    )  # fmt: skip
    return _with_parts_of(made, body)


def _fixed(vertices: Floats, body: Body) -> ShapeSpace:
    """Return a space of a single shape."""
    none = np.zeros((0, 0))
    return ShapeSpace(
        names=(), vertex_mean=vertices, vertex_modes=np.zeros((0, *vertices.shape)), joint_mean=body.joint_centres,
        joint_modes=np.zeros((0, *body.joint_centres.shape)), prior_mean=np.zeros(0), prior_covariance=none,
    )  # fmt: skip


def _with_parts_of(made: Body, body: Body) -> Body:
    """Keep the segments of a body that another one has, with its outlines, except at cuts."""
    there = np.isin(made.face_segment, np.unique(body.face_segment))
    counted = np.isin(made.face_segment, np.unique(body.face_segment[body.outline_counts]))
    cut = np.isin(made.faces, np.unique(made.faces[~there])).any(1)
    return replace(made, faces=made.faces[there], outlined=(counted & ~cut)[there])
