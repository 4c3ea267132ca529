"""Joints with one to six degrees of freedom between the bones of a trial, and the residuals of their constraints."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from marey.arrays import Floats, frozen
from marey.errors import MareyError
from marey.geometry import rotations
from marey.geometry.vectors import products, unit

RIGID_SD_M = 1e-4
"""Standard deviation of the gap of a rigid constraint [m]; residuals of millimetres then open it by micrometres."""
LEVER_M = 0.1
"""A constrained rotation is weighted like the gap that it causes at this distance [m]. Chosen by hand."""
PARAMETERS = 10
"""Number of parameters of a joint: its centre in the parent (3) and in the child (3), its axes in the parent (2) and in
the child (2)."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ChainJoint:
    """A joint between two bones."""

    parent: str
    child: str
    degrees_of_freedom: int = 3
    """1: hinge; 2: rotation about an axis of the parent, then about one of the child; 3: ball joint; 4 and 5: ball
    joint whose centre also translates along the one or two directions in which it moves most; 6: no constraint, or a
    soft one."""
    sd_m: float | None = None
    """Standard deviation of the gap between the bones' joint centres along each constrained direction [m]. None is a
    rigid constraint, or no constraint for six degrees of freedom. With six degrees all three directions are constrained
    softly."""
    sd_rad: float | None = None
    """The same for the constrained rotations of a joint of one or two degrees, and with six degrees for every rotation
    from the known posture [rad]."""
    centre: Floats | None = None
    """(3,) in the parent's frame [m], from landmarks or a functional trial; the position in the child then follows from
    the known postures. None: both are estimated over the trial."""
    axis: Floats | None = None
    """(3,) axis of a joint of one or two degrees, in the parent's frame; None: it is estimated over the trial."""

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
                    raise MareyError(
                        f"The {name} of the joint of {self.parent} and {self.child} is not a finite 3-vector."
                    )
                object.__setattr__(self, name, values)

    @property
    def constrained_translations(self) -> int:
        """Number of directions in which the centre is constrained."""
        if self.degrees_of_freedom < 6:
            return min(3, 6 - self.degrees_of_freedom)
        return 0 if self.sd_m is None else 3

    @property
    def constrained_rotations(self) -> int:
        """Number of constrained rotations."""
        if self.degrees_of_freedom < 6:
            return max(0, 3 - self.degrees_of_freedom)
        return 0 if self.sd_rad is None else 3


class JointPlace(NamedTuple):
    """Current position and axes of a joint."""

    in_parent: Floats
    """(3,) the joint's centre in the parent's frame [m]."""
    in_child: Floats
    """(3,) the joint's centre in the child's frame [m]."""
    axis: Floats
    """(3,) unit vector: axis of the first rotation, in the parent."""
    second: Floats
    """(3,) unit vector: axis of the second rotation, fixed to the child; in the parent's frame in the known posture."""
    held: Floats
    """(h, 3) orthonormal directions of the parent in which the centre is constrained."""
    neutral: Floats
    """(3, 3) parent from child in the known posture."""

    def moved(self, step: Floats) -> "JointPlace":
        """Return the position after a step (10,) of its parameters."""
        return self._replace(
            in_parent=self.in_parent + step[:3], in_child=self.in_child + step[3:6],
            axis=unit(self.axis + across(self.axis) @ step[6:8]),
            second=unit(self.second + across(self.second) @ step[8:10]),
        )  # fmt: skip


def across(axis: Floats) -> Floats:
    """Return two unit vectors perpendicular to an axis and to each other: (3, 2)."""
    first = unit(np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))]))
    return np.stack([first, np.cross(axis, first)], -1)


def joint_gap(
    joint: ChainJoint,
    place: JointPlace,
    parent: tuple[Floats, Floats],
    child: tuple[Floats, Floats],
    rigid_sd_m: float,
) -> tuple[Floats, Floats, Floats]:
    """Compute the whitened residuals of a joint's constraints and their derivatives.

    The gap between the centres is resolved along the constrained directions of the parent. A hinge constrains the part
    of the rotation vector from the known posture that is perpendicular to its axis; two degrees of freedom constrain
    the angle between the parent's and the child's axis.

    Args:
        joint: The constraints and their standard deviations.
        place: Position and axes of the joint.
        parent: Rotation (..., 3, 3) laboratory from bone and origin (..., 3) [m].
        child: The same of the child.
        rigid_sd_m: Standard deviation of a rigid constraint's gap [m].

    Returns:
        residual (..., r) in standard deviations; jacobian (..., r, 12) by rotation (about the bone's own axes) and
        origin of parent and child; shared (..., r, 10) by the joint's parameters.
    """
    rotation, relative = parent[0], np.swapaxes(parent[0], -1, -2) @ child[0]
    rows = [_translation_rows(place, rotation, relative, child[1] - parent[1], joint.sd_m or rigid_sd_m)]
    if joint.constrained_rotations:
        turn = relative @ place.neutral.T
        make = {1: _axis_rows, 2: _hinge_rows, 3: _rotation_rows}[joint.constrained_rotations]
        value, by_parent, by_child, by_joint = make(place, turn)
        zero = np.zeros_like(by_parent)
        jacobian = np.concatenate([by_parent, zero, by_child, zero], -1)
        scale = joint.sd_rad or rigid_sd_m / LEVER_M
        rows.append((value / scale, jacobian / scale, by_joint / scale))
    values, jacobians, shared = zip(*rows, strict=True)
    return np.concatenate(values, -1), np.concatenate(jacobians, -2), np.concatenate(shared, -2)


def _translation_rows(
    place: JointPlace, rotation: Floats, relative: Floats, between: Floats, scale: float
) -> tuple[Floats, Floats, Floats]:
    """Return the rows of the constrained translations: R_p'(o_c - o_p) + Q b - a along the constrained directions."""
    inverse = np.swapaxes(rotation, -1, -2)
    in_parent = products(inverse, between) + relative @ place.in_child
    batch = rotation.shape[:-2]
    wrt = np.concatenate([rotations.hat(in_parent), -inverse, -relative @ rotations.hat(place.in_child), inverse], -1)
    shared = np.zeros((*batch, 3, PARAMETERS))
    shared[..., :3], shared[..., 3:6] = -np.eye(3), relative
    held = place.held / scale
    return (in_parent - place.in_parent) @ held.T, held @ wrt, held @ shared


def _rotation_rows(place: JointPlace, turn: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Return the rotation vector from the known posture, and its derivatives by parent, child and joint."""
    vector = rotations.log(turn)
    by_parent = -rotations.inverse_left_jacobian(vector)
    by_child = rotations.inverse_left_jacobian(-vector) @ place.neutral
    return vector, by_parent, by_child, np.zeros((*vector.shape, PARAMETERS))


def _hinge_rows(place: JointPlace, turn: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Return the rotation vector perpendicular to the hinge's axis: three rows, of which two are independent."""
    vector, by_parent, by_child, shared = _rotation_rows(place, turn)
    along = vector @ place.axis
    off = np.eye(3) - np.outer(place.axis, place.axis)
    wrt_axis = -along[..., None, None] * np.eye(3) - place.axis[:, None] * vector[..., None, :]
    shared[..., 6:8] = wrt_axis @ across(place.axis)
    return vector @ off, off @ by_parent, off @ by_child, shared


def _axis_rows(place: JointPlace, turn: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Return the change of the cosine between the parent's axis and the child's."""
    now = turn @ place.second
    value = now @ place.axis - place.second @ place.axis
    crossed = np.cross(now, place.axis)
    seen = np.swapaxes(turn, -1, -2) @ place.axis
    by_child = np.cross(np.broadcast_to(place.second, seen.shape), seen) @ place.neutral
    shared = np.zeros((*value.shape, 1, PARAMETERS))
    shared[..., 0, 6:8] = (now - place.second) @ across(place.axis)
    shared[..., 0, 8:10] = (seen - place.axis) @ across(place.second)
    return value[..., None], -crossed[..., None, :], by_child[..., None, :], shared
