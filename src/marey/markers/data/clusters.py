"""Clusters of markers, one per segment, and the anatomical calibration that relates them to the bones."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Integers, freeze_fields, frozen
from marey.errors import MareyError

MINIMUM_MARKERS = 3
"""Markers that determine the pose of a rigid segment: three points off one line."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Cluster:
    """The markers attached to one segment."""

    segment: str
    """Name of the segment: `thigh`, `left_shank`, ..."""
    labels: tuple[str, ...]
    """M marker labels."""
    computed: tuple[str, ...] = ()
    """Those of points that were computed from other markers, such as joint centres; they cannot be mislabelled."""


@dataclass(frozen=True, eq=False, kw_only=True)
class AnatomicalCalibration:
    """Known poses of the bones in the laboratory in K frames of the trial (one posture, or several)."""

    segments: tuple[str, ...]
    """S names."""
    frames: Integers
    """(K,) frame indices of the trial, counted from 0."""
    rotation: Floats
    """(K, S, 3, 3) laboratory from bone."""
    origin: Floats
    """(K, S, 3) the bone's origin in the laboratory [m]."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "frames", frozen(np.atleast_1d(self.frames), np.int64))
        freeze_fields(self, "rotation", "origin")
        shape = (len(self.frames), len(self.segments))
        if self.rotation.shape != (*shape, 3, 3) or self.origin.shape != (*shape, 3):
            raise MareyError(
                f"The array shapes of a calibration of {shape[1]} segments in {shape[0]} frames do not agree."
            )

    @property
    def postures(self) -> int:
        """Number K of postures in which the bones are known."""
        return len(self.frames)
