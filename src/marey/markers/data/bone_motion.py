"""The motion of bones: one pose per segment and frame, with its covariance."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Mask, freeze_fields
from marey.errors import MareyError


@dataclass(frozen=True, eq=False, kw_only=True)
class BoneMotion:
    """The poses of S bones over F frames; NaN where a pose could not be estimated."""

    segments: tuple[str, ...]
    """S names."""
    rotation: Floats
    """(F, S, 3, 3) laboratory from bone."""
    origin: Floats
    """(F, S, 3) the bone's origin in the laboratory [m]."""
    covariance: Floats
    """(F, S, 6, 6) covariance of the rotation error about the bone's axes (exp(error) multiplies the rotation from the
    right) [rad] and of the origin in the laboratory [m]; NaN where unknown."""
    notes: tuple[str, ...] = ()
    """Remarks of the method on its result, one sentence each: what was skipped, what cannot be observed."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "segments", tuple(self.segments))
        object.__setattr__(self, "notes", tuple(self.notes))
        freeze_fields(self, "rotation", "origin", "covariance")
        shape = (len(self.rotation), len(self.segments))
        right = ((*shape, 3, 3), (*shape, 3), (*shape, 6, 6))
        if (self.rotation.shape, self.origin.shape, self.covariance.shape) != right:
            raise MareyError(f"The array shapes of a motion of {shape[1]} bones over {shape[0]} frames do not agree.")

    def __len__(self) -> int:
        return len(self.rotation)

    @property
    def answered(self) -> Mask:
        """(F, S) True where a bone has a pose."""
        return np.asarray(np.isfinite(self.rotation).all((-1, -2)) & np.isfinite(self.origin).all(-1))

    @property
    def rotation_sd(self) -> Floats:
        """(F, S, 3) standard deviation of the rotation about the bone's axes [rad]."""
        return np.asarray(np.sqrt(np.diagonal(self.covariance, axis1=-2, axis2=-1)[..., :3]))

    @property
    def origin_sd(self) -> Floats:
        """(F, S, 3) standard deviation of the origin along the laboratory's axes [m]."""
        return np.asarray(np.sqrt(np.diagonal(self.covariance, axis1=-2, axis2=-1)[..., 3:]))

    def bone(self, segment: str) -> tuple[Floats, Floats]:
        """Return one bone's rotation (F, 3, 3) and origin (F, 3) [m].

        Raises:
            MareyError: There is no such segment.
        """
        if segment not in self.segments:
            raise MareyError(f"There is no segment {segment!r}. There are: {', '.join(self.segments)}.")
        index = self.segments.index(segment)
        return self.rotation[:, index], self.origin[:, index]


def combine_bones(motions: Sequence[BoneMotion]) -> BoneMotion:
    """Combine the motions of different bones over the same frames."""
    return BoneMotion(
        segments=tuple(name for motion in motions for name in motion.segments),
        rotation=np.concatenate([m.rotation for m in motions], 1),
        origin=np.concatenate([m.origin for m in motions], 1),
        covariance=np.concatenate([m.covariance for m in motions], 1),
        notes=tuple(dict.fromkeys(note for motion in motions for note in motion.notes)),
    )
