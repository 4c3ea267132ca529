"""The floor, up and heading of a captured person whose world is only about upright.

Heels and balls of the feet that stand still lie on the floor. A person who does not fall is balanced: the centre of
mass is above the feet on average, also of one who leans. Both determine up, together with the trunk.
"""

from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Floats, Integers, freeze_fields
from marey.fit.cameras.from_joints import LEAST_WAY, way_of
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform
from marey.motion.planted_feet import STANCE_DEFAULTS, StanceSettings, standing

CONTACT_SD_M = 0.006
"""Standard deviation of the height of a heel or ball that stands on the floor, in one stance [m]."""
SOLE_SD_M = 0.012
"""Standard deviation of the constant error of the height of each heel and ball [m]: soles, shoes and the shape of the
body's feet."""
BALANCE_SD_M = (0.02, 0.04)
"""Standard deviations of the mean horizontal distance of the centre of mass from the middle of the planted soles, to
the right and ahead [m]."""
LOADS = (0.60, 0.32, 0.08)
"""Shares of the load of a foot that stands flat on heel, ball and toes [Cavanagh1987]: 60.5 % heel, 7.8 % midfoot,
28.1 % forefoot, and 3.6 % toes; that of the midfoot is divided between the two others."""
WALKING_BALANCE_SD_M = 0.3
"""The latter in a walk, in which the body is ahead of the planted foot or behind it [m]."""
TRUNK_SD_RAD = np.radians(4.0)
"""Standard deviation of the mean lean of the line from the ankles to the shoulders [rad]."""
FLOOR_SD_M = 0.01
"""Standard deviation of the error that the heights of all heels and balls share [m]: the soles of the captured bodies
of three rendered takes are 0 to 12 mm above the true floor."""
BOUNCE_STEP_S = 0.067
"""Distance of the instants between which accelerations are taken [s]. Chosen by hand."""
LEAST_BOUNCE_M_S2 = 4.0
"""Least acceleration of a person who jumps, root mean square along its main direction [m/s2]: 8.6 in `jacks`, 1.4 in
`walk`."""
BOUNCE_SD_RAD = np.radians(2.0)
"""Standard deviation of the main direction of the accelerations of a person who jumps [rad]."""
_UPRIGHT = 0.9
"""Least cosine of the angle between that direction and up. Chosen by hand."""
ABOVE_FLOOR_M, BELOW_FLOOR_M = 0.012, 0.04
"""Heights above and below the floor at which a stance has a quarter of its weight [m]. Chosen by hand: a heel that is
raised stays in place, but no foot stands below the floor."""
FIRST_WIDER = 8.0
"""Factor of these heights at first, while the floor is not known. Chosen by hand."""
FIRST_HEIGHT_M = 0.4
"""Largest height of a planted foot above the lowest ones while up is known to some degrees only [m]."""
WORLD_ROUNDS = 8
"""Number of times that stances and the floor are estimated in turn."""
LEAST_STANCES = 3
"""Least number of stances of heels and balls, which a plane needs."""
LOW_SHARE = 10.0
"""Percentile of the heights of heels and balls that is near the floor."""
_UNKNOWNS = 9
"""Two tilts of up, the height of the floor, and the error of each of six heels, balls and toes."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CapturedPerson3d:
    """What the world is found from, in K frames of a capture [m]."""

    time: Floats
    """(K,) [s]."""
    soles: Floats
    """(K, 6, 3) middle of the undersides of the heel, ball and toes of the left foot, then of the right one."""
    mass: Floats
    """(K, 3) centre of mass."""
    trunk: Floats
    """(K, 3) from the middle of the ankles to that of the shoulders."""
    hips: Floats
    """(K, 3) middle of the hips."""
    right: Floats
    """(K, 3) from the left to the right hip."""

    def __post_init__(self) -> None:
        freeze_fields(self, "time", "soles", "mass", "trunk", "hips", "right")

    def moved(self, motion: RigidTransform) -> "CapturedPerson3d":
        """Return the person in another world."""
        places = {name: motion.apply(getattr(self, name)) for name in ("soles", "mass", "hips")}
        return replace(self, **places, **{name: getattr(self, name) @ motion.rotation.T for name in ("trunk", "right")})


@dataclass(frozen=True, eq=False, kw_only=True)
class PlantedWorld:
    """A world with Z up, the floor at 0, Y along the way or ahead of a standing person, and how well it is known."""

    world_from_capture: RigidTransform
    up_sd: float
    """Standard deviation of up, of the worse tilt [rad]."""
    floor_sd: float
    """Standard deviation of the floor's height under the person [m]."""
    heading_sd: float
    """Standard deviation of the heading [rad]."""
    walked: bool
    """Whether the person walks, so that the way sets the heading."""
    backwards: bool
    """Whether the person walks backwards."""
    stances: int
    """Number of stances of heels and balls on the floor."""


@dataclass(frozen=True, eq=False)
class _Stances:
    """Stances of heels and balls."""

    place: Floats
    """(n, 3) [m]."""
    which: Integers
    """(n,) number of the heel or ball."""
    number: Integers
    """(K, 6) number of the stance of each heel, ball and toes in each frame, -1 for none."""


def planted_world(person: CapturedPerson3d) -> PlantedWorld | None:
    """Find floor, up and heading.

    Args:
        person: The person, in a world that is upright to about 20 degrees.

    Returns:
        The world; None if the feet stand still too seldom.
    """
    world = _faced(person)
    for number in range(WORLD_ROUNDS):
        now = person.moved(world)
        height = STANCE_DEFAULTS.largest_height_m if number >= WORLD_ROUNDS // 2 else FIRST_HEIGHT_M
        stances = _stances(now, replace(STANCE_DEFAULTS, largest_height_m=height))
        if len(stances.place) < LEAST_STANCES:
            return None
        values, covariance = _tilt_and_floor(now, stances, walked=_walks(now))
        world = _levelled(values, now) @ world
    return _described(person, world, covariance, len(stances.place))


def _faced(person: CapturedPerson3d) -> RigidTransform:
    """Return the rotation about Z after which the hips are along X, on average."""
    right = np.mean(person.right, axis=0)
    turn = rotations.about(np.array([0.0, 0.0, 1.0]), np.asarray(-np.arctan2(right[1], right[0])))
    return RigidTransform(turn, np.zeros(3))


def _walks(person: CapturedPerson3d) -> bool:
    height = float(np.median(person.trunk[:, 2]))
    return bool(np.linalg.norm(way_of(person.hips)[:2]) > LEAST_WAY * height)


def _stances(person: CapturedPerson3d, settings: StanceSettings) -> _Stances:
    """Find the stances of heels and balls that are near the lowest ones."""
    ground = float(np.percentile(person.soles[..., 2], LOW_SHARE))
    number = np.full(person.soles.shape[:2], -1)
    places: list[Floats] = []
    which: list[int] = []
    for k in range(person.soles.shape[1]):
        for rows in standing(person.time, person.soles[:, k], ground, settings):
            number[rows, k] = len(places)
            places.append(np.median(person.soles[rows, k], axis=0))
            which.append(k)
    return _Stances(np.array(places).reshape(-1, 3), np.array(which, int), number)


def _tilt_and_floor(person: CapturedPerson3d, stances: _Stances, *, walked: bool) -> tuple[Floats, Floats]:
    """Return the slopes (2,) of the horizon along X and Y and the floor's height [m], and their covariance (3, 3).

    Up is (a, b, 1): a stance at (x, y, z) satisfies a x + b y + z = h + error of its heel or ball. A stance above the
    floor, such as a raised heel, has less weight, also in the base of support.
    """
    middle = np.mean(person.hips, axis=0)
    rows = np.zeros((len(stances.place), _UNKNOWNS))
    rows[:, :2], rows[:, 2] = stances.place[:, :2] - middle[:2], -1.0
    rows[np.arange(len(rows)), 3 + stances.which] = -1.0
    heights = stances.place[:, 2]
    values: Floats = np.zeros(_UNKNOWNS)
    weight: Floats = np.ones(len(rows))
    for number in range(WORLD_ROUNDS):
        evidence = _upright(person, stances, values[:2], walked=walked)
        prior, expected = _known_before(evidence)
        information = prior + (rows.T * weight) @ rows / CONTACT_SD_M**2
        values = np.linalg.solve(information, expected - rows.T @ (weight * heights) / CONTACT_SD_M**2)
        weight = _on_floor(rows[:, :3] @ values[:3] + heights, wider=FIRST_WIDER ** (1 - number / (WORLD_ROUNDS - 1)))
    covariance = np.linalg.inv(information)[:3, :3] * _misfit(evidence, values)
    covariance[2, 2] += FLOOR_SD_M**2
    return values[:3], covariance


def _on_floor(above: Floats, *, wider: float = 1.0) -> Floats:
    """Return the weights of heels, balls and toes at heights above the floor [m], in a wider zone at first."""
    scale = wider * np.where(above > 0, ABOVE_FLOOR_M, BELOW_FLOOR_M)
    return np.asarray(1.0 / (1.0 + (above / scale) ** 2) ** 2)


_Evidence = list[tuple[Floats, Floats]]
"""Slopes (2,) of up, and their standard deviations (2,)."""


def _known_before(evidence: _Evidence) -> tuple[Floats, Floats]:
    """Return what evidence of up and the body determine of the unknowns: normal matrix (9, 9), right side (9,)."""
    sd = np.array([np.inf, np.inf, 1e3, *[SOLE_SD_M] * 6])
    matrix, right = np.diag(sd**-2.0), np.zeros(_UNKNOWNS)
    for slope, own in evidence:
        matrix[[0, 1], [0, 1]] += own**-2.0
        right[:2] += slope * own**-2.0
    return matrix, right


def _upright(person: CapturedPerson3d, stances: _Stances, slopes: Floats, *, walked: bool) -> _Evidence:
    """Return up by balance, trunk and bounces, given the present slopes (2,) of the horizon."""
    heights = person.soles @ np.array([*slopes, 1.0])
    lowest = np.repeat(heights.reshape(-1, 2, 3).min(axis=2), 3, axis=1)
    share = (stances.number >= 0) * _on_floor(heights - lowest) * np.tile(LOADS, 2)
    some = np.flatnonzero(share.sum(axis=1) > 0)
    base = np.einsum("ks,ksd->kd", share[some], person.soles[some]) / share[some].sum(axis=1)[:, None]
    raised = np.mean(person.mass[some] - base, axis=0)
    trunk = np.median(person.trunk, axis=0)
    balance = np.array([BALANCE_SD_M[0], WALKING_BALANCE_SD_M if walked else BALANCE_SD_M[1]]) / raised[2]
    return [(raised[:2] / raised[2], balance), (trunk[:2] / trunk[2], np.full(2, TRUNK_SD_RAD)), _bounces(person)]


def _misfit(evidence: _Evidence, values: Floats) -> float:
    """Return by what the evidence of up and of the soles differs from the result, relative to its variance; at least 1.

    Feet at different heights, as on a step, and a person who leans contradict each other.
    """
    square = sum(float(np.sum(((slope - values[:2]) / own) ** 2)) for slope, own in evidence)
    square += float(np.sum((values[3:] / SOLE_SD_M) ** 2))
    count = 2 * sum(bool(np.isfinite(own).all()) for _, own in evidence) + len(values) - 3
    return max(1.0, square / (count - 3))


def _bounces(person: CapturedPerson3d) -> tuple[Floats, Floats]:
    """Return the slopes (2,) of the main direction of the accelerations of the centre of mass, and their deviations.

    A person who jumps is accelerated up and down much more than to the sides.
    """
    interval = float(np.median(np.diff(person.time)))
    step = max(round(BOUNCE_STEP_S / interval), 1)
    change = person.mass[2 * step :] - 2 * person.mass[step:-step] + person.mass[: -2 * step]
    acceleration = change / (step * interval) ** 2
    values, vectors = np.linalg.eigh(acceleration.T @ acceleration / max(len(change), 1))
    main = vectors[:, 2]
    if values[2] < LEAST_BOUNCE_M_S2**2 or abs(main[2]) < _UPRIGHT:
        return np.zeros(2), np.full(2, np.inf)
    ratio = max(float(values[1] / values[2]), 0.0)
    return main[:2] / main[2], np.full(2, np.hypot(BOUNCE_SD_RAD, 0.5 * np.sqrt(ratio)) / (1 - ratio))


def _levelled(values: Floats, person: CapturedPerson3d) -> RigidTransform:
    """Return the motion that makes the horizon level and the floor 0, about the place of the person."""
    middle = np.mean(person.hips, axis=0) * [1.0, 1.0, 0.0]
    up = np.array([values[0], values[1], 1.0])
    turn = rotations.shortest(up / np.linalg.norm(up), np.array([0.0, 0.0, 1.0]))
    floor = values[2] / np.linalg.norm(up)
    return RigidTransform(turn, middle - turn @ middle - np.array([0.0, 0.0, floor]))


JOINT_SD_M = 0.01
"""Standard deviation of a captured joint, per axis, as far as it is constant [m]: joints of rendered takes are 6 to
14 mm off."""


def _described(person: CapturedPerson3d, world: RigidTransform, covariance: Floats, stances: int) -> PlantedWorld:
    """Turn the world to the heading, place the origin below the person, and state the standard deviations."""
    now = person.moved(world)
    way, walked = way_of(now.hips), _walks(now)
    right = np.mean(now.right, axis=0)
    facing = np.arctan2(right[1], right[0])
    ahead = np.arctan2(way[1], way[0]) - np.pi / 2 if walked else facing
    backwards = walked and np.cos(ahead - facing) < 0
    turn = rotations.about(np.array([0.0, 0.0, 1.0]), np.asarray(-(ahead + np.pi * backwards)))
    origin = turn @ (np.median(now.hips, axis=0) * [1.0, 1.0, 0.0])
    length = np.linalg.norm(way[:2]) if walked else np.linalg.norm(right)
    return PlantedWorld(
        world_from_capture=RigidTransform(turn, -origin) @ world, walked=walked, backwards=bool(backwards),
        up_sd=float(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1])), floor_sd=float(np.sqrt(covariance[2, 2])),
        heading_sd=float(np.sqrt(2) * JOINT_SD_M / length), stances=stances,
    )  # fmt: skip
