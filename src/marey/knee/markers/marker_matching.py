"""BallMatching of the scanner's balls to the laboratory's markers by the distances between them."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import gamma, gammaincc

from marey.arrays import Floats, Integers, Mask, freeze_fields
from marey.errors import MareyError
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform

FEWEST = 3
"""Fewest balls of a match: fewer determine no rigid motion."""


@dataclass(frozen=True, kw_only=True)
class MarkerMatchingSettings:
    """Settings for matching balls to markers by their distances.

    Values without a stated source were chosen by hand.
    """

    reach: float = 5.0
    """Number of standard deviations by which a distance may differ."""
    least_probability: float = 1e-6
    """Least probability of the residuals of a match."""
    least_probability_of_three: float = 1e-5
    """The same for three balls, whose few distances agree more easily by chance."""
    clear_difference: float = 12.0
    """Difference of chi square by which the best match is better than any other: odds of 400 to 1."""
    most_matches: int = 4000
    """Largest number of matches of one bone; where so many fit, distances cannot decide."""
    most_knee_rotation: float = float(np.radians(75.0))
    """Largest rotation [rad] of the knee between the scanner and standing."""
    most_knee_shift_mm: float = 25.0
    """Largest distance [mm] of the knee's middle, mapped by the femur, from the same mapped by the tibia."""


MARKER_MATCHING_DEFAULTS = MarkerMatchingSettings()
"""Default settings for matching balls to markers by their distances."""


@dataclass(frozen=True, eq=False, kw_only=True)
class MarkerPositions:
    """Positions of N markers with one standard deviation each."""

    places_mm: Floats
    """(N, 3); NaN where unknown."""
    sd_mm: Floats
    """(N,) standard deviations of a coordinate."""

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
    """Expected number of such matches by chance, with markers that are none of the balls."""

    def __post_init__(self) -> None:
        freeze_fields(self, "markers", dtype=np.int64)

    @property
    def count(self) -> int:
        """Number of balls with a marker."""
        return int((self.markers >= 0).sum())


@dataclass(frozen=True, eq=False, kw_only=True)
class BallMatching:
    """The match of the balls of all bones."""

    groups: Mapping[str, GroupMatch]
    """By bone."""
    rivals: tuple[tuple[str, tuple[int, ...]], ...]
    """Bone, and its balls that other markers fit as well; empty where the match is unambiguous."""
    by_chance: float = 0.0
    """Expected number of such matches by chance: the product of those of the bones, times the share of chance poses
    that form a knee."""


def match_group(
    balls: MarkerPositions,
    markers: MarkerPositions,
    allowed: Mask,
    *,
    settings: MarkerMatchingSettings = MARKER_MATCHING_DEFAULTS,
) -> list[GroupMatch]:
    """Return all matches of one rigid group of balls to markers with the fewest balls without a marker.

    A mirror image is no match: the fit is a proper rotation, whose residuals must be explained by noise.

    Args:
        balls: M of them.
        markers: N of them.
        allowed: (M, N) whether a ball may be a marker.
        settings: Tuned constants of the algorithm.

    Returns:
        The best one first; empty where no three balls fit.
    """
    fits = _compatible(balls, markers, settings=settings)
    spread = spread_of(markers, allowed)
    for lost in range(len(balls.places_mm) - FEWEST + 1):
        found = []
        for assignment in _assignments(fits, allowed & np.isfinite(markers.places_mm).all(1), lost):
            group = _fitted(balls, markers, assignment, settings=settings)
            if group is not None:
                found.append(replace(group, by_chance=_by_chance(group, balls, markers, allowed, spread)))
            if len(found) > settings.most_matches:
                raise MareyError(
                    "too many markers of the laboratory are arranged like those of the scanner; write marker_names "
                    "into markers.json"
                )
        if found:
            return sorted(found, key=lambda group: group.chi_square)
    return []


def _compatible(balls: MarkerPositions, markers: MarkerPositions, *, settings: MarkerMatchingSettings) -> Mask:
    """Return whether the distances of balls b, c and markers A, B agree: (M, M, N, N)."""
    here, there = (np.linalg.norm(m.places_mm[:, None] - m.places_mm, axis=-1) for m in (balls, markers))
    variance = [m.sd_mm[:, None] ** 2 + m.sd_mm**2 for m in (balls, markers)]
    reach = settings.reach * np.sqrt(variance[0][:, :, None, None] + variance[1])
    similar = np.abs(here[:, :, None, None] - there) < reach
    different = ~np.eye(len(markers.places_mm), dtype=bool)
    return np.asarray(similar & different)


def _assignments(fits: Mask, allowed: Mask, lost: int) -> Iterator[list[int]]:
    """Yield every assignment of markers to balls whose distances all agree, with a given number of balls unmatched."""
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


def _fitted(
    balls: MarkerPositions, markers: MarkerPositions, assignment: Sequence[int], *, settings: MarkerMatchingSettings
) -> GroupMatch | None:
    """Fit an assignment rigidly; None where noise does not explain its residuals (a mirror image, chance distances)."""
    pairs = np.array([(ball, marker) for ball, marker in enumerate(assignment) if marker >= 0])
    here, there = balls.places_mm[pairs[:, 0]], markers.places_mm[pairs[:, 1]]
    weight = 1 / (balls.sd_mm[pairs[:, 0]] ** 2 + markers.sd_mm[pairs[:, 1]] ** 2)
    middles = [weight @ each / weight.sum() for each in (here, there)]
    rotation = rotations.nearest((weight[:, None] * (there - middles[1])).T @ (here - middles[0]))
    motion = RigidTransform(rotation, middles[1] - rotation @ middles[0])
    chi_square = float((weight[:, None] * (there - motion.apply(here)) ** 2).sum())
    least = settings.least_probability_of_three if len(pairs) == FEWEST else settings.least_probability
    if gammaincc((3 * len(pairs) - 6) / 2, chi_square / 2) < least:
        return None
    return GroupMatch(markers=np.asarray(assignment), chi_square=chi_square, to_from=motion, by_chance=0.0)


def spread_of(markers: MarkerPositions, allowed: Mask) -> float:
    """Return the mean distance between the markers that a ball may be."""
    there = markers.places_mm[allowed.any(0) & np.isfinite(markers.places_mm).all(1)]
    count = len(there)
    apart = np.linalg.norm(there[:, None] - there, axis=-1).sum() / max(count * (count - 1), 1)
    return max(float(apart), 1.0)


def _by_chance(
    group: GroupMatch, balls: MarkerPositions, markers: MarkerPositions, allowed: Mask, spread_mm: float
) -> float:
    """Return the expected number of equally good matches with as many random markers over the same extent.

    It is the number of assignments, times the share of the space of residuals that is as near to zero: a ball with one
    dimension per degree of freedom.
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


def _share_of_knees(spread_mm: float, *, settings: MarkerMatchingSettings) -> float:
    """Return the share of random poses of one bone relative to another that form a knee."""
    turns = (settings.most_knee_rotation - np.sin(settings.most_knee_rotation)) / np.pi
    return float(min(turns * _volume(3) * (settings.most_knee_shift_mm / spread_mm) ** 3, 1.0))


def best_matching(
    found: Mapping[str, Sequence[GroupMatch]], knee_mm: Floats, posture: Mapping[str, RigidTransform],
    *, spread_mm: float = 200.0, settings: MarkerMatchingSettings = MARKER_MATCHING_DEFAULTS
) -> BallMatching:  # fmt: skip
    """Choose one match per bone so that the bones form a knee, and report where others fit as well.

    No marker is on two bones; between the scanner and standing the knee rotates by less than `most_knee_rotation`, and
    its middle stays together to `most_knee_shift_mm`.

    Args:
        found: Bone to its matches; bones without any are ignored.
        knee_mm: (3,) the middle of the knee in the scanner.
        posture: Bone to the laboratory from the frame in which its markers are given [mm].
        spread_mm: Mean distance between the laboratory's markers.
        settings: Tuned constants of the algorithm.
    """
    bones = [bone for bone, matches in found.items() if matches]
    ranked = sorted(_joint(bones, found, knee_mm, posture, settings=settings), key=lambda pair: pair[0])
    if not ranked:
        return BallMatching(groups={}, rivals=())
    least, chosen = ranked[0]
    rivals: dict[str, set[int]] = {}
    for chi_square, other in ranked[1:]:
        if chi_square - least < settings.clear_difference:
            for bone in bones:
                differ = np.flatnonzero(chosen[bone].markers != other[bone].markers)
                rivals.setdefault(bone, set()).update(differ.tolist())
    ambiguous = tuple((bone, tuple(sorted(balls))) for bone, balls in rivals.items() if balls)
    by_chance = float(np.prod([match.by_chance for match in chosen.values()]))
    by_chance *= _share_of_knees(spread_mm, settings=settings) ** (len(chosen) - 1)
    return BallMatching(groups=chosen, rivals=ambiguous, by_chance=by_chance)


def _joint(
    bones: Sequence[str], found: Mapping[str, Sequence[GroupMatch]], knee_mm: Floats,
    posture: Mapping[str, RigidTransform], *, settings: MarkerMatchingSettings
) -> Iterator[tuple[float, dict[str, GroupMatch]]]:  # fmt: skip
    """Yield the combinations of matches that form a knee, with their chi square."""
    if not bones:
        return
    partial: list[tuple[float, dict[str, GroupMatch]]] = [(0.0, {})]
    for bone in bones:
        partial = [
            (chi_square + match.chi_square, {**others, bone: match})
            for chi_square, others in partial
            for match in found[bone]
            if all(
                _makes_knee({bone: match, name: other}, knee_mm, posture, settings=settings)
                for name, other in others.items()
            )
        ]
    yield from partial


def _makes_knee(
    pair: Mapping[str, GroupMatch],
    knee_mm: Floats,
    posture: Mapping[str, RigidTransform],
    *,
    settings: MarkerMatchingSettings,
) -> bool:
    first, second = pair.values()
    if set(first.markers[first.markers >= 0].tolist()) & set(second.markers[second.markers >= 0].tolist()):
        return False
    there = [posture[bone] @ match.to_from for bone, match in pair.items()]
    turn = np.linalg.norm((there[0].inverse() @ there[1]).rotation_vector)
    shift = np.linalg.norm(there[0].apply(knee_mm) - there[1].apply(knee_mm))
    return bool(turn < settings.most_knee_rotation and shift < settings.most_knee_shift_mm)
