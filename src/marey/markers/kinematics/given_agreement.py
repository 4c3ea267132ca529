"""Agreement of joint angles with those that another program wrote into the file of the trial."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from marey.arrays import Mask
from marey.markers.data.given_angles import GivenAngles
from marey.markers.kinematics.joint_angles import JointKinematics
from marey.motion.comparison import Agreement, agreement

_SIDES = {"L": "left", "R": "right"}
"""Sides by the first letter of a label."""
PLUG_IN_GAIT_ANGLES: Mapping[str, tuple[str, str, str]] = MappingProxyType(
    {
        "HipAngles": ("hip_flexion", "hip_adduction", "hip_rotation"),
        "KneeAngles": ("knee_flexion", "knee_adduction", "knee_rotation"),
        "AnkleAngles": ("ankle_dorsiflexion", "ankle_inversion", "ankle_rotation"),
    }
)
"""The quantities of the three components, by the label without its side. Vicon documents for Plug-in Gait ("Lower body
angles as output from Plug-in Gait") that flexion, adduction (varus, inversion), dorsiflexion and internal rotation are
positive on both sides, as they are here. The first rotation is flexion, then adduction and rotation, as here; at the
ankle rotation and then inversion, so that ankle angles far from zero differ by their sequence as well. Angles of pelvis
and feet in the laboratory have no counterpart."""
OTHER_SEQUENCE = ("ankle_inversion", "ankle_rotation")
"""Those of the quantities that belong to another sequence of rotations in Plug-in Gait."""


@dataclass(frozen=True, kw_only=True)
class GivenAgreement:
    """The agreement of one joint angle with a component of an angle in the file."""

    label: str
    """Label in the file."""
    component: str
    """`x`, `y` or `z`."""
    agreement: Agreement
    """Ours minus that of the file."""


def compare_given_angles(
    joints: JointKinematics, given: GivenAngles, frames: Mask
) -> tuple[GivenAgreement, ...]:  # fmt: skip
    """Compare joint angles with those of the file whose meaning is known.

    Labels that occur for several people are not compared.

    Args:
        joints: Joint angles of the trial.
        given: The angles of the file, in the same frames.
        frames: (F,) true for the frames to compare.

    Returns:
        One entry for each angle that is in both, in the order of the joint angles.
    """
    known: dict[str, list[tuple[str, int, int]]] = {}
    for a, label in enumerate(given.labels):
        plain = label.rpartition(":")[2].strip()
        if plain[:1] in _SIDES and plain[1:] in PLUG_IN_GAIT_ANGLES:
            for k, name in enumerate(PLUG_IN_GAIT_ANGLES[plain[1:]]):
                known.setdefault(f"{_SIDES[plain[0]]}_{name}", []).append((label, a, k))
    rows = []
    for column, name in enumerate(joints.angle_names):
        if len(places := known.get(name, [])) == 1:
            label, a, k = places[0]
            ours, theirs = (np.where(frames, x, np.nan) for x in (joints.angles[:, column], given.values[:, a, k]))
            rows.append(
                GivenAgreement(label=label, component="xyz"[k], agreement=agreement(name, "angle", ours, theirs))
            )
    return tuple(row for row in rows if row.agreement.frames)
