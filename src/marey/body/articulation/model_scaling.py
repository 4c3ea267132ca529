"""Scale factors and masses of the bodies of a user's model, from the joint centres and masses of a person."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, freeze_fields
from marey.body.articulation.jointed_body import JointedBody
from marey.body.articulation.jointed_kinematics import PlacedBodies, place
from marey.body.articulation.skeleton import JOINT_OF_SEGMENT, PARENTS
from marey.errors import MareyError

_JOINTS = {
    "femur": "hip", "thigh": "hip", "tibia": "knee", "shank": "knee", "talus": "ankle", "foot": "ankle",
    "toes": "toe", "humerus": "shoulder", "upperarm": "shoulder", "ulna": "elbow", "forearm": "elbow", "hand": "wrist",
}  # fmt: skip
"""Joint centre about which a body of common models rotates on the body above it, by the name without its side."""
_SIDED = (re.compile(r"(?P<name>.+)_(?P<side>l|r|left|right)"), re.compile(r"(?P<side>l|r|left|right)_(?P<name>.+)"))
"""Names of bodies that belong to a side."""
_SIDES = {"l": "left", "left": "left", "r": "right", "right": "right"}
"""Side by its abbreviation in the name of a body."""
_HIPS, _SHOULDERS = ("left_hip", "right_hip"), ("left_shoulder", "right_shoulder")
"""Joint centres between which pelvis and trunk are measured."""


@dataclass(frozen=True, eq=False, kw_only=True)
class JointPlaces:
    """The J joint centres of a person in one posture, in which trunk and legs are about straight."""

    names: tuple[str, ...]
    """J names."""
    places: Floats
    """(J, 3) [m]."""
    covariance: Floats
    """(3 J, 3 J) [m2]."""

    def __post_init__(self) -> None:
        freeze_fields(self, "places", "covariance")

    def apart(self, weights: Mapping[str, float]) -> tuple[float, float]:
        """Return the length of a weighted sum of joint centres, whose weights sum to 0, and its deviation [m]."""
        row = np.array([weights.get(name, 0.0) for name in self.names])
        vector = row @ self.places
        length = float(np.linalg.norm(vector))
        slope = np.kron(row, vector / length)
        return length, float(np.sqrt(slope @ self.covariance @ slope))

    def distance(self, first: str, second: str) -> tuple[float, float]:
        """Return the distance of two joint centres and its standard deviation [m]."""
        return self.apart({first: 1.0, second: -1.0})


@dataclass(frozen=True, eq=False, kw_only=True)
class BodyScale:
    """The scale factors of one body of a model."""

    body: str
    """Name of the body."""
    factors: Floats
    """(3,) along the axes of the body."""
    sd: Floats
    """(3,) standard deviations."""
    source: str
    """What was measured, or from where the factors were taken, as a phrase."""
    measured: bool
    """Whether a length of this body was measured."""

    def __post_init__(self) -> None:
        freeze_fields(self, "factors", "sd")


def model_joints(model: JointedBody, given: Mapping[str, str] | None = None) -> dict[str, str]:
    """Find which body of a model rotates about which joint centre of a person.

    Args:
        model: The model.
        given: Maps a joint centre (`left_hip`) to the name of the joint in the model, or of the body that it moves;
            the others are recognised by the names of the bodies in common models (`femur_l`, `tibia_l`, ...).

    Returns:
        Maps a joint centre to the body that rotates about it.

    Raises:
        MareyError: The model has no such joint.
    """
    found: dict[str, str] = {}
    for body in model.bodies:
        match = next((m for pattern in _SIDED if (m := pattern.fullmatch(body.name.lower()))), None)
        if match and match["name"] in _JOINTS:
            found.setdefault(f"{_SIDES[match['side']]}_{_JOINTS[match['name']]}", body.name)
    known = set(JOINT_OF_SEGMENT.values())
    for centre, joint in (given or {}).items():
        bodies = [body.name for body in model.bodies if joint in (body.joint, body.name)]
        if centre not in known:
            raise MareyError(f"There is no joint centre {centre!r}. There are {', '.join(sorted(known))}.")
        if not bodies:
            there = ", ".join(body.joint for body in model.bodies)
            raise MareyError(f"The model has no joint {joint!r} for {centre}. It has {there}.")
        found[centre] = bodies[0]
    return found


def neutral_posture(model: JointedBody) -> Floats:
    """Return the coordinates (N,) of the model's neutral posture: all angles 0, and lengths at their defaults."""
    return model.coupled(np.where(model.rotational, 0.0, [c.default for c in model.coordinates]))


def centre_in_ground(model: JointedBody, placed: PlacedBodies, body: str) -> Floats:
    """Return the centre (3,) of the joint between a body and the one above it [m].

    Args:
        model: The model.
        placed: The model in a posture.
        body: The body.
    """
    k = model.body_names.index(body)
    return np.asarray(placed.rotation[k] @ model.bodies[k].after.inverse().translation + placed.origin[k])


def body_scales(model: JointedBody, joints: Mapping[str, str], person: JointPlaces) -> tuple[BodyScale, ...]:
    """Compute the scale factors of all bodies of a model.

    A body, or several between two joint centres, has one factor: the ratio of their distances in the person and in the
    model's neutral posture. The pelvis has the ratio of the distances of the hips. Along its axes X and Y, the trunk
    has the factor that brings the middle of the shoulders to its distance from the middle of the hips, along Z the
    ratio of the distances of the shoulders. Other bodies take the factors of the body above them; above the pelvis, and
    where that is not measured either, the ratio of the sums of all measured limbs.

    Args:
        model: The model.
        joints: Maps a joint centre to the body that rotates about it, as `model_joints` returns it.
        person: The joint centres of the person.

    Returns:
        The factors in the order of the model's bodies. The standard deviation of factors that were taken from others
        includes the spread of the measured factors.

    Raises:
        MareyError: No body lies between two joint centres that both model and person have.
    """
    return _Scales(model, {n: b for n, b in joints.items() if n in person.names}, person).all()


class _Scales:
    """The factors of one model, found step by step."""

    def __init__(self, model: JointedBody, joints: Mapping[str, str], person: JointPlaces) -> None:
        self.model, self.joints, self.person = model, joints, person
        self.placed = place(model, neutral_posture(model))
        self.parent = {body.name: body.parent for body in model.bodies}
        self.centre_of = {body: name for name, body in joints.items()}
        self.found: dict[str, BodyScale] = {}
        self.limbs: list[tuple[float, float]] = []

    def all(self) -> tuple[BodyScale, ...]:
        for name in self.joints:
            self._limb(name)
        base = self._pelvis()
        if base is not None:
            self._trunk(base)
        if not self.found:
            raise MareyError(
                f"No body of the model lies between two of the joint centres {', '.join(self.person.names)}."
            )
        return tuple(self._inherited(body.name, base) for body in self.model.bodies)

    def _centre(self, name: str) -> Floats:
        return centre_in_ground(self.model, self.placed, self.joints[name])

    def _above(self, body: str) -> list[str]:
        """Return the bodies above a body, up to the first that rotates about a known joint centre, or to the root."""
        chain: list[str] = []
        above = self.parent[body]
        while above is not None:
            chain.append(above)
            above = None if above in self.centre_of else self.parent[above]
        return chain

    def _limb(self, name: str) -> None:
        """Measure the bodies between a joint centre and the one above it."""
        chain = self._above(self.joints[name])
        upper = self.centre_of.get(chain[-1]) if chain else None
        if upper is None or any(body in self.found for body in chain):
            return
        own = float(np.linalg.norm(self._centre(name) - self._centre(upper)))
        length, sd = self.person.distance(upper, name)
        if own > 0:
            self.limbs.append((length, own))
            for body in chain:
                self._add(body, length / own, sd / own, f"distance from {upper} to {name}")

    def _add(self, body: str, factors: float | Floats, sd: float | Floats, source: str) -> None:
        three = np.ones(3)
        self.found[body] = BodyScale(body=body, factors=factors * three, sd=sd * three, source=source, measured=True)

    def _pelvis(self) -> str | None:
        """Measure the body to which both hips belong, and return it."""
        if not all(name in self.joints for name in _HIPS):
            return None
        left, right = (self.parent[self.joints[name]] for name in _HIPS)
        if left is None or left != right:
            return None
        own = float(np.linalg.norm(self._centre(_HIPS[0]) - self._centre(_HIPS[1])))
        if own > 0 and left not in self.found:
            length, sd = self.person.distance(*_HIPS)
            self._add(left, length / own, sd / own, "distance of the hips")
        return left

    def _trunk(self, base: str) -> None:
        """Measure the bodies between the pelvis and the shoulders."""
        if base not in self.found or not all(name in self.joints for name in _SHOULDERS):
            return
        chains = [self._above(self.joints[name]) for name in _SHOULDERS]
        if any(base not in chain for chain in chains):
            return
        bodies = list(dict.fromkeys(b for chain in chains for b in chain[: chain.index(base)] if b not in self.found))
        common = [b for b in bodies if all(b in chain for chain in chains)]
        if not common:
            return
        start = centre_in_ground(self.model, self.placed, common[-1])
        hips, shoulders = (sum(self._centre(n) for n in pair) / 2 for pair in (_HIPS, _SHOULDERS))
        length, sd = self.person.apart(dict.fromkeys(_SHOULDERS, 0.5) | dict.fromkeys(_HIPS, -0.5))
        pelvis = self.found[base]
        along = _reach(pelvis.factors * (start - hips), shoulders - start, length)
        if along is None:
            return
        reached = pelvis.factors * (start - hips) + along * (shoulders - start)
        slope = float(reached @ (shoulders - start))
        along_sd = np.hypot(length * sd, float(reached @ (start - hips)) * pelvis.sd[0]) / abs(slope)
        own = float(np.linalg.norm(self._centre(_SHOULDERS[0]) - self._centre(_SHOULDERS[1])))
        width, width_sd = self.person.distance(*_SHOULDERS)
        factors = np.array([along, along, width / own])
        for body in bodies:
            self._add(
                body, factors, np.array([along_sd, along_sd, width_sd / own]),
                "distance from the hips to the shoulders, and of the shoulders",
            )  # fmt: skip

    def _inherited(self, body: str, base: str | None) -> BodyScale:
        """Return the factors of a body that was measured, or take them from others."""
        if body in self.found:
            return self.found[body]
        above = self.parent[body]
        measured = list(self.found.values())
        spread = np.std([np.mean(scale.factors) for scale in measured], ddof=1) if len(measured) > 1 else 0.0
        if above is not None and above != base:
            taken = self._inherited(above, base)
            factors, sd, source = taken.factors, taken.sd, f"not measured: as {above}"
            spread = spread if taken.measured else 0.0
        elif self.limbs:
            person, own = np.sum(self.limbs, 0)
            factors, sd, source = np.full(3, person / own), np.zeros(3), "not measured: as the sum of the limbs"
        else:
            factors = np.mean([scale.factors for scale in measured], 0)
            sd, source = np.zeros(3), "not measured: mean of the measured factors"
        return BodyScale(body=body, factors=factors, sd=np.hypot(sd, spread), source=source, measured=False)


def _reach(first: Floats, second: Floats, length: float) -> float | None:
    """Return the positive factor of a second vector with which the sum has a length; None if there is none."""
    a, b, c = second @ second, first @ second, first @ first - length**2
    under = b * b - a * c
    factor = (-b + np.sqrt(under)) / a if under >= 0 and a > 0 else -1.0
    return float(factor) if factor > 0 else None


def masses_by_group(
    model: JointedBody, joints: Mapping[str, str], own: Mapping[str, float], segments: Mapping[str, float]
) -> dict[str, float]:
    """Distribute the masses of a person's segments over the bodies of a model.

    A segment of the person and a body of the model belong to the last joint centre above them that both have; the mass
    of the segments of a joint centre is distributed over its bodies as their masses in the model are. Where the model
    has no mass, the mass goes to the joint centre above.

    Args:
        model: The model.
        joints: Maps a joint centre to the body that rotates about it.
        own: The masses of the model's bodies [kg].
        segments: The masses of the person's segments [kg].

    Returns:
        The mass of each body [kg].

    Raises:
        MareyError: The model has no masses.
    """
    centre_of = {body: name for name, body in joints.items()}
    groups: dict[str | None, list[str]] = {}
    for body in model.bodies:
        groups.setdefault(_group_of_body(model, body.name, centre_of), []).append(body.name)
    weight = {group: sum(own.get(body, 0.0) for body in bodies) for group, bodies in groups.items()}
    if not sum(weight.values()) > 0:
        raise MareyError("The bodies of the model have no masses.")
    total = dict.fromkeys(groups, 0.0)
    heaviest = max(weight, key=lambda group: weight[group])
    for name, mass in segments.items():
        group = next((centre for centre in _centres_above(name) if weight.get(centre, 0.0) > 0), None)
        total[group if weight.get(group, 0.0) > 0 else heaviest] += mass
    return {
        body: total[group] * own.get(body, 0.0) / weight[group] if weight[group] > 0 else 0.0
        for group, bodies in groups.items() for body in bodies
    }  # fmt: skip


def _centres_above(segment: str) -> Sequence[str]:
    """Return the joint centres of a segment and of those above it, the nearest first."""
    names: list[str] = []
    at: str | None = segment
    while at is not None:
        if at in JOINT_OF_SEGMENT:
            names.append(JOINT_OF_SEGMENT[at])
        at = PARENTS[at]
    return names


def _group_of_body(model: JointedBody, body: str, centre_of: Mapping[str, str]) -> str | None:
    """Return the last joint centre above a body; None for those between pelvis and head."""
    parent = {b.name: b.parent for b in model.bodies}
    at: str | None = body
    while at is not None:
        if at in centre_of:
            return centre_of[at]
        at = parent[at]
    return None


def scaled_to(own: Mapping[str, float], total: float) -> dict[str, float]:
    """Scale the masses of a model to a total [kg], which keeps their distribution.

    Args:
        own: The masses of the model's bodies [kg].
        total: The mass of the person [kg].

    Raises:
        MareyError: The model has no masses.
    """
    whole = sum(own.values())
    if not whole > 0:
        raise MareyError("The bodies of the model have no masses.")
    return {body: mass * total / whole for body, mass in own.items()}
