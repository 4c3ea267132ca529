"""A body whose joints move about axes by functions of its coordinates, as in OpenSim's models."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from marey.arrays import Floats, Integers, Mask, freeze_fields
from marey.body.articulation.coordinate_functions import PackedFunctions, PiecewisePolynomial, pack
from marey.errors import MareyError
from marey.geometry.rigid import RigidTransform


@dataclass(frozen=True, eq=False, kw_only=True)
class ModelCoordinate:
    """One coordinate of a jointed body."""

    name: str
    """Name in the model."""
    rotational: bool = True
    """Whether it is an angle [rad]; else a length [m]."""
    default: float = 0.0
    """Value in the default posture [rad or m]."""
    lower: float = -np.inf
    """Lower limit [rad or m]; infinite if the model does not enforce it."""
    upper: float = np.inf
    """Upper limit [rad or m]; infinite if the model does not enforce it."""
    locked: bool = False
    """Whether it is fixed at its default."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Coupling:
    """A coordinate that is a function of another one."""

    dependent: str
    """Name of the coordinate that follows."""
    independent: str
    """Name of the coordinate that is followed."""
    function: PiecewisePolynomial
    """Value of the dependent coordinate as a function of the independent one."""


@dataclass(frozen=True, eq=False, kw_only=True)
class JointTwist:
    """One rotation or translation of a joint: a twist whose size is a function of a coordinate."""

    turns: bool
    """Whether it is a rotation about the axis through the joint's origin; else it is a translation along the axis."""
    axis: Floats
    """(3,) unit vector, in the frame moved by the twists before this one."""
    coordinate: str | None
    """Name of the coordinate; None if the size is fixed."""
    function: PiecewisePolynomial
    """Size as a function of the coordinate: angle [rad] or distance [m]."""

    def __post_init__(self) -> None:
        freeze_fields(self, "axis")
        if self.axis.shape != (3,) or not abs(np.linalg.norm(self.axis) - 1) < 1e-9:
            raise MareyError(f"The axis {self.axis} is not a unit vector.")


@dataclass(frozen=True, eq=False, kw_only=True)
class ModelBody:
    """A rigid body and the joint that connects it with its parent."""

    name: str
    """Name in the model."""
    parent: str | None
    """None for the ground."""
    joint: str
    """Name of the joint."""
    before: RigidTransform = field(default_factory=RigidTransform.identity)
    """Parent from the joint's frame."""
    motions: tuple[JointTwist, ...] = ()
    """Twists of the joint, from the parent's side to the body's."""
    after: RigidTransform = field(default_factory=RigidTransform.identity)
    """The joint's moved frame from the body."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ModelMarker:
    """A marker on a body."""

    label: str
    """Label of the marker."""
    body: str | None
    """None for the ground."""
    place: Floats
    """(3,) in the body [m]."""

    def __post_init__(self) -> None:
        freeze_fields(self, "place")


class PackedBody(NamedTuple):
    """The body as plain arrays, for the kernels."""

    parents: Integers
    """(B,) -1 for the ground."""
    before_rotation: Floats
    """(B, 3, 3) rotation of `ModelBody.before`."""
    before_translation: Floats
    """(B, 3) translation of `ModelBody.before` [m]."""
    after_rotation: Floats
    """(B, 3, 3) rotation of `ModelBody.after`."""
    after_translation: Floats
    """(B, 3) translation of `ModelBody.after` [m]."""
    first: Integers
    """(B + 1,) first twist of each body."""
    turns: Mask
    """(E,) true for rotations."""
    axes: Floats
    """(E, 3)."""
    coordinate: Integers
    """(E,) index of the coordinate, -1 for a fixed size."""
    motion_functions: PackedFunctions
    """E functions."""
    source: Integers
    """(N,) coordinate that each coordinate follows, -1 for none."""
    coupling_functions: PackedFunctions
    """N functions; that of a coordinate that follows none is unused."""
    order: Integers
    """(N,) coordinates, ordered so that each comes after the one it follows."""


@dataclass(frozen=True, eq=False, kw_only=True)
class JointedBody:
    """B bodies in a tree whose root is the ground, N coordinates, their couplings, and markers."""

    name: str
    """Name of the model."""
    bodies: tuple[ModelBody, ...]
    """Bodies, parents before their children."""
    coordinates: tuple[ModelCoordinate, ...]
    couplings: tuple[Coupling, ...] = ()
    markers: tuple[ModelMarker, ...] = ()

    def __post_init__(self) -> None:
        names = self.body_names
        _all_different(names, "bodies")
        _all_different(self.coordinate_names, "coordinates")
        _all_different(tuple(m.label for m in self.markers), "markers")
        _all_different(tuple(c.dependent for c in self.couplings), "coupled coordinates")
        for k, body in enumerate(self.bodies):
            if body.parent is not None and body.parent not in names[:k]:
                raise MareyError(f"The parent of {body.name!r} is {body.parent!r}, which is not listed before it.")
        used = [m.coordinate for body in self.bodies for m in body.motions if m.coordinate is not None]
        used += [name for c in self.couplings for name in (c.dependent, c.independent)]
        for name in used:
            self.coordinate(name)
        for marker in self.markers:
            if marker.body is not None and marker.body not in names:
                raise MareyError(f"The marker {marker.label!r} is on {marker.body!r}, not a body of the model.")
        self._follow_order()

    @property
    def body_names(self) -> tuple[str, ...]:
        """Names of the B bodies."""
        return tuple(body.name for body in self.bodies)

    @property
    def coordinate_names(self) -> tuple[str, ...]:
        """Names of the N coordinates."""
        return tuple(c.name for c in self.coordinates)

    @property
    def rotational(self) -> Mask:
        """(N,) true for angles."""
        return np.array([c.rotational for c in self.coordinates], bool)

    @property
    def defaults(self) -> Floats:
        """(N,) default posture, with couplings applied [rad or m]."""
        values = np.array([c.default for c in self.coordinates], float)
        return self.coupled(values)

    @property
    def free(self) -> Mask:
        """(N,) true for coordinates that are neither locked nor coupled to another one."""
        follows = {c.dependent for c in self.couplings}
        return np.array([not c.locked and c.name not in follows for c in self.coordinates], bool)

    def coordinate(self, name: str) -> int:
        """Return a coordinate's index.

        Raises:
            MareyError: There is no such coordinate.
        """
        if name not in self.coordinate_names:
            raise MareyError(f"There is no coordinate {name!r}. The model has {', '.join(self.coordinate_names)}.")
        return self.coordinate_names.index(name)

    def marker_bodies(self, labels: Sequence[str]) -> tuple[Integers, Floats]:
        """Return the bodies (M,), -1 for the ground, and the positions (M, 3) on them [m] of some markers."""
        known = {marker.label: marker for marker in self.markers}
        chosen = [known[label] for label in labels]
        index = [-1 if marker.body is None else self.body_names.index(marker.body) for marker in chosen]
        return np.array(index, np.int64), np.array([marker.place for marker in chosen], float).reshape(-1, 3)

    def coupled(self, values: Floats) -> Floats:
        """Apply the couplings to postures (..., N)."""
        values = np.array(values, float)
        packed = self.packed
        functions = {c.dependent: c.function for c in self.couplings}
        for c in packed.order:
            if packed.source[c] >= 0:
                values[..., c] = functions[self.coordinates[c].name].at(values[..., packed.source[c]])[0]
        return values

    def _follow_order(self) -> list[int]:
        """Order the coordinates so that each comes after the one it follows."""
        source = {c.dependent: c.independent for c in self.couplings}
        order: list[int] = []
        waiting = list(self.coordinate_names)
        while waiting:
            ready = [name for name in waiting if source.get(name) not in waiting]
            if not ready:
                raise MareyError(f"The coordinates {', '.join(waiting)} depend on each other in a circle.")
            order += [self.coordinate(name) for name in ready]
            waiting = [name for name in waiting if name not in ready]
        return order

    @cached_property
    def packed(self) -> PackedBody:
        """The body as plain arrays."""
        names = self.body_names
        motions = [m for body in self.bodies for m in body.motions]
        source = np.full(len(self.coordinates), -1, np.int64)
        nothing = PiecewisePolynomial(starts=np.zeros(1), coefficients=np.zeros((1, 1)))
        functions = [nothing] * len(self.coordinates)
        for c in self.couplings:
            source[self.coordinate(c.dependent)] = self.coordinate(c.independent)
            functions[self.coordinate(c.dependent)] = c.function

        def stacked(items: Sequence[Floats], shape: tuple[int, ...]) -> Floats:
            return np.ascontiguousarray(np.array(items, float).reshape(-1, *shape))

        return PackedBody(
            np.array([-1 if b.parent is None else names.index(b.parent) for b in self.bodies], np.int64),
            stacked([b.before.rotation for b in self.bodies], (3, 3)),
            stacked([b.before.translation for b in self.bodies], (3,)),
            stacked([b.after.rotation for b in self.bodies], (3, 3)),
            stacked([b.after.translation for b in self.bodies], (3,)),
            np.concatenate([[0], np.cumsum([len(b.motions) for b in self.bodies])]).astype(np.int64),
            np.array([m.turns for m in motions], bool),
            stacked([m.axis for m in motions], (3,)),
            np.array([-1 if m.coordinate is None else self.coordinate(m.coordinate) for m in motions], np.int64),
            pack([m.function for m in motions]),
            source,
            pack(functions),
            np.array(self._follow_order(), np.int64),
        )


def _all_different(names: tuple[str, ...], what: str) -> None:
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise MareyError(f"Two {what} have the name {', '.join(twice)}.")
