"""Joint angles and translations that the axes of the bones, or the markers, do not determine."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.kinematics.joint_angles import TRANSLATIONS, BoneJoint, JointKinematics
from marey.markers.methods.joint_constraints import JOINT_CONSTRAINT_DEFAULTS, axis_tilt, laxity
from marey.pipelines.verdict import VerdictReason
from marey.wording import listed

_POSSIBLE = ((-20.0, 165.0), (-20.0, 20.0), (-45.0, 45.0))
"""Least and largest flexion, adduction and rotation [degrees] of a knee with anatomical axes, with room for a constant
error of the calibration. Knees with known bones ([Cereatti2017]) have a range of adduction of 4 to 11 degrees and of
rotation of 5 to 24 degrees over a trial. Chosen by hand."""
_WORDS = ("flexion", "adduction", "rotation")
"""Names of the three angles of a joint in a sentence."""
_OUTER = (5, 95)
"""Percentiles of an angle between which it must be possible, so that single frames do not count. Chosen by hand."""
_MOST_INTERVAL_RATIO = 3.0
"""Typical 95 % interval (half its width) of the translations of a joint as a multiple of their range, above which they
are not measured. Chosen by hand."""
_LEAST_INTERVAL_M = 0.01
"""Least such interval that is named [m]: narrower ones show that a joint hardly translates. Centres of knees with known
bones stay within 1 to 3 mm ([Cereatti2017]). Chosen by hand."""
_LEAST_INTERVAL_DEG = 5.0
"""Least such interval of an angle that is named [degrees]: narrower ones show that a joint hardly rotates. Chosen by
hand."""
_WITHIN = 1.96
"""Standard deviations of a normal distribution that contain 95 % of its values."""
_AXES = (
    "Do not use these angles. Give the bones anatomical axes (X forward, Y up, Z to the right): by a static trial with "
    "landmarks (--static), or by a reference whose bones have such axes (--reference)."
)
"""What to do about joint angles without a meaning."""


@dataclass(frozen=True, kw_only=True)
class _Knee:
    """The axis and the angles of a knee over a trial."""

    name: str
    tilt: float
    """Angle of the axis about which the joint rotates from the bones' Z axes [rad]; NaN if it rotates too little."""
    ranges: tuple[tuple[float, float], ...]
    """Range of flexion, adduction and rotation [degrees] without the outer frames; NaN if unknown."""

    @property
    def tilted(self) -> bool:
        return self.tilt > JOINT_CONSTRAINT_DEFAULTS.largest_tilt

    @property
    def impossible(self) -> list[int]:
        """Indices of the angles that a knee cannot have."""
        pairs = enumerate(zip(self.ranges, _POSSIBLE, strict=True))
        return [k for k, ((low, high), (least, most)) in pairs if low < least or high > most]

    def text(self, which: Iterable[int]) -> str:
        return f"{self.name}: " + listed(
            f"{_WORDS[k]} {self.ranges[k][0]:.0f} to {self.ranges[k][1]:.0f} degrees" for k in which
        )


def axis_reasons(
    motion: BoneMotion, kinematics: JointKinematics, joints: Iterable[BoneJoint]
) -> Iterator[VerdictReason]:  # fmt: skip
    """Name knees whose angles have no anatomical meaning, because the axes of the bones are others.

    Args:
        motion: Bones whose frames should be anatomical: X forward, Y up, Z to the right.
        kinematics: Angles of their joints.
        joints: The joints of the bones.
    """
    knees = [
        _knee(motion, kinematics, joint)
        for joint in joints
        if laxity(joint.parent, joint.child).adduction and laxity(joint.parent, joint.child).rotation
    ]
    tilted = [knee for knee in knees if knee.tilted]
    if tilted:
        apart = listed(f"{knee.name} by {np.degrees(knee.tilt):.0f} degrees" for knee in tilted)
        what = (
            f"The axis about which the joint bends differs from the Z axes of the bones: {apart}. Flexion, adduction "
            f"and rotation are mixed ({'; '.join(knee.text(range(3)) for knee in tilted)})."
        )
        yield VerdictReason.limit(what, _AXES, cause="joint axes")
    others = [knee for knee in knees if not knee.tilted and knee.impossible]
    if others:
        found = "; ".join(knee.text(knee.impossible) for knee in others)
        what = f"No knee has such angles ({found}): the axes of the bones are not anatomical, or a marker has moved."
        yield VerdictReason.limit(what, _AXES, cause="joint axes")


def _knee(motion: BoneMotion, kinematics: JointKinematics, joint: BoneJoint) -> _Knee:
    """Measure the axis and the angles of a knee."""
    parent, child = motion.bone(joint.parent)[0], motion.bone(joint.child)[0]
    ranges = []
    for name, _ in joint.angles:
        values = np.degrees(kinematics.angles[:, kinematics.angle_names.index(name)])
        known = values[np.isfinite(values)]
        low, high = np.percentile(known, _OUTER) if len(known) else (np.nan, np.nan)
        ranges.append((float(low), float(high)))
    return _Knee(
        name=joint.name.replace("_", " "), tilt=axis_tilt(np.swapaxes(parent, 1, 2) @ child), ranges=tuple(ranges)
    )  # fmt: skip


def unmeasured_reasons(kinematics: JointKinematics, joints: Iterable[BoneJoint]) -> Iterator[VerdictReason]:
    """Name translations and angles of joints whose intervals are too wide for their range.

    Markers on the skin determine the translations of hardly any joint, and a knee hardly adducts: the reasons do not
    limit the other results.

    Args:
        kinematics: Angles and translations of the joints with standard deviations.
        joints: The joints.
    """
    yield from _translations(kinematics, joints)
    yield from _angles(kinematics)


def _translations(kinematics: JointKinematics, joints: Iterable[BoneJoint]) -> Iterator[VerdictReason]:
    """Name joints whose translations have intervals of many times their range."""
    found = []
    for joint in joints:
        columns = [kinematics.translation_names.index(f"{joint.name}_{name}") for name in TRANSLATIONS]
        size, interval = _sizes(kinematics.translations[:, columns], kinematics.translations_sd[:, columns])
        if interval > max(_MOST_INTERVAL_RATIO * size, _LEAST_INTERVAL_M):
            name = joint.name.replace("_", " ")
            found.append(f"{name} ± {1e3 * interval:.0f} mm, with a range of {1e3 * size:.1f} mm")
    if not found:
        return
    what = (
        "The joint translations are not measured, because their 95 % intervals are many times their range (typically "
        f"{'; '.join(found)})."
    )
    yield VerdictReason(level="good", what=what, remedy="Do not interpret these translations.", cause="translations")


def _angles(kinematics: JointKinematics) -> Iterator[VerdictReason]:
    """Name angles whose typical interval is wider than their range."""
    found = []
    for k, name in enumerate(kinematics.angle_names):
        values, sd = np.degrees(kinematics.angles[:, k]), np.degrees(kinematics.angles_sd[:, k])
        known = np.isfinite(values) & np.isfinite(sd)
        if not known.any():
            continue
        size, interval = float(np.ptp(values[known])), _WITHIN * float(np.median(sd[known]))
        if interval > max(size, _LEAST_INTERVAL_DEG):
            found.append(f"{name.replace('_', ' ')} ± {interval:.1f} degrees, with a range of {size:.1f} degrees")
    if found:
        what = (
            "How these angles change is not measured, because their typical 95 % intervals are wider than their range "
            f"({'; '.join(found)})."
        )
        yield VerdictReason(level="good", what=what, remedy="Do not interpret their changes.", cause="narrow range")


def _sizes(values: Floats, sd: Floats) -> tuple[float, float]:
    """Return the median of the range and of the typical interval of three translations [m]; NaN if unknown."""
    known = np.isfinite(values).all(1) & np.isfinite(sd).all(1)
    if not known.any():
        return float("nan"), float("nan")
    interval = _WITHIN * np.median(sd[known], 0)
    return float(np.median(np.ptp(values[known], 0))), float(np.median(interval))
