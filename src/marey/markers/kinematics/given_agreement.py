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
ankle rotation and then inversion, so that ankle angles far from zero differ by their sequence as well. Angles of feet
in the laboratory have no counterpart."""
_PELVIS = (("pelvis_tilt", 1, 1), ("pelvis_obliquity", 1, -1), ("pelvis_rotation", -1, 1))
"""The quantities of the three components of `LPelvisAngles` and `RPelvisAngles`, each with the signs on the left and on
the right. Vicon documents that anterior tilt, obliquity with the own side up, and internal rotation are positive; here
these are anterior tilt, right side down, and rotation to the left. Plug-in Gait measures rotation from the direction of
progression, so that its bias is that direction."""
OTHER_SEQUENCE = ("ankle_inversion", "ankle_rotation")
"""Those of the quantities that belong to another sequence of rotations in Plug-in Gait."""


@dataclass(frozen=True, kw_only=True)
class GivenAgreement:
    """The agreement of one joint angle with a component of an angle in the file."""

    label: str
    """Label in the file."""
    component: str
    """`x`, `y` or `z`."""
    sign: int = 1
    """Sign by which the component of the file is multiplied."""
    agreement: Agreement
    """Ours minus that of the file, with its sign."""


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
    plain = [label.rpartition(":")[2].strip() for label in given.labels]
    rows = []
    for a, label in enumerate(given.labels):
        if plain.count(plain[a]) == 1:
            for k, (name, sign) in enumerate(given_meaning(plain[a])):
                if name in joints.angle_names:
                    ours = np.where(frames, joints.angles[:, joints.angle_names.index(name)], np.nan)
                    found = agreement(name, "angle", ours, sign * given.values[:, a, k])
                    rows.append(GivenAgreement(label=label, component="xyz"[k], sign=sign, agreement=found))
    rows.sort(key=lambda row: joints.angle_names.index(row.agreement.name))
    return tuple(row for row in rows if row.agreement.frames)


def given_meaning(label: str) -> tuple[tuple[str, int], ...]:
    """Return our angle and the sign for each component of a label; empty if its meaning is not known.

    Args:
        label: Label of an angle in a file, without the name of a person.
    """
    side = _SIDES.get(label[:1])
    if side is None:
        return ()
    if label[1:] == "PelvisAngles":
        return tuple((name, left if side == "left" else right) for name, left, right in _PELVIS)
    return tuple((f"{side}_{name}", 1) for name in PLUG_IN_GAIT_ANGLES.get(label[1:], ()))
