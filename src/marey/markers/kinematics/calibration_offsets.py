"""Constant errors of bones and joint angles due to measurements of the person that are assumed."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Floats, freeze_fields
from marey.geometry import rotations
from marey.geometry.vectors import products
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.data.clusters import AnatomicalCalibration
from marey.markers.data.person import AssumedMeasurement
from marey.markers.kinematics.joint_angles import JointKinematics
from marey.markers.preprocessing.own_frames import BonesAndMarkers
from marey.motion.anatomical import LARGEST_ANGLE_SD

Kinematics = Callable[[BoneMotion, AnatomicalCalibration], JointKinematics]
"""Computes joint angles from a motion and the poses of the bones in the reference posture."""
_LEAST_CHANGE = 1e-6
"""Change of an angle below which it does not depend on a measurement [rad]; numerical."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CalibrationOffsets:
    """How Q assumed measurements displace S bones: constant in the frames of the bones."""

    measurements: tuple[AssumedMeasurement, ...]
    """The measurements, Q of them."""
    segments: tuple[str, ...]
    """S names."""
    rotation: Floats
    """(Q, S, 3) rotation about the bone's axes if the measurement is larger by its standard deviation [rad]."""
    origin: Floats
    """(Q, S, 3) displacement of the bone's origin in the bone's frame [m]."""

    def __post_init__(self) -> None:
        freeze_fields(self, "rotation", "origin")

    def displaced(self, q: int, segments: Sequence[str], rotation: Floats, origin: Floats) -> tuple[Floats, Floats]:
        """Return poses of bones as they are if one measurement is larger by its standard deviation.

        Args:
            q: Index of the measurement.
            segments: B names, among those of the offsets.
            rotation: (..., B, 3, 3) laboratory from bone.
            origin: (..., B, 3) [m].
        """
        index = [self.segments.index(name) for name in segments]
        turned = rotation @ rotations.exp(self.rotation[q, index])
        return np.asarray(turned), np.asarray(origin + products(rotation, self.origin[q, index]))


@dataclass(frozen=True, kw_only=True)
class AngleOffset:
    """Constant standard deviation of a joint angle due to one assumed measurement."""

    measurement: AssumedMeasurement
    angle: str
    """Name of the angle."""
    sd: float
    """Median over the frames [rad]."""


def offsets_between(
    measurements: Sequence[AssumedMeasurement], bones: BonesAndMarkers, larger: Sequence[BonesAndMarkers]
) -> CalibrationOffsets:
    """Return how assumed measurements displace bones.

    Args:
        measurements: Q measurements.
        bones: The bones in a posture, with the assumed values.
        larger: The same bones, Q times, each time with one measurement larger by its standard deviation.
    """
    back = np.swapaxes(bones.rotation, -1, -2)
    shape = (len(measurements), len(bones.segments), 3)
    turns = [rotations.log(back @ other.rotation) for other in larger]
    shifts = [products(back, other.origin - bones.origin) for other in larger]
    return CalibrationOffsets(
        measurements=tuple(measurements), segments=bones.segments,
        rotation=np.reshape(turns, shape), origin=np.reshape(shifts, shape),
    )  # fmt: skip


def joints_with_offsets(
    motion: BoneMotion, calibration: AnatomicalCalibration, offsets: CalibrationOffsets, kinematics: Kinematics
) -> tuple[JointKinematics, tuple[AngleOffset, ...]]:
    """Compute joint angles whose standard deviations include the constant errors of assumed measurements.

    The error of one measurement displaces all bones at once: the angles are computed again from bones that are
    displaced by a standard deviation, and the differences of all measurements are added to the variances.

    Args:
        motion: The motion of the bones, without these errors in its covariance.
        calibration: The poses of the bones in the reference posture.
        offsets: How the measurements displace the bones.
        kinematics: Computes the angles.

    Returns:
        The angles and translations, and what each measurement contributes to each angle that depends on it.
    """
    joints = kinematics(motion, calibration)
    angle_variance, translation_variance = joints.angles_sd**2, joints.translations_sd**2
    rows = []
    for q, measurement in enumerate(offsets.measurements):
        moved = kinematics(_displaced_motion(motion, offsets, q), _displaced_calibration(calibration, offsets, q))
        change = np.angle(np.exp(1j * (moved.angles - joints.angles)))
        angle_variance = angle_variance + change**2
        translation_variance = translation_variance + (moved.translations - joints.translations) ** 2
        rows += [
            AngleOffset(measurement=measurement, angle=name, sd=float(np.nanmedian(np.abs(change[:, a]))))
            for a, name in enumerate(joints.angle_names)
            if np.nanmax(np.abs(change[:, a]), initial=0.0) > _LEAST_CHANGE
        ]
    spread = np.minimum(np.sqrt(angle_variance), LARGEST_ANGLE_SD)
    return replace(joints, angles_sd=spread, translations_sd=np.sqrt(translation_variance)), tuple(rows)


def motion_with_offsets(motion: BoneMotion, offsets: CalibrationOffsets) -> BoneMotion:
    """Add the constant errors of assumed measurements to the covariances of bones.

    Args:
        motion: The motion of the bones.
        offsets: How the measurements displace the bones.
    """
    index = [offsets.segments.index(name) for name in motion.segments]
    covariance = np.array(motion.covariance)
    for turn, shift in zip(offsets.rotation[:, index], offsets.origin[:, index], strict=True):
        error = np.concatenate([np.broadcast_to(turn, motion.origin.shape), products(motion.rotation, shift)], -1)
        covariance += error[..., :, None] * error[..., None, :]
    return replace(motion, covariance=covariance)


def _displaced_motion(motion: BoneMotion, offsets: CalibrationOffsets, q: int) -> BoneMotion:
    rotation, origin = offsets.displaced(q, motion.segments, motion.rotation, motion.origin)
    return replace(motion, rotation=rotation, origin=origin)


def _displaced_calibration(
    calibration: AnatomicalCalibration, offsets: CalibrationOffsets, q: int
) -> AnatomicalCalibration:
    rotation, origin = offsets.displaced(q, calibration.segments, calibration.rotation, calibration.origin)
    return replace(calibration, rotation=rotation, origin=origin)
