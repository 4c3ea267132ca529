"""Clusters of markers, one a segment, and the anatomical calibration that ties them to the bones."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Integers, freeze_fields, frozen
from marey.errors import MareyError


@dataclass(frozen=True, eq=False, kw_only=True)
class Cluster:
    """The markers that ride on one segment."""

    segment: str
    """The segment's name: `thigh`, `left_shank`, ..."""
    labels: tuple[str, ...]
    """M labels."""


@dataclass(frozen=True, eq=False, kw_only=True)
class AnatomicalCalibration:
    """Where the bones were, seen from the laboratory, in K frames of the trial (one posture, or several)."""

    segments: tuple[str, ...]
    """S names."""
    frames: Integers
    """(K,) frames of the trial, counted from 0."""
    rotation: Floats
    """(K, S, 3, 3) laboratory from bone."""
    origin: Floats
    """(K, S, 3) the bone's origin in the laboratory [m]."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "frames", frozen(np.atleast_1d(self.frames), np.int64))
        freeze_fields(self, "rotation", "origin")
        shape = (len(self.frames), len(self.segments))
        if self.rotation.shape != (*shape, 3, 3) or self.origin.shape != (*shape, 3):
            raise MareyError(f"An anatomical calibration of {shape[1]} segments in {shape[0]} frames does not fit.")

    @property
    def postures(self) -> int:
        """K, in how many postures the bones are known."""
        return len(self.frames)
