"""Cross-sections of arms and legs, from the trunk along the bones to the tips of hands and feet."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats
from marey.body.articulation.skeleton import LIMBS
from marey.body.metaballs.cross_sections import (
    AROUND_LIMB,
    AROUND_TRUNK,
    BACK,
    DOWN,
    FINE,
    SIDES,
    Caster,
    Ring,
    between,
    even_arc,
    smooth,
)  # fmt: skip
from marey.body.metaballs.metaballs import THRESHOLD
from marey.body.metaballs.trunk_sections import TrunkSections
from marey.errors import MareyError
from marey.geometry import rotations
from marey.geometry.vectors import unit

_HAND = 0.12
"""Half the width of the area in which a hand's section is measured [m]."""
_CELL = 0.005
"""Grid step of a hand's sections [m]."""
_LEAST_SECTION = 2e-4
"""Area of the smallest section of a hand [m2]. Chosen by hand."""
_HAND_ROUNDS = 2
"""Number of times that neighbouring sections of a hand are averaged. Chosen by hand."""
_PALM = (0.02, 0.06)
"""Range of distances from the wrist in which sections change from rays to ellipses [m]. Chosen by hand."""


@dataclass(frozen=True, eq=False, kw_only=True)
class LimbSections:
    """Sections of one limb across its centre line."""

    caster: Caster
    """Rays on the metaballs."""
    name: str
    """Name of the limb."""
    inner: Floats
    """(3,) direction of angle zero: that of the armpit, or of the other leg."""
    inner_at: int
    """Column in that direction [units]."""
    reach: float
    """Length of the rays [m]."""

    def section(self, centre: Floats, normal: Floats) -> Floats:
        """Return the section (8 s, 3) across a direction, about a centre that is moved into its middle."""
        plane = self._plane(normal)

        def ring(angles: Floats) -> Floats:
            return self.cast(centre, np.stack([np.cos(angles), np.sin(angles)], -1) @ plane)

        centre = self.caster.innermost(centre, plane, self.name)
        for _ in range(2):
            centre = ring(np.linspace(0.0, 2 * np.pi, FINE // 3 + 1)[:-1]).mean(0)
        return self._spread(ring)

    def cast(self, origins: Floats, directions: Floats) -> Floats:
        """Cast rays in the field of trunk and limb."""
        return self.caster.cast(self.name.replace("_", " "), origins, directions, self.name, reach=self.reach)

    def within(self, centre: Floats, normal: Floats) -> tuple[Floats, Floats, float]:
        """Measure the area inside across a direction, near a point: middle, second moments (3, 3) and area."""
        plane = self._plane(normal)
        side = np.arange(-_HAND, _HAND + 1e-9, _CELL) * self.caster.size
        flat = np.stack(np.meshgrid(side, side, indexing="ij"), -1).reshape(-1, 2)
        field = self.caster.posed.field(centre + flat @ plane, LIMBS.index(self.name))
        share = field**4 / (field**4 + THRESHOLD**4)
        total = max(float(share.sum()), 1e-12)
        middle = share @ flat / total
        moments = np.einsum("n,na,nb->ab", share, flat - middle, flat - middle) / total
        return centre + middle @ plane, plane.T @ moments @ plane, total * (side[1] - side[0]) ** 2

    def ellipse(self, centre: Floats, moments: Floats, area: float, normal: Floats, drawn: float) -> Floats:
        """Return points (8 s, 3) of the ellipse of given area with the proportions of moments, scaled by a factor."""
        plane = self._plane(normal)
        values, axes = np.linalg.eigh(plane @ moments @ plane.T)
        half = axes * np.sqrt(np.maximum(values, 1e-12)) @ axes.T
        half *= np.sqrt(area / (np.pi * np.linalg.det(half)))

        def ring(angles: Floats) -> Floats:
            return np.asarray(centre + drawn * np.stack([np.cos(angles), np.sin(angles)], -1) @ half @ plane)

        return self._spread(ring)

    def _plane(self, normal: Floats) -> Floats:
        """Return the directions (2, 3) of angle zero and of a quarter turn."""
        inner = unit(self.inner - (self.inner @ normal) * normal)
        return np.stack([inner, np.cross(normal, inner)])

    def _spread(self, ring: Ring) -> Floats:
        """Return points (8 s, 3) of a section, evenly spaced, in the order of a limb's rows."""
        s = self.caster.samples
        return np.roll(even_arc(ring, 0.0, 2 * np.pi, AROUND_LIMB * s)[:-1], self.inner_at * s, axis=0)

    def along(self, line: Floats, steps: Floats) -> list[Floats]:
        """Return the sections at distances (n,) along a polyline (k, 3), with normals interpolated where it bends."""
        length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
        straight = unit(np.diff(line, axis=0))
        middle = 0.5 * (length[1:] + length[:-1])
        found = []
        for step in steps:
            centre = np.array([np.interp(step, length, line[:, a]) for a in range(3)])
            normal = unit(np.array([np.interp(step, middle, straight[:, a]) for a in range(3)]))
            found.append(self.section(centre, normal))
        return found

    def onset(self, rim: Floats, section: Floats, start: Floats, rows: int) -> Floats:
        """Return the rows between a rim and a section (8 s, 3), by rays from a point towards its middle."""
        share = np.linspace(0.0, 1.0, rows + 1)[1:-1]
        middle = between(start, section.mean(0), share)[:, None]
        aims = between(rim, section, share)
        return self.cast(middle, aims - middle)

    def tip(self, section: Floats, normal: Floats, rows: int) -> Floats:
        """Close a limb beyond a section (8 s, 3): rays from its middle rotate forward until they meet in one point."""
        middle = section.mean(0)
        turn = np.linspace(0.0, np.pi / 2, rows + 1)[1:, None, None]
        ways = np.cos(turn) * unit(section - middle) + np.sin(turn) * normal
        found = self.cast(middle, ways)
        found[-1] = found[-1, 0]
        return found


def sample_arm(sections: TrunkSections, name: str) -> Floats:
    """Sample an arm (B, 8 s, 3) from the opening of the trunk to the fingertips."""
    caster = sections.caster
    s, size, side = caster.samples, caster.size, name.partition("_")[0]
    start, _, armpit = sections.shoulder(name)
    limb = LimbSections(caster=caster, name=name, inner=armpit, inner_at=3, reach=0.2)
    elbow, wrist = caster.joints[f"{side}_forearm"], caster.joints[f"{side}_hand"]
    forward = unit(wrist - elbow)
    line = np.stack([start, elbow, wrist, wrist + 0.4 * size * forward])
    length = np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))
    rim = sections.rims[name]
    # The first section across the arm is beyond the armpit, where it does not intersect the trunk.
    beyond = (rim[3 * s] - start) @ unit(elbow - start) + 0.06 * size
    first = min(max(0.45 * length[0], beyond), 0.9 * length[0])
    rows = limb.along(line, np.linspace(first, length[1] - 0.01 * size, 10 * s))
    onset = limb.onset(rim, rows[0], start, 2 * s)
    return np.concatenate([rim[None], onset, np.array(rows), _hand(limb, wrist, forward)])


def _hand(limb: LimbSections, wrist: Floats, forward: Floats) -> Floats:
    """Sample a hand (B, 8 s, 3) beyond the wrist as a mitten.

    Unlike the paper, which does not describe hands, each section beyond the palm is the ellipse of the same area and
    proportions: the balls of thumb and fingers are separate, and no ray reaches all of them.
    """
    caster, s = limb.caster, limb.caster.samples
    steps = np.linspace(0.0, 0.3, 31) * caster.size
    middles, spreads, areas = _smoothed(
        *zip(*(limb.within(wrist + step * forward, forward) for step in steps), strict=True)
    )
    # Thinner sections of the fingers are replaced by the rounded end.
    there = np.flatnonzero(areas > _LEAST_SECTION * caster.size**2)
    if not len(there) or steps[there[-1]] < 0.07 * caster.size:
        raise MareyError(f"The metaballs have no hand at the {limb.name.replace('_', ' ')}.")
    end, round_end = steps[there[-1]] + 0.01 * caster.size, 0.03 * caster.size
    rows = []
    for step in np.linspace(0.0, end, 5 * s + 1):
        at = min(step, steps[there[-1]])
        middle, spread, area = (_at(steps, values, at) for values in (middles, spreads, areas))
        drawn = np.sqrt(max(0.0, 1.0 - max(0.0, (step - end + round_end) / round_end) ** 2))
        mitten = limb.ellipse(middle + (step - at) * forward, spread, float(area), forward, drawn)
        share = smooth(np.clip((step / caster.size - _PALM[0]) / (_PALM[1] - _PALM[0]), 0.0, 1.0))
        if share < 1.0:
            mitten = (1.0 - share) * limb.section(wrist + step * forward, forward) + share * mitten
        rows.append(mitten)
    rows[-1][:] = rows[-1].mean(0)
    return np.array(rows)


def _at(steps: Floats, values: Floats, step: float) -> Floats:
    """Interpolate values (n, ...) at ascending steps (n,)."""
    k = int(np.clip(np.searchsorted(steps, step) - 1, 0, len(steps) - 2))
    share = (step - steps[k]) / (steps[k + 1] - steps[k])
    return np.asarray((1.0 - share) * values[k] + share * values[k + 1])


def _smoothed(*sections: tuple[Floats, ...]) -> list[Floats]:
    """Average the middles, spreads and areas of neighbouring sections, weighted by area."""
    middles, spreads, areas = (np.array(values) for values in sections)
    flat = np.concatenate([middles, spreads.reshape(-1, 9), np.ones((len(areas), 1))], 1) * areas[:, None]
    for _ in range(_HAND_ROUNDS):
        padded = np.concatenate([flat[:1], flat, flat[-1:]])
        flat = 0.25 * padded[:-2] + 0.5 * padded[1:-1] + 0.25 * padded[2:]
    area = flat[:, 12]
    flat = flat / np.maximum(area, 1e-12)[:, None]
    return [flat[:, :3], flat[:, 3:12].reshape(-1, 3, 3), area]


def sample_seam(sections: TrunkSections) -> Floats:
    """Sample the seam (2 s + 1, 3) between the legs, from front to back."""
    caster = sections.caster
    centre = sections.centre(np.array([sections.bottom]))[0]

    def ring(angles: Floats) -> Floats:
        way = np.cos(angles)[:, None] * BACK + np.sin(angles)[:, None] * DOWN
        found = caster.cast("crotch", centre, way, reach=0.4)
        deep = np.minimum(1.0, (sections.crotch - centre[2]) / np.minimum(found[:, 2] - centre[2], -1e-9))
        return np.asarray(centre + deep[:, None] * (found - centre))

    return even_arc(ring, np.pi, 0.0, 2 * caster.samples)


def sample_leg(sections: TrunkSections, name: str, waist: Floats, seam: Floats) -> Floats:
    """Sample a leg (B, 8 s, 3) from the trunk's first row (12 s, 3) and the seam to the tips of the toes."""
    caster = sections.caster
    s, size, side = caster.samples, caster.size, name.partition("_")[0]
    half = np.concatenate([waist, waist[:1]])
    n = AROUND_TRUNK // 2 * s
    if side == "left":
        rim = np.concatenate([half[n::-1], seam[1:-1]])
    else:
        rim = np.concatenate([half[: n - 1 : -1], seam[-2:0:-1]])
    limb = LimbSections(caster=caster, name=name, inner=np.array([-SIDES[side], 0.0, 0.0]), inner_at=7, reach=0.3)
    hip, knee, ankle, toes = (caster.joints[f"{side}_{part}"] for part in ("thigh", "shank", "foot", "toes"))
    line = np.stack([hip, knee, ankle])
    length = np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))
    first, last = hip[2] - sections.crotch + 0.05 * size, length[1] - 0.03 * size
    rows = limb.along(line, np.linspace(first, last, 14 * s))
    start = hip + first / length[0] * (knee - hip)
    onset = limb.onset(rim, rows[0], 0.5 * (hip + start), 2 * s)
    return np.concatenate([rim[None], onset, np.array(rows), _foot(limb, rows[-1], unit(ankle - knee), ankle, toes)])


def _foot(limb: LimbSections, above: Floats, down: Floats, ankle: Floats, toes: Floats) -> Floats:
    """Sample the foot (B, 8 s, 3) beyond the section above the ankle: round the heel, and to the toes."""
    caster, s = limb.caster, limb.caster.samples
    forward = unit((toes - ankle) * [1, 1, 0])
    start, instep = above.mean(0), 0.5 * (ankle + toes)
    # The sections rotate about the intersection of the first and the last one, in front of and above the instep.
    hinge = unit(np.cross(down, forward))
    pivot = np.linalg.solve(np.stack([down, forward, hinge]), [down @ start, forward @ instep, hinge @ start])
    arms = [centre - pivot - hinge * (hinge @ (centre - pivot)) for centre in (start, instep)]
    size = [float(np.linalg.norm(arm)) for arm in arms]
    rows = []
    for share in np.linspace(0.0, 1.0, 4 * s + 1)[1:]:
        turn = rotations.about(hinge, np.array(share * np.arccos(np.clip(down @ forward, -1, 1))))
        centre = pivot + turn @ arms[0] * (1 - share + share * size[1] / size[0])
        rows.append(limb.section(centre + hinge * (hinge @ (instep - start)) * share, turn @ down))
    middle = rows[-1].mean(0)
    ball = limb.section(caster.deepest(toes, np.cross(forward, hinge), limb.name), forward).mean(0)
    tip = caster.cast("toes", ball, forward, limb.name, reach=0.25)
    ends = np.stack([middle, ball, tip])
    length = np.cumsum(np.linalg.norm(np.diff(ends, axis=0), axis=1))
    rows += limb.along(ends, np.linspace(0.0, max(length[0], length[1] - 0.035 * caster.size), 2 * s + 1)[1:])
    return np.concatenate([np.array(rows), limb.tip(rows[-1], forward, 2 * s)])
