"""Girths, volume, mass, centre and inertia of a person's segments from the metaballs, with their uncertainty."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.body.articulation.skeleton import LIMBS
from marey.body.metaballs.metaball_field import _slope, _weigh, distance_of_level, logarithms
from marey.body.metaballs.metaball_person import MetaballSpace
from marey.body.metaballs.metaballs import Metaballs, PosedMetaballs
from marey.compiled.kernels import kernel
from marey.process import usable_cores

DENSITY = {
    "head": 1110.0, "neck": 1110.0, "thorax": 920.0, "abdomen": 1010.0, "pelvis": 1010.0, "clavicle": np.nan,
    "upperarm": 1070.0, "forearm": 1130.0, "hand": 1160.0, "thigh": 1050.0, "shank": 1090.0, "foot": 1100.0,
    "toes": 1100.0,
}  # fmt: skip
"""Density of a segment [kg/m3] ([Dempster1955], as tabled in [Winter2009] table 4.1); abdomen and pelvis share one,
and clavicles have no volume of their own."""
DENSITY_SD = 0.02
"""Standard deviation of the densities among people, as a share. Ours: the source gives none."""
MOST_GIRTH_SD = 0.06
"""Standard deviation of a girth, as a share of it, above which the girth is not determined: the spread of girths among
people of the same size (`marey.body.people.departures.GIRTH_SD`), which is known without any image."""
STATIONS = (0.25, 0.5, 0.75)
"""Positions of the girths, as shares of the distance to the next joint."""
GRID_STEP = 0.015
"""Step of the grid over which volumes are summed [m]. Chosen by hand."""
COVARIANCE_DRAWS = 32
"""Number of bodies drawn from the numbers' covariance; a standard deviation from 32 draws is accurate to 1/8 of
itself."""
_NEAR = 0.03
"""Margin of the grid around the segments [m]. Chosen by hand."""
_RAYS = 36
"""Number of rays around a girth. Chosen by hand."""
_CASTS = 25
"""Iterations that move the rays' ends to the surface. Chosen by hand."""
_ARMS = (LIMBS.index("left_arm"), LIMBS.index("right_arm"))
"""Indices of the arms in `LIMBS`."""
_BEYOND = {
    "pelvis": "abdomen", "abdomen": "thorax", "thorax": "neck", "neck": "head", "upperarm": "forearm",
    "forearm": "hand", "thigh": "shank", "shank": "foot", "foot": "toes",
}  # fmt: skip
"""The next segment, whose joint is the end of a segment."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SegmentMeasures:
    """Measurements of n segments at rest; every array has its standard deviations beside it, NaN if unknown."""

    names: tuple[str, ...]
    """(n,) names of the segments."""
    girth: Floats
    """(n, 3) girths at `STATIONS` of the segment's length [m]; NaN at an end of the body, and where they are not
    determined."""
    girth_sd: Floats
    """(n, 3) [m]; NaN at an end of the body, known where a girth is not determined."""
    volume: Floats
    """(n,) [m3]; a limb ends where its part of the field does, an arm also at the shoulder's plane, its segments at
    planes through the joints. NaN for clavicles, whose surroundings belong to the thorax, as in [deLeva1996]."""
    volume_sd: Floats
    mass: Floats
    """(n,) [kg]."""
    mass_sd: Floats
    centre: Floats
    """(n, 3) centre of mass from the joint about which the segment rotates, along the axes of the rest posture [m]."""
    centre_sd: Floats
    inertia: Floats
    """(n, 6) inertia about that centre: xx, yy, zz, xy, xz, yz [kg m2]."""
    inertia_sd: Floats
    whole_volume: float
    """Volume of the segments together [m3]."""
    whole_volume_sd: float
    whole_mass: float
    """Mass of the segments together [kg]."""
    whole_mass_sd: float
    """Its standard deviation [kg]; the densities of all segments of a person are taken to differ from the mean by one
    share."""

    @property
    def undetermined_girths(self) -> Mask:
        """(n, 3) true for girths whose standard deviation exceeds `MOST_GIRTH_SD`."""
        return np.asarray(np.isnan(self.girth) & np.isfinite(self.girth_sd))

    def equal_side(self, segment: str) -> str:
        """Return the segment of the other side if the model gives both the same volume, otherwise an empty text."""
        side, _, rest = segment.partition("_")
        other = {"left": f"right_{rest}", "right": f"left_{rest}"}.get(side, "")
        if other not in self.names:
            return ""
        own, theirs = self.names.index(segment), self.names.index(other)
        return other if np.isclose(self.volume[own], self.volume[theirs], rtol=1e-6) else ""


def segment_measures(
    space: MetaballSpace, numbers: Floats, covariance: Floats | None, *, segments: Mask, seed: int = 0
) -> SegmentMeasures:
    """Measure a person's segments.

    Args:
        space: Metaballs.
        numbers: (N,) the person's shape parameters.
        covariance: (N, N) of the numbers; None if unknown.
        segments: (S,) true for segments that are measured.
        seed: Seed of the draws.
    """
    names = space.mean.skeleton.segment_names
    wanted = np.flatnonzero(segments)
    density: Floats = np.array([DENSITY[names[k].rpartition("_")[2]] for k in wanted])
    grid = _grid(space.balls(numbers), wanted)
    found = _measured(space.balls(numbers), wanted, density, grid)
    spread, whole_sd = np.full_like(found, np.nan), np.full(2, np.nan)
    if covariance is not None:
        rng = np.random.default_rng(seed)
        root = _root(covariance)
        draws = rng.normal(size=(COVARIANCE_DRAWS // 2, root.shape[1])) @ root.T
        changes = [sign * draw for draw in draws for sign in (1, -1)]
        with ThreadPoolExecutor(usable_cores()) as pool:
            bodies = (_balls_of_change(space, numbers, change) for change in changes)
            changed = list(pool.map(lambda balls: _measured(balls, wanted, density, grid), bodies))
        spread = np.sqrt(np.mean((np.array(changed) - found) ** 2, axis=0))
        whole_sd = np.sqrt(np.mean(np.nansum(np.array(changed) - found, axis=1)[:, 3:5] ** 2, axis=0))
    spread[:, 4] = np.hypot(spread[:, 4], DENSITY_SD * found[:, 4])
    spread[:, 8:] = np.hypot(spread[:, 8:], DENSITY_SD * found[:, 8:])
    whole = np.nansum(found[:, 3:5], axis=0)
    lost = spread[:, :3] > MOST_GIRTH_SD * found[:, :3]
    return SegmentMeasures(
        names=tuple(names[k] for k in wanted),
        girth=np.where(lost, np.nan, found[:, :3]), volume=found[:, 3], mass=found[:, 4], centre=found[:, 5:8],
        inertia=found[:, 8:],
        girth_sd=spread[:, :3], volume_sd=spread[:, 3], mass_sd=spread[:, 4], centre_sd=spread[:, 5:8],
        inertia_sd=spread[:, 8:], whole_volume=float(whole[0]), whole_volume_sd=float(whole_sd[0]),
        whole_mass=float(whole[1]), whole_mass_sd=float(np.hypot(whole_sd[1], DENSITY_SD * whole[1])),
    )  # fmt: skip


def _root(covariance: Floats) -> Floats:
    """Return a square root (N, N) of a covariance."""
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def _balls_of_change(space: MetaballSpace, numbers: Floats, change: Floats) -> Metaballs:
    """Return the balls for changed numbers; a change that would make a ball vanish is reduced."""
    for _ in range(8):
        radii = space.mean.radii + np.tensordot(numbers + change, space.radii_modes, 1)
        if np.all(radii > 0.1 * space.mean.radii):
            break
        change = 0.5 * change
    else:
        change = 0.0 * change
    return space.balls(numbers + change)


def _grid(balls: Metaballs, wanted: Integers) -> Floats:
    """Return the points (n, 3) of a grid in the wanted segments and a few centimetres around them, at rest."""
    posed, own = balls.at_rest(), np.isin(balls.segment, wanted)
    reach = posed.place[own]
    widest = balls.radii[own].max(1)[:, None] + _NEAR
    low, high = (reach - widest).min(0), (reach + widest).max(0)
    rough = _lattice(low, high, 4 * GRID_STEP)
    near = rough[posed.distance(rough) < _NEAR + 2 * GRID_STEP]
    offsets = (np.stack(np.meshgrid(*[np.arange(4)] * 3, indexing="ij"), -1).reshape(-1, 3) - 1.5) * GRID_STEP
    return (near[:, None] + offsets).reshape(-1, 3)


def _lattice(low: Floats, high: Floats, step: float) -> Floats:
    """Return the points (n, 3) of a regular grid between two corners."""
    axes = [np.arange(a, b + step, step) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)


def _measured(balls: Metaballs, wanted: Integers, density: Floats, grid: Floats) -> Floats:
    """Measure the wanted segments: (n, 14) girths, volume, mass, centre, inertia."""
    posed = balls.at_rest()
    sums = np.zeros((len(balls.joint_centres), 10))
    group, normal = _cuts(balls)
    ball_group = np.maximum(group[balls.segment], 0)
    add_volume(
        grid, GRID_STEP, len(LIMBS), balls.limb, posed.place, posed.axes, balls.radii, balls.weight, ball_group, group,
        balls.joint_centres, normal, sums,
    )  # fmt: skip
    of = sums[wanted]
    volume = np.where(group[wanted] < 0, np.nan, np.maximum(of[:, 0], 1e-12))
    middle = of[:, 1:4] / volume[:, None]
    second = np.empty((len(wanted), 3, 3))
    for i, (a, b) in enumerate(((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))):
        second[:, a, b] = second[:, b, a] = of[:, 4 + i] - volume * middle[:, a] * middle[:, b]
    # The extent of the grid's cells adds to the second moments.
    second += (volume * GRID_STEP**2 / 12.0)[:, None, None] * np.eye(3)
    inertia = np.trace(second, axis1=1, axis2=2)[:, None, None] * np.eye(3) - second
    inertia *= density[:, None, None]
    rows = inertia[:, [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    girths = np.array([_girths(posed, int(k)) for k in wanted]).reshape(len(wanted), len(STATIONS))
    return np.column_stack([girths, volume, volume * density, middle - balls.joint_centres[wanted], rows])


def _cuts(balls: Metaballs) -> tuple[Integers, Floats]:
    """Return the planes at which a body is cut into segments.

    Returns:
        (S,) the group of segments, a chain: the trunk, and each limb; -1 for clavicles, which belong to the thorax; and
        normals (S, 3), along the chain, of the planes through the joints at which a segment begins, half way between
        its bone and its parent's.
    """
    skeleton, joints = balls.skeleton, balls.joint_centres
    group = np.array(skeleton.segment_limb)
    group[[name.endswith("clavicle") for name in skeleton.segment_names]] = -1
    bone = np.zeros_like(joints)
    for k, parent in enumerate(skeleton.parents):
        chained = np.flatnonzero((skeleton.parents == k) & ((group == group[k]) | (group[k] < 0)))
        last = bone[parent] if parent >= 0 else np.zeros(3)
        along = joints[chained[0]] - joints[k] if len(chained) else last
        bone[k] = along / max(float(np.linalg.norm(along)), 1e-9)
    return group, bone + bone[np.maximum(skeleton.parents, 0)]


def _girths(posed: PosedMetaballs, segment: int) -> Floats:
    """Return the lengths (3,) of the surface's sections across a segment; the trunk's exclude the limbs."""
    skeleton = posed.balls.skeleton
    name = skeleton.segment_names[segment]
    side, _, plain = name.rpartition("_")
    beyond = f"{side}_{_BEYOND[plain]}".strip("_") if plain in _BEYOND else ""
    if beyond not in skeleton.segment_names:
        return np.full(len(STATIONS), np.nan)
    from_joint, to_joint = (posed.balls.joint_centres[k] for k in (segment, skeleton.segment(beyond)))
    along = (to_joint - from_joint) / np.linalg.norm(to_joint - from_joint)
    across = np.linalg.svd(along[None])[2][1:]
    turns = 2 * np.pi * np.arange(_RAYS) / _RAYS
    rays = np.cos(turns)[:, None] * across[0] + np.sin(turns)[:, None] * across[1]
    limb = int(skeleton.segment_limb[segment])
    if limb == 0:
        limb = LIMBS.index("left_arm" if plain in ("pelvis", "abdomen") else "left_leg")
    middles = from_joint + np.array(STATIONS)[:, None] * (to_joint - from_joint)
    reach = np.full((len(STATIONS), _RAYS), 0.01)
    for _ in range(_CASTS):
        points = middles[:, None] + reach[:, :, None] * rays
        reach = np.maximum(reach - posed.distance(points.reshape(-1, 3), limb).reshape(reach.shape), 1e-3)
    points = middles[:, None] + reach[:, :, None] * rays
    chords = np.linalg.norm(points - np.roll(points, 1, axis=1), axis=2).sum(1)
    return np.asarray(chords * (np.pi / _RAYS) / np.sin(np.pi / _RAYS))


@kernel
def _last_beyond(x, y, z, own, group, joints, normal):
    """Return the last segment of a group whose plane a point lies beyond, or -1."""
    found = -1
    for j in range(group.shape[0]):
        if group[j] == own:
            beyond = normal[j, 0] * (x - joints[j, 0]) + normal[j, 1] * (y - joints[j, 1])
            if beyond + normal[j, 2] * (z - joints[j, 2]) > 0.0:
                found = j
    return found


@kernel
def _first_of(own, group):
    """Return the first segment of a group, or -1."""
    for j in range(group.shape[0]):
        if group[j] == own:
            return j
    return -1


@kernel
def add_volume(
    points, step, limb_count, ball_limb, place, axes, radii, weight, ball_group, group, joints, normal, sums
):  # fmt: skip
    """Add the contents of cells about points (n, 3) to each segment (S, 10): volume, first and second moments.

    A cell counts by the share inside the surface. It belongs to the group of segments with most of its field, and there
    to the last one whose plane it lies beyond. The part of an arm's field on the trunk's side of the shoulder belongs
    to the trunk.
    """
    log_weight, local, share = logarithms(weight), np.empty((radii.shape[0], 3)), np.empty(radii.shape[0])
    top, total, slope = np.empty(limb_count), np.empty(limb_count), np.empty(3)
    held = np.empty(group.max() + 1)
    for i in range(points.shape[0]):
        level = _weigh(points[i], -1, ball_limb, place, axes, radii, log_weight, local, share, top, total)
        _slope(axes, radii, local, share, slope)
        square = slope[0] ** 2 + slope[1] ** 2 + slope[2] ** 2
        inside = min(max(0.5 - distance_of_level(level, square)[0] / step, 0.0), 1.0) * step**3
        if inside <= 0.0:
            continue
        held[:] = 0.0
        for m in range(radii.shape[0]):
            held[ball_group[m]] += share[m]
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        own = int(np.argmax(held))
        k = _last_beyond(x, y, z, own, group, joints, normal)
        if k < 0 and (own == _ARMS[0] or own == _ARMS[1]):
            own = 0
            k = _last_beyond(x, y, z, own, group, joints, normal)
        if k < 0:
            k = _first_of(own, group)
        row = sums[k]
        row[0] += inside
        row[1] += inside * x
        row[2] += inside * y
        row[3] += inside * z
        row[4] += inside * x * x
        row[5] += inside * y * y
        row[6] += inside * z * z
        row[7] += inside * x * y
        row[8] += inside * x * z
        row[9] += inside * y * z
