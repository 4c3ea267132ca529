"""Cross-sections of trunk and head: horizontal ones up to the armpits, and the transitions to arms and neck."""

import numpy as np

from marey.arrays import Floats
from marey.body.articulation.skeleton import LIMBS
from marey.body.metaballs.cross_sections import (
    AROUND_LIMB,
    AROUND_TRUNK,
    BACK,
    DOWN,
    OPENING_ROWS,
    OPENINGS,
    SIDES,
    Caster,
    between,
    even_arc,
    smooth,
)  # fmt: skip
from marey.body.metaballs.ray_casting import exits
from marey.geometry.vectors import unit

_DEEP = 0.12
"""Largest distance of the trunk's middle before or behind the spine [m]. Chosen by hand."""


class TrunkSections:
    """The trunk's centre line, its horizontal sections, and the openings of the arms.

    Args:
        caster: Rays on the metaballs.
    """

    def __init__(self, caster: Caster):
        self.caster = caster
        joints = caster.joints
        self.spine = np.stack([joints[name] for name in ("pelvis", "abdomen", "thorax", "neck")])
        self.hips = float(np.mean([joints[f"{side}_thigh"][2] for side in SIDES]))
        centre = self.centre(np.array([self.hips]))[0]
        below = caster.cast("pelvis", centre, DOWN, reach=0.5)[2]
        # Thighs that touch are joined down to this height only.
        self.crotch = max(float(below), self.hips - 0.13 * caster.size)
        self.bottom = self.hips - 0.3 * (self.hips - self.crotch)
        self.rims = {arm: self._rim(arm) for arm in OPENINGS}

    def centre(self, height: Floats) -> Floats:
        """Return the middle (n, 3) between front and back of the trunk at heights (n,) [m]."""
        spine = self.spine[np.argsort(self.spine[:, 2])]
        x, y = (np.interp(height, spine[:, 2], spine[:, a]) for a in (0, 1))
        tried = y[:, None] + np.linspace(-_DEEP, _DEEP, 33) * self.caster.size
        lines = np.stack(np.broadcast_arrays(x[:, None], tried, np.asarray(height)[:, None]), -1)
        field = self.caster.posed.field(lines.reshape(-1, 3)).reshape(tried.shape)
        # The spine may be outside the balls of a slender person.
        inside = lines[np.arange(len(lines)), np.argmax(field, axis=1)]
        faces = [self.caster.cast("trunk", inside, way * BACK, reach=0.45) for way in (-1, 1)]
        return np.stack([x, 0.5 * (faces[0][:, 1] + faces[1][:, 1]), height], -1)

    def at(self, angles: Floats, heights: Floats) -> Floats:
        """Return points (n, 3) of the trunk at angles (n,) about its centre line, 0 on the left, and heights (n,)."""
        way = np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], -1)
        return self.caster.cast("trunk", self.centre(heights), way, reach=0.45)

    def level(self, height: float) -> Floats:
        """Return a horizontal section (12 s, 3), from the front by the left side, halved at front and back."""
        half = AROUND_TRUNK // 2 * self.caster.samples
        origin = self.centre(np.array([height]))

        def ring(angles: Floats) -> Floats:
            way = np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], -1)
            return self.caster.cast("trunk", origin, way, reach=0.45)

        left, right = even_arc(ring, -np.pi / 2, np.pi / 2, half), even_arc(ring, np.pi / 2, 1.5 * np.pi, half)
        return np.concatenate([left[:-1], right[:-1]])

    def shoulder(self, arm: str) -> tuple[Floats, Floats, Floats]:
        """Return the section between trunk and arm: centre, normal out along the arm, direction of the armpit.

        The section is perpendicular to the frontal plane and contains the shoulder and the armpit, where the distance
        to the surface between trunk and arm is smallest.
        """
        side = arm.partition("_")[0]
        joints, outward = self.caster.joints, np.array([SIDES[side], 0.0, 0.0])
        centre = joints[f"{side}_upperarm"]
        along = unit((joints[f"{side}_forearm"] - centre) * [1, 0, 1])
        lowest = np.arctan2(along @ outward, along @ DOWN)
        angle = np.linspace(-0.5, lowest, 61)
        ways = np.cos(angle)[:, None] * DOWN + np.sin(angle)[:, None] * outward
        out = exits(self.caster.posed, centre, ways, LIMBS.index(arm), reach=0.45 * self.caster.size)
        # Rays down the trunk have no exit nearby.
        length = np.nan_to_num(np.linalg.norm(out - centre, axis=1), nan=np.inf)
        armpit = ways[np.argmin(length)]
        return centre, unit(np.cross(armpit, BACK) * SIDES[side]), armpit

    def _rim(self, arm: str) -> Floats:
        """Return the section between trunk and arm (8 s, 3), in the order of an arm's rows."""
        centre, normal, armpit = self.shoulder(arm)
        across = np.cross(normal, armpit)

        def ring(angles: Floats) -> Floats:
            way = np.cos(angles)[:, None] * armpit + np.sin(angles)[:, None] * across
            return self.caster.cast("shoulder", centre, way, arm, reach=0.4)

        count = AROUND_LIMB * self.caster.samples
        return np.roll(even_arc(ring, 0.0, 2 * np.pi, count)[:-1], 3 * self.caster.samples, axis=0)

    def opening_row(self, row: int) -> Floats:
        """Return the trunk's samples (12 s, 3) beside the openings, with the rims in the first and the last row.

        Rows between them have no skin inside the openings: there the rims are interpolated.
        """
        s = self.caster.samples
        points = np.full((AROUND_TRUNK * s, 3), np.nan)
        for arm, (first, last) in OPENINGS.items():
            points[first * s : last * s + 1] = _spanned(self.rims[arm], s)[row]
        for first, last in ((OPENINGS["right_arm"][1], 14), (OPENINGS["left_arm"][1], OPENINGS["right_arm"][0])):
            columns = np.arange(first * s, last * s + 1) % len(points)
            points[columns[1:-1]] = self._across(points[columns[0]], points[columns[-1]], len(columns) - 1)
        return points

    def _across(self, first: Floats, last: Floats, count: int) -> Floats:
        """Return the points (count - 1, 3) between two points of the trunk, round its front or back."""
        middle = self.centre(np.array([first[2], last[2]]))
        turn = [np.arctan2(*(p - c)[[1, 0]]) for p, c in zip((first, last), middle, strict=True)]
        turn[1] += 2 * np.pi if turn[1] < turn[0] else 0.0

        def ring(angles: Floats) -> Floats:
            share = (angles - turn[0]) / (turn[1] - turn[0])
            return self.at(angles, (1 - share) * first[2] + share * last[2])

        return even_arc(ring, turn[0], turn[1], count)[1:-1]


def _spanned(rim: Floats, s: int) -> Floats:
    """Interpolate a rim (8 s, 3) by rows (2 s + 1, 2 s + 1, 3) from the armpit up, columns in the trunk's order."""
    n = OPENING_ROWS * s
    first, bottom, second, top = (rim[np.arange(k * n, (k + 1) * n + 1) % len(rim)] for k in range(4))
    first, top = first[::-1], top[::-1]
    up, across = (a.reshape(b) for a, b in zip(np.meshgrid(*[np.linspace(0, 1, n + 1)] * 2, indexing="ij"),
                                               [(n + 1, n + 1, 1)] * 2, strict=True))  # fmt: skip
    ruled = (1 - across) * first[:, None] + across * second[:, None] + (1 - up) * bottom + up * top
    corners = (1 - up) * ((1 - across) * bottom[0] + across * bottom[-1])
    corners = corners + up * ((1 - across) * top[0] + across * top[-1])
    return np.asarray(ruled - corners)


def sample_trunk(sections: TrunkSections) -> tuple[Floats, tuple[int, int]]:
    """Sample the trunk (B, 12 s, 3) from the hips to the neck, with the first and last row of the openings."""
    caster = sections.caster
    s, size = caster.samples, caster.size
    rows = [sections.opening_row(row) for row in range(OPENING_ROWS * s + 1)]
    low = min(rim[:, 2].min() for rim in sections.rims.values()) - 0.07 * size
    below = [sections.level(z) for z in np.linspace(sections.bottom, low, 5 * s)]
    share = np.linspace(0.0, 1.0, 2 * s + 1)[1:-1]
    middle = sections.centre(np.linspace(low, sections.spine[-1, 2] - 0.1 * size, len(share)))
    aims = between(below[-1], rows[0], share)
    under = caster.cast("chest", middle[:, None], aims - middle[:, None], reach=0.45)
    origin, _, collar = neck_section(caster)
    share = np.linspace(0.0, 1.0, 2 * s + 1)[1:-1]
    start = sections.centre(np.array([np.mean(rows[-1][:, 2]) - 0.08 * size]))[0]
    middle = between(start, origin, share)
    above = caster.cast("shoulders", middle[:, None], between(rows[-1], collar, share) - middle[:, None], reach=0.45)
    points = np.concatenate([np.array(below), under, np.array(rows), above, collar[None]])
    first = len(below) + len(under)
    return points, (first, first + OPENING_ROWS * s)


def _planar(caster: Caster, part: str, centre: Floats, normal: Floats) -> Floats:
    """Return the planar section (12 s, 3) of neck or head across a direction, from the front by the left side."""
    back = unit(BACK - (BACK @ normal) * normal)
    left = np.cross(back, normal)

    def ring(angles: Floats) -> Floats:
        way = np.cos(angles)[:, None] * left + np.sin(angles)[:, None] * back
        return caster.cast(part, centre, way, reach=0.3)

    half = AROUND_TRUNK // 2 * caster.samples
    arcs = even_arc(ring, -np.pi / 2, np.pi / 2, half)[:-1], even_arc(ring, np.pi / 2, 1.5 * np.pi, half)[:-1]
    return np.concatenate(arcs)


def neck_section(caster: Caster, share: float = 0.3) -> tuple[Floats, Floats, Floats]:
    """Return a section of the neck at a share of the distance to the head: centre, normal and points (12 s, 3)."""
    neck, head = caster.joints["neck"], caster.joints["head"]
    centre, normal = neck + share * (head - neck), unit(head - neck)
    return centre, normal, _planar(caster, "neck", centre, normal)


def sample_head(caster: Caster) -> Floats:
    """Sample neck and head (B, 12 s, 3), from the trunk's last row to the crown."""
    s, balls = caster.samples, caster.posed
    own = balls.balls.segment == balls.balls.skeleton.segment("head")
    middle = np.average(balls.place[own], axis=0, weights=np.prod(balls.balls.radii[own], axis=1))
    neck = [neck_section(caster, share) for share in np.linspace(0.3, 0.8, s + 1)]
    _, normal, _ = neck[0]
    top, _, last = neck[-1]
    widest = _planar(caster, "head", middle, normal)
    share = np.linspace(0.0, 1.0, 3 * s + 1)[1:-1]
    origin = between(top, middle, smooth(share))[:, None]
    jaw = caster.cast("head", origin, between(last, widest, share) - origin, reach=0.3)
    turn = np.linspace(0.0, np.pi / 2, 3 * s + 1)[1:, None, None]
    ways = np.cos(turn) * unit(widest - middle) + np.sin(turn) * normal
    crown = caster.cast("head", middle, ways, reach=0.3)
    crown[-1] = crown[-1, 0]
    return np.concatenate([np.array([points for _, _, points in neck]), jaw, widest[None], crown])
