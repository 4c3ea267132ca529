"""Landmarks in every frame of a trial, carried by the bones to which they belong ([Cappozzo1995])."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from marey.arrays import Floats, freeze_fields
from marey.geometry import rotations
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.preprocessing.landmarks import AnatomicalFrame, split_segment

_ON = {
    "pelvis": ("RASIS", "LASIS", "RPSIS", "LPSIS"), "thigh": ("HJC", "ME", "LE", "KJC"),
    "shank": ("MM", "LM", "AJC", "MC", "LC"), "foot": ("CA", "M1", "M5", "TOE"), "thorax": ("IJ", "PX", "C7", "T8"),
    "upperarm": ("GH", "EM", "EL", "EJC"), "forearm": ("US", "RS", "WJC"),
}  # fmt: skip
"""Landmarks that each kind of bone carries, by the names of the ISB; of a joint's centre it is the proximal bone, of
the hip and the shoulder the distal one."""


@dataclass(frozen=True, eq=False, kw_only=True)
class HeldLandmarks:
    """L landmarks fixed to bones."""

    names: tuple[str, ...] = ()
    """L names, such as `left_LE`."""
    segments: tuple[str, ...] = ()
    """(L,) the bone of each landmark."""
    places: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    """(L, 3) position in the bone's frame [m]."""

    def __post_init__(self) -> None:
        freeze_fields(self, "places")


@dataclass(frozen=True, eq=False, kw_only=True)
class LandmarkMotion:
    """The paths of L landmarks over F frames in the laboratory."""

    names: tuple[str, ...] = ()
    """L names."""
    points: Floats = field(default_factory=lambda: np.zeros((0, 0, 3)))
    """(F, L, 3) [m]; NaN where the bone has no pose."""
    sd: Floats = field(default_factory=lambda: np.zeros((0, 0, 3)))
    """(F, L, 3) standard deviation along the laboratory's axes [m], due to the pose of the bone."""

    def __post_init__(self) -> None:
        freeze_fields(self, "points", "sd")


def held_landmarks(landmarks: Mapping[str, Floats], frames: Sequence[AnatomicalFrame]) -> HeldLandmarks:
    """Express landmarks in the frames of their bones in one posture.

    Args:
        landmarks: Maps landmarks to positions (3,) in the laboratory of the posture [m].
        frames: The frames of the bones in this posture.

    Returns:
        The landmarks whose bones have a frame.
    """
    names, segments, places = [], [], []
    for frame in frames:
        prefix, kind = split_segment(frame.segment)
        for name in _ON.get(kind or "", ()):
            full = name if kind in ("pelvis", "thorax") else f"{prefix}{name}"
            if full in landmarks:
                names.append(full)
                segments.append(frame.segment)
                places.append(frame.rotation.T @ (landmarks[full] - frame.origin))
    return HeldLandmarks(names=tuple(names), segments=tuple(segments), places=np.reshape(places, (-1, 3)))


def bearer_of(landmark: str, segments: Sequence[str]) -> str | None:
    """Return the segment that carries a landmark; None if it is none of them.

    Args:
        landmark: Name of the landmark, such as `left_LE`.
        segments: Names of the segments, such as `left_femur`.
    """
    for segment in segments:
        prefix, kind = split_segment(segment)
        before = "" if kind in ("pelvis", "thorax") else prefix
        if landmark.removeprefix(before) in _ON.get(kind or "", ()) and landmark.startswith(before):
            return segment
    return None


def landmark_motion(motion: BoneMotion, held: HeldLandmarks) -> LandmarkMotion:
    """Carry landmarks through a trial with their bones.

    The standard deviation follows from the covariance of the bone's pose to first order. The landmark's own error, by
    which its bone was defined, is constant in the bone and not part of it.

    Args:
        motion: The motion of the bones.
        held: The landmarks.

    Returns:
        The paths of the landmarks whose bones have a motion.
    """
    there = [k for k, segment in enumerate(held.segments) if segment in motion.segments]
    index = [motion.segments.index(held.segments[k]) for k in there]
    rotation, places = motion.rotation[:, index], held.places[there]
    points = motion.origin[:, index] + np.einsum("flij,lj->fli", rotation, places)
    turn = -rotation @ rotations.hat(places)
    slope = np.concatenate([turn, np.broadcast_to(np.eye(3), turn.shape)], -1)
    variance = np.einsum("flik,flkm,flim->fli", slope, motion.covariance[:, index], slope)
    return LandmarkMotion(
        names=tuple(held.names[k] for k in there), points=points, sd=np.sqrt(np.maximum(variance, 0.0))
    )  # fmt: skip
