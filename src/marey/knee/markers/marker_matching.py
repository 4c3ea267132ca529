"""Which of the scanner's balls is which of the laboratory's markers, told by the distances between them."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import gamma, gammaincc

from marey.arrays import Floats, Integers, Mask, freeze_fields
from marey.errors import MareyError
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform

FEWEST = 3
_REACH = 5.0  # standard deviations by which a distance may differ
_LEAST_CHANCE = 1e-6  # of the residuals of a match: one that is less likely is none
_LEAST_OF_THREE = 1e-5  # of three balls, whose few distances are soon alike by chance
_AHEAD = 12.0  # in chi square, by which the best match is better than any other: odds of 400 to 1
_MOST = 4000  # matches of one bone; where so many fit, distances tell nothing
LARGEST_KNEE_TURN = np.radians(75.0)
"""Between the scanner and standing a knee bends by less than this [rad]."""
LARGEST_KNEE_SHIFT_MM = 25.0
"""And its middle, carried by the femur and by the tibia, comes apart by less than this."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Markers:
    """Places of N markers with one standard deviation each."""

    places_mm: Floats
    """(N, 3); NaN where not known."""
    sd_mm: Floats
    """(N,)."""

    def __post_init__(self) -> None:
        freeze_fields(self, "places_mm", "sd_mm")


@dataclass(frozen=True, eq=False, kw_only=True)
class GroupMatch:
    """One way to match the balls of a bone to markers."""

    markers: Integers
    """(M,) the marker of each ball; -1 for a ball without one."""
    chi_square: float
    """Sum of the squared residuals of the rigid fit in their standard deviations."""
    to_from: RigidTransform
    """The markers' frame from the balls' [mm]."""
    by_chance: float
    """How many such matches are to be expected of markers that are none of the balls."""

    def __post_init__(self) -> None:
        freeze_fields(self, "markers", dtype=np.int64)

    @property
    def count(self) -> int:
        """How many balls have a marker."""
        return int((self.markers >= 0).sum())


@dataclass(frozen=True, eq=False, kw_only=True)
class Matching:
    """The match of the balls of all bones."""

    groups: Mapping[str, GroupMatch]
    """By bone."""
    rivals: tuple[tuple[str, tuple[int, ...]], ...]
    """Bone, and balls of it that other markers fit as well: ambiguous; empty where the match is the only one."""
    by_chance: float = 0.0
    """How many such matches are to be expected of markers that are none of the balls: the bones' own, times the share
    of chance poses that make a knee."""


def match_group(balls: Markers, markers: Markers, allowed: Mask) -> list[GroupMatch]:
    """List all matches of one rigid group of balls to markers that leave the fewest balls without a marker.

    A mirror image is none: the fit is a proper rotation, and its residuals must be chance.

    Args:
        balls: M of them.
        markers: N of them.
        allowed: (M, N) which marker a ball may be.

    Returns:
        The best one first; empty where no three balls fit.
    """
    fits = _compatible(balls, markers)
    spread = spread_of(markers, allowed)
    for lost in range(len(balls.places_mm) - FEWEST + 1):
        found = []
        for assignment in _assignments(fits, allowed & np.isfinite(markers.places_mm).all(1), lost):
            group = _fitted(balls, markers, assignment)
            if group is not None:
                found.append(replace(group, by_chance=_by_chance(group, balls, markers, allowed, spread)))
            if len(found) > _MOST:
                raise MareyError("too many markers lie about as the balls do; write marker_names into markers.json")
        if found:
            return sorted(found, key=lambda group: group.chi_square)
    return []


def _compatible(balls: Markers, markers: Markers) -> Mask:
    """Tell for balls b, c and markers A, B whether their distances are alike: (M, M, N, N)."""
    here, there = (np.linalg.norm(m.places_mm[:, None] - m.places_mm, axis=-1) for m in (balls, markers))
    variance = [m.sd_mm[:, None] ** 2 + m.sd_mm**2 for m in (balls, markers)]
    reach = _REACH * np.sqrt(variance[0][:, :, None, None] + variance[1])
    alike = np.abs(here[:, :, None, None] - there) < reach
    different = ~np.eye(len(markers.places_mm), dtype=bool)
    return np.asarray(alike & different)


def _assignments(fits: Mask, allowed: Mask, lost: int) -> Iterator[list[int]]:
    """Give every assignment of markers to balls whose distances are all alike, with so many balls lost."""
    count = len(allowed)

    def extended(assignment: list[int], left: Mask, lost: int) -> Iterator[list[int]]:
        ball = len(assignment)
        if ball == count:
            if lost == 0:
                yield assignment
            return
        for marker in np.flatnonzero(left[ball]).tolist():
            narrowed = left & fits[ball][:, marker]
            if (narrowed[ball + 1 :].any(1)).sum() >= count - ball - 1 - lost:
                yield from extended([*assignment, marker], narrowed, lost)
        if lost:
            yield from extended([*assignment, -1], left, lost - 1)

    yield from extended([], allowed, lost)


def _fitted(balls: Markers, markers: Markers, assignment: Sequence[int]) -> GroupMatch | None:
    """Fit an assignment rigidly; None where its residuals are no chance (a mirror image, chance distances)."""
    pairs = np.array([(ball, marker) for ball, marker in enumerate(assignment) if marker >= 0])
    here, there = balls.places_mm[pairs[:, 0]], markers.places_mm[pairs[:, 1]]
    weight = 1 / (balls.sd_mm[pairs[:, 0]] ** 2 + markers.sd_mm[pairs[:, 1]] ** 2)
    middles = [weight @ each / weight.sum() for each in (here, there)]
    rotation = rotations.nearest((weight[:, None] * (there - middles[1])).T @ (here - middles[0]))
    motion = RigidTransform(rotation, middles[1] - rotation @ middles[0])
    chi_square = float((weight[:, None] * (there - motion.apply(here)) ** 2).sum())
    least = _LEAST_OF_THREE if len(pairs) == FEWEST else _LEAST_CHANCE
    if gammaincc((3 * len(pairs) - 6) / 2, chi_square / 2) < least:
        return None
    return GroupMatch(markers=np.asarray(assignment), chi_square=chi_square, to_from=motion, by_chance=0.0)


def spread_of(markers: Markers, allowed: Mask) -> float:
    """Return the mean distance between the markers that a ball may be."""
    there = markers.places_mm[allowed.any(0) & np.isfinite(markers.places_mm).all(1)]
    count = len(there)
    apart = np.linalg.norm(there[:, None] - there, axis=-1).sum() / max(count * (count - 1), 1)
    return max(float(apart), 1.0)


def _by_chance(group: GroupMatch, balls: Markers, markers: Markers, allowed: Mask, spread_mm: float) -> float:
    """Return how many matches as good as this one are to be expected of as many markers strewn over their spread.

    The number of assignments, times the share of the residuals' space that is as near to none: a ball of as many
    dimensions as coordinates are left over.
    """
    kept = np.flatnonzero(group.markers >= 0)
    assignments = 1.0
    for taken, ball in enumerate(kept):
        assignments *= max(int(allowed[ball].sum()) - taken, 1)
    free = 3 * len(kept) - 6
    variance = (balls.sd_mm[kept] ** 2).mean() + (markers.sd_mm[group.markers[kept]] ** 2).mean()
    radius = np.sqrt(max(group.chi_square, free) * variance)
    return float(assignments * min(_volume(free) * (radius / spread_mm) ** free, 1.0))


def _volume(dimensions: int) -> float:
    """Return the volume of a ball of radius 1."""
    return float(np.pi ** (dimensions / 2) / gamma(dimensions / 2 + 1))


def _share_of_knees(spread_mm: float) -> float:
    """Return the share of chance poses of one bone beside another that make a knee."""
    turns = (LARGEST_KNEE_TURN - np.sin(LARGEST_KNEE_TURN)) / np.pi
    return float(min(turns * _volume(3) * (LARGEST_KNEE_SHIFT_MM / spread_mm) ** 3, 1.0))


def best_matching(
    found: Mapping[str, Sequence[GroupMatch]], knee_mm: Floats, posture: Mapping[str, RigidTransform],
    *, spread_mm: float = 200.0,
) -> Matching:  # fmt: skip
    """Choose one match a bone so that the bones make a knee, and say where others would do as well.

    No marker is on two bones; between the scanner and standing the knee bends by less than `LARGEST_KNEE_TURN`, and
    its middle stays together to `LARGEST_KNEE_SHIFT_MM`.

    Args:
        found: Bone to its matches; bones without any are left out.
        knee_mm: (3,) the middle of the knee in the scanner.
        posture: Bone to the laboratory from the frame in which its markers are given [mm].
        spread_mm: Over what the laboratory's markers are strewn.
    """
    bones = [bone for bone, matches in found.items() if matches]
    ranked = sorted(_joint(bones, found, knee_mm, posture), key=lambda pair: pair[0])
    if not ranked:
        return Matching(groups={}, rivals=())
    least, chosen = ranked[0]
    rivals: dict[str, set[int]] = {}
    for chi_square, other in ranked[1:]:
        if chi_square - least < _AHEAD:
            for bone in bones:
                differ = np.flatnonzero(chosen[bone].markers != other[bone].markers)
                rivals.setdefault(bone, set()).update(differ.tolist())
    told = tuple((bone, tuple(sorted(balls))) for bone, balls in rivals.items() if balls)
    by_chance = float(np.prod([match.by_chance for match in chosen.values()]))
    by_chance *= _share_of_knees(spread_mm) ** (len(chosen) - 1)
    return Matching(groups=chosen, rivals=told, by_chance=by_chance)


def _joint(
    bones: Sequence[str], found: Mapping[str, Sequence[GroupMatch]], knee_mm: Floats,
    posture: Mapping[str, RigidTransform],
) -> Iterator[tuple[float, dict[str, GroupMatch]]]:  # fmt: skip
    """Return the combinations of matches that make a knee, with their chi square."""
    if not bones:
        return
    partial: list[tuple[float, dict[str, GroupMatch]]] = [(0.0, {})]
    for bone in bones:
        partial = [
            (chi_square + match.chi_square, {**others, bone: match})
            for chi_square, others in partial
            for match in found[bone]
            if all(_makes_knee({bone: match, name: other}, knee_mm, posture) for name, other in others.items())
        ]
    yield from partial


def _makes_knee(pair: Mapping[str, GroupMatch], knee_mm: Floats, posture: Mapping[str, RigidTransform]) -> bool:
    first, second = pair.values()
    if set(first.markers[first.markers >= 0].tolist()) & set(second.markers[second.markers >= 0].tolist()):
        return False
    there = [posture[bone] @ match.to_from for bone, match in pair.items()]
    turn = np.linalg.norm((there[0].inverse() @ there[1]).rotation_vector)
    shift = np.linalg.norm(there[0].apply(knee_mm) - there[1].apply(knee_mm))
    return bool(turn < LARGEST_KNEE_TURN and shift < LARGEST_KNEE_SHIFT_MM)
