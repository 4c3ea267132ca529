"""Hips of a fitted body, placed by lengths that were measured on the person: they lie where no outline shows them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from marey.arrays import Floats
from marey.body.articulation.skeleton import Skeleton
from marey.body.articulation.surface import Body
from marey.body.people.anthropometry import SPINE_UP_M, SPINE_UP_SHARE
from marey.body.people.departures import JOINT_SD
from marey.body.people.person import JOINT_SHARE

LEG_SD = 0.010
"""Standard deviation of the length from hip to ankle that follows from a leg length [m]. Chosen by hand for the errors
of the regression ([Hara2016]) and of a measurement with a tape."""
SPINES_SD = 0.010
"""Standard deviation of the distance of the hips that follows from that of the spines [m]. Chosen by hand for the
errors of the regression ([Harrington2007]) and of spines that are felt through the skin."""
HELD_SHARE = 0.05
"""Share of a hip's spread among people within which the images may still move it after it was placed. Chosen by hand,
far below `JOINT_SHARE`, so that the fit does not move the hip back; other values were not measured."""
MOST_SD = 4.0
"""A length that differs from that of the body by more than so many standard deviations belongs to another person, or
has another unit. Chosen by hand."""
_LEG = (("thigh", "shank"), ("shank", "foot"))
"""Pieces of the length from hip to ankle, as the segments at whose joint centres they begin and end."""


@dataclass(frozen=True, kw_only=True)
class KnownLengths:
    """Lengths that were measured on the person.

    Attributes:
        leg_m: Leg length, from the anterior superior iliac spine to the medial malleolus [m].
        asis_m: Distance between the anterior superior iliac spines [m].
    """

    leg_m: float | None = None
    asis_m: float | None = None


@dataclass(frozen=True, kw_only=True)
class PlacedHips:
    """A body whose hips were placed by known lengths.

    Attributes:
        body: The body.
        moved_m: By the name of the length, how far each hip was moved [m]: up, or to its side.
        refused: Names of lengths that contradict the images, with the length that the images give [m].
    """

    body: Body
    moved_m: Mapping[str, float]
    refused: Mapping[str, float]


@dataclass(frozen=True, kw_only=True)
class _Length:
    """A length between joint centres that places the hips along one axis.

    Attributes:
        name: What the user measured.
        mode: Name of the number of the shape space that moves both hips along the axis.
        number_sd_m: Its standard deviation among people [m].
        value_m, sd_m: The length between joint centres that follows from the measurement.
        pairs: (n, 2) segments at whose joint centres the pieces begin and end.
        sides: Number of sides to which the pieces belong.
    """

    name: str
    mode: str
    number_sd_m: float
    value_m: float
    sd_m: float
    pairs: Sequence[tuple[int, int]]
    sides: int

    def of(self, body: Body) -> float:
        """Return the length of a body at rest [m]."""
        return sum(float(np.linalg.norm(along)) for along in self._pieces(body.space.joints(body.numbers))) / self.sides

    def by_number(self, body: Body) -> Floats:
        """Return the derivatives (M,) of the length by the numbers of a body [m]."""
        along = self._pieces(body.space.joints(body.numbers))
        unit = along / np.linalg.norm(along, axis=1, keepdims=True)
        return np.asarray(np.einsum("mpa,pa->m", self._pieces(body.space.joint_modes), unit) / self.sides)

    def _pieces(self, joints: Floats) -> Floats:
        start, end = np.array(self.pairs).T
        return np.asarray(joints[..., end, :] - joints[..., start, :])


def hip_to_ankle(leg_length_m: float) -> float:
    """Return the length from hip to ankle, past the knee, that follows from a leg length.

    The spine lies 9 mm and 0.078 of the leg length above the hip's centre ([Hara2016]).

    Args:
        leg_length_m: From the anterior superior iliac spine to the medial malleolus [m].
    """
    return (1 - SPINE_UP_SHARE) * leg_length_m - SPINE_UP_M


def hip_distance(asis_distance_m: float) -> float:
    """Return the distance of the hips that follows from that of the anterior superior iliac spines.

    Each hip lies 7.3 mm and 0.33 of this distance beside the middle ([Harrington2007], by the pelvis width alone).

    Args:
        asis_distance_m: Distance between the anterior superior iliac spines [m].
    """
    return 2 * (0.33 * asis_distance_m + 0.0073)


def can_place_hips(body: Body) -> bool:
    """Return whether the numbers of a body move its hips alone, and both legs are followed."""
    legs = [body.skeleton.segment(f"{side}_{name}") for side in ("left", "right") for name in ("thigh", "shank")]
    followed = body.followed is None or bool(np.asarray(body.followed)[legs].all())
    return followed and {"hip_up", "hip_lateral"} <= set(body.space.names)


def place_hips(body: Body, known: KnownLengths) -> PlacedHips:
    """Place the hips of a fitted body by known lengths.

    Outlines place a hip only by the motion about it, which clothes and soft tissue bias; most of its spread among
    people is therefore left out of the fit (`JOINT_SHARE`) and stated as a possible offset. A known length determines
    a part of this offset: the hips are moved along one axis by the Kalman update with the known length, the skin
    stays, and later fits keep them there.

    Args:
        body: The fitted body.
        known: What was measured on the person.

    Returns:
        The body, with the smaller offsets as standard deviations, and what was done.
    """
    moved, refused = dict[str, float](), dict[str, float]()
    for length in _lengths(known, body.skeleton):
        gap, slope = length.value_m - length.of(body), length.by_number(body)
        fit = 0.0 if body.numbers_covariance is None else float(slope @ body.numbers_covariance @ slope)
        number = body.space.names.index(length.mode)
        # Offset of the hips along the axis that the images do not show, and its part in the length.
        offset = (1 - JOINT_SHARE**2) * length.number_sd_m**2
        per_metre = float(slope[number]) / length.number_sd_m
        total = offset * per_metre**2 + fit + length.sd_m**2
        if abs(gap) > MOST_SD * np.sqrt(total):
            refused[length.name] = length.of(body)
            continue
        gain = offset * per_metre / total
        moved[length.name] = gain * gap
        body = _moved(body, number, gain * gap / length.number_sd_m, less=gain * per_metre * offset)
    return PlacedHips(body=body, moved_m=MappingProxyType(moved), refused=MappingProxyType(refused))


def _moved(body: Body, number: int, by: float, *, less: float) -> Body:
    """Change a number of a body and hold it there; the variance of the hips along its axis becomes smaller [m^2]."""
    numbers = np.array(body.numbers)
    numbers[number] += by
    mean, scale = np.array(body.space.prior_mean), np.ones(len(numbers))
    mean[number] = numbers[number]
    scale[number] = HELD_SHARE / np.sqrt(body.space.prior_covariance[number, number])
    space = replace(
        body.space, prior_mean=mean, prior_covariance=body.space.prior_covariance * np.outer(scale, scale)
    )  # fmt: skip
    sd = body.joint_offset_sd
    if sd is not None:
        sd = np.array(sd)
        hips = [body.skeleton.segment(f"{side}_thigh") for side in ("left", "right")]
        # One standard deviation stands for the three axes.
        sd[hips] = np.sqrt(np.maximum(sd[hips] ** 2 - less / 3, 0.0))
    return replace(body, numbers=numbers, space=space, joint_offset_sd=sd)


def _lengths(known: KnownLengths, skeleton: Skeleton) -> list[_Length]:
    """Return what is known as lengths between joint centres."""
    lateral, _, up = JOINT_SD["hip"]
    found = []
    if known.leg_m is not None:
        pairs = [
            (skeleton.segment(f"{side}_{start}"), skeleton.segment(f"{side}_{end}"))
            for side in ("left", "right") for start, end in _LEG
        ]  # fmt: skip
        found.append(_Length(
            name="leg length", mode="hip_up", number_sd_m=up, value_m=hip_to_ankle(known.leg_m), sd_m=LEG_SD,
            pairs=pairs, sides=2,
        ))  # fmt: skip
    if known.asis_m is not None:
        found.append(_Length(
            name="ASIS distance", mode="hip_lateral", number_sd_m=lateral, value_m=hip_distance(known.asis_m),
            sd_m=SPINES_SD, pairs=[(skeleton.segment("right_thigh"), skeleton.segment("left_thigh"))], sides=1,
        ))  # fmt: skip
    return found
