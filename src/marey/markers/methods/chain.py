"""A chain of bones made from a trial: joints with one to six degrees of freedom, and how far the bones are off them."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from marey.arrays import Floats, frozen
from marey.errors import MareyError
from marey.geometry import rotations

FAST_M = 1e-4
"""A joint held fast holds to this standard deviation [m]; markers, which are off by millimetres, then part its bones by
micrometres."""
LEVER_M = 0.1
"""A held turn counts like the gap that it makes at this distance [m]."""
PARAMETERS = 10
"""Of a joint: its centre in the parent (3) and in the child (3), its axes in the parent (2) and in the child (2)."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ChainJoint:
    """A joint between two bones."""

    parent: str
    child: str
    degrees_of_freedom: int = 3
    """1 a hinge; 2 a turn about an axis of the parent, then about one of the child; 3 a ball joint; 4 and 5 a ball
    joint whose centre also glides along the one or two directions in which it moves most; 6 holds nothing, or softly.
    """
    sd_m: float | None = None
    """Standard deviation of the gap between the bones' joint centres along each held direction [m]; None holds it
    fast, and leaves a joint of six degrees quite free. With six degrees it holds all three directions, softly."""
    sd_rad: float | None = None
    """The same of the held turns of a joint of one or two degrees, and with six degrees of every turn out of the known
    posture [rad]."""
    centre: Floats | None = None
    """(3,) in the parent's frame [m], from landmarks or a functional trial; the known postures then say where it is in
    the child. None estimates both over the trial."""
    axis: Floats | None = None
    """(3,) of one or two degrees, in the parent's frame; None estimates it over the trial."""

    def __post_init__(self) -> None:
        if self.degrees_of_freedom not in range(1, 7):
            raise MareyError(
                f"The joint of {self.parent} and {self.child} has {self.degrees_of_freedom} degrees of freedom; "
                "a joint has 1 to 6."
            )
        for name, sd in (("sd_m", self.sd_m), ("sd_rad", self.sd_rad)):
            if sd is not None and not 0 < sd < np.inf:
                raise MareyError(f"The joint of {self.parent} and {self.child} has {name} {sd}; it should be above 0.")
        for name in ("centre", "axis"):
            given = getattr(self, name)
            if given is not None:
                values = frozen(given)
                if values.shape != (3,) or not np.isfinite(values).all() or (name == "axis" and not values.any()):
                    raise MareyError(f"The {name} of the joint of {self.parent} and {self.child} is no vector.")
                object.__setattr__(self, name, values)

    @property
    def held_shifts(self) -> int:
        """Along how many directions the centre is held."""
        if self.degrees_of_freedom < 6:
            return min(3, 6 - self.degrees_of_freedom)
        return 0 if self.sd_m is None else 3

    @property
    def held_turns(self) -> int:
        """How many turns are held."""
        if self.degrees_of_freedom < 6:
            return max(0, 3 - self.degrees_of_freedom)
        return 0 if self.sd_rad is None else 3


class JointPlace(NamedTuple):
    """Where a joint is, as far as known."""

    in_parent: Floats
    """(3,) its centre [m]."""
    in_child: Floats
    """(3,) the same in the child's frame [m]."""
    axis: Floats
    """(3,) unit, the axis of the first turn, in the parent."""
    second: Floats
    """(3,) unit, the axis of the second turn, fixed to the child, as the parent sees it in the known posture."""
    held: Floats
    """(h, 3) orthonormal directions of the parent along which the centre is held."""
    neutral: Floats
    """(3, 3) parent from child in the known posture."""

    def moved(self, step: Floats) -> "JointPlace":
        """Give the place after a step (10,) of its parameters."""
        return self._replace(
            in_parent=self.in_parent + step[:3], in_child=self.in_child + step[3:6],
            axis=_unit(self.axis + across(self.axis) @ step[6:8]),
            second=_unit(self.second + across(self.second) @ step[8:10]),
        )  # fmt: skip


def _unit(vector: Floats) -> Floats:
    return np.asarray(vector / np.linalg.norm(vector))


def across(axis: Floats) -> Floats:
    """Give two unit vectors across an axis and each other: (3, 2)."""
    first = _unit(np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))]))
    return np.stack([first, np.cross(axis, first)], -1)


def gap(
    joint: ChainJoint,
    place: JointPlace,
    parent: tuple[Floats, Floats],
    child: tuple[Floats, Floats],
    fast_m: float,
) -> tuple[Floats, Floats, Floats]:
    """Give how far bones are off a joint, in standard deviations, and how that changes.

    The gap of the centres is seen along the held directions of the parent. A hinge holds the rotation vector of the
    turn out of the known posture across its axis; two degrees hold the angle between the parent's and the child's axis.

    Args:
        joint: What is held, and how fast.
        place: Where it is.
        parent: Rotation (..., 3, 3) laboratory from bone and origin (..., 3) [m].
        child: The same.
        fast_m: The standard deviation of a gap where the joint is held fast [m].

    Returns:
        residual (..., r); jacobian (..., r, 12) by turn (about the bone's own axes) and origin of parent and child;
        shared (..., r, 10) by the joint's parameters.
    """
    rotation, relative = parent[0], np.swapaxes(parent[0], -1, -2) @ child[0]
    rows = [_shift_rows(place, rotation, relative, child[1] - parent[1], joint.sd_m or fast_m)]
    if joint.held_turns:
        turn = relative @ place.neutral.T
        make = {1: _axis_rows, 2: _hinge_rows, 3: _turn_rows}[joint.held_turns]
        value, by_parent, by_child, by_joint = make(place, turn)
        zero = np.zeros_like(by_parent)
        jacobian = np.concatenate([by_parent, zero, by_child, zero], -1)
        scale = joint.sd_rad or fast_m / LEVER_M
        rows.append((value / scale, jacobian / scale, by_joint / scale))
    values, jacobians, shared = zip(*rows, strict=True)
    return np.concatenate(values, -1), np.concatenate(jacobians, -2), np.concatenate(shared, -2)


def _shift_rows(
    place: JointPlace, rotation: Floats, relative: Floats, between: Floats, scale: float
) -> tuple[Floats, Floats, Floats]:
    """Give the rows of the held shifts: R_p'(o_c - o_p) + Q b - a along the held directions."""
    inverse = np.swapaxes(rotation, -1, -2)
    in_parent = (inverse @ between[..., None])[..., 0] + relative @ place.in_child
    batch = rotation.shape[:-2]
    wrt = np.concatenate([rotations.hat(in_parent), -inverse, -relative @ rotations.hat(place.in_child), inverse], -1)
    shared = np.zeros((*batch, 3, PARAMETERS))
    shared[..., :3], shared[..., 3:6] = -np.eye(3), relative
    held = place.held / scale
    return (in_parent - place.in_parent) @ held.T, held @ wrt, held @ shared


def _turn_rows(place: JointPlace, turn: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Give the rotation vector of the turn out of the known posture, by parent, by child, by the joint."""
    vector = rotations.log(turn)
    by_parent = -rotations.inverse_left_jacobian(vector)
    by_child = rotations.inverse_left_jacobian(-vector) @ place.neutral
    return vector, by_parent, by_child, np.zeros((*vector.shape, PARAMETERS))


def _hinge_rows(place: JointPlace, turn: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Give the rotation vector less its part along the hinge's axis: three rows, of which two are independent."""
    vector, by_parent, by_child, shared = _turn_rows(place, turn)
    along = vector @ place.axis
    off = np.eye(3) - np.outer(place.axis, place.axis)
    wrt_axis = -along[..., None, None] * np.eye(3) - place.axis[:, None] * vector[..., None, :]
    shared[..., 6:8] = wrt_axis @ across(place.axis)
    return vector @ off, off @ by_parent, off @ by_child, shared


def _axis_rows(place: JointPlace, turn: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Give the change of the cosine between the parent's axis and the child's."""
    now = turn @ place.second
    value = now @ place.axis - place.second @ place.axis
    crossed = np.cross(now, place.axis)
    seen = np.swapaxes(turn, -1, -2) @ place.axis
    by_child = np.cross(np.broadcast_to(place.second, seen.shape), seen) @ place.neutral
    shared = np.zeros((*value.shape, 1, PARAMETERS))
    shared[..., 0, 6:8] = (now - place.second) @ across(place.axis)
    shared[..., 0, 8:10] = (seen - place.axis) @ across(place.second)
    return value[..., None], -crossed[..., None, :], by_child[..., None, :], shared
