"""The chain of named transforms from the scanner's frame to the moving bone in the laboratory."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, freeze_fields
from marey.errors import MareyError
from marey.geometry import rotations
from marey.geometry.vectors import products
from marey.markers.data.bone_motion import BoneMotion

MR_GLOBAL = "MR global"
"""Name of the scanner's frame."""
MR_ANATOMIC = "MR anatomic"
"""Name of the bone's frame in the scanner."""
CAPTURE_ANATOMIC = "capture anatomic"
"""Name of the bone's frame in the reference posture."""
CAPTURE_DEFORMED = "capture deformed"
"""Name of the cluster's frame before the correction of the skin's motion."""
CAPTURE_BONE = "capture bone"
"""Name of the bone's frame in each frame of the trial."""
CAPTURE_GLOBAL = "capture global"
"""Name of the laboratory's frame."""
CHAIN = (MR_GLOBAL, MR_ANATOMIC, CAPTURE_ANATOMIC, CAPTURE_DEFORMED, CAPTURE_BONE, CAPTURE_GLOBAL)
"""The frames in the order of [Alexander2003] table 1; those after `capture anatomic` are time-dependent."""


@dataclass(frozen=True, eq=False, kw_only=True)
class NamedTransform:
    """A rigid transform between two named frames, constant or one per frame of the trial: p_to = R p_from + t."""

    to: str
    """Name of the target frame."""
    from_: str
    """Name of the source frame."""
    rotation: Floats
    """(3, 3) or (F, 3, 3); NaN where the trial has no result."""
    translation: Floats
    """(3,) or (F, 3), in the unit of the points [m]."""
    covariance: Floats | None = None
    """(6, 6) or (F, 6, 6) covariance of the rotation error (exp(error) multiplies the rotation from the right) [rad]
    and of the translation [m]; None for an exact transform."""

    def __post_init__(self) -> None:
        freeze_fields(self, "rotation", "translation")
        batch = self.rotation.shape[:-2]
        fits = self.rotation.shape == (*batch, 3, 3) and self.translation.shape == (*batch, 3) and len(batch) < 2
        if self.covariance is not None:
            freeze_fields(self, "covariance")
            fits = fits and self.covariance.shape == (*batch, 6, 6)
        if not fits:
            raise MareyError(f"The array shapes of the transform to {self.to!r} from {self.from_!r} do not agree.")

    @property
    def moves(self) -> bool:
        """True for one transform per frame of the trial, False for a constant one."""
        return self.rotation.ndim == 3

    def __matmul__(self, other: "NamedTransform") -> "NamedTransform":
        """Compose c_from_a = c_from_b @ b_from_a, with the covariance of both to first order.

        Raises:
            MareyError: The inner frames differ, or two motions have different numbers of frames.
        """
        if self.from_ != other.to:
            raise MareyError(
                f"A transform from {self.from_!r} cannot follow one to {other.to!r} "
                f"({self.to} from {self.from_}, {other.to} from {other.from_})."
            )
        if self.moves and other.moves and len(self.rotation) != len(other.rotation):
            raise MareyError(
                f"{self.to} from {self.from_} has {len(self.rotation)} frames, "
                f"{other.to} from {other.from_} has {len(other.rotation)}."
            )
        return NamedTransform(
            to=self.to, from_=other.from_, rotation=self.rotation @ other.rotation,
            translation=products(self.rotation, other.translation) + self.translation,
            covariance=_composed(self, other),
        )  # fmt: skip

    def inverse(self) -> "NamedTransform":
        """Return a_from_b for b_from_a, with its covariance."""
        turned = np.swapaxes(self.rotation, -1, -2)
        covariance = None
        if self.covariance is not None:
            # R' = exp(-w) R^T = R^T exp(-R w);  t' = -exp(-w) R^T (t + dt)
            jacobian = np.zeros((*self.rotation.shape[:-2], 6, 6))
            jacobian[..., :3, :3] = -self.rotation
            jacobian[..., 3:, :3] = rotations.hat(products(turned, self.translation)) * -1.0
            jacobian[..., 3:, 3:] = -turned
            covariance = _propagated(jacobian, self.covariance)
        return NamedTransform(
            to=self.from_, from_=self.to, rotation=turned, translation=-products(turned, self.translation),
            covariance=covariance,
        )  # fmt: skip

    def apply(self, points: Floats) -> Floats:
        """Transform points.

        Args:
            points: (..., N, 3) in the frame `from_`; for a moving transform (N, 3), which it transforms in every frame,
                or (F, N, 3).

        Returns:
            (N, 3), or (F, N, 3) for a moving transform.
        """
        points = np.asarray(points, float)
        return np.asarray(points @ np.swapaxes(self.rotation, -1, -2) + self.translation[..., None, :])

    def at(self, frame: int) -> "NamedTransform":
        """Return the constant transform of one frame of the trial."""
        if not self.moves:
            return self
        covariance = None if self.covariance is None else self.covariance[frame]
        return NamedTransform(
            to=self.to, from_=self.from_, rotation=self.rotation[frame], translation=self.translation[frame],
            covariance=covariance,
        )  # fmt: skip

    def matrix(self) -> Floats:
        """Return the homogeneous matrix (4, 4) or (F, 4, 4)."""
        matrix = np.zeros((*self.rotation.shape[:-2], 4, 4))
        matrix[..., :3, :3], matrix[..., :3, 3], matrix[..., 3, 3] = self.rotation, self.translation, 1.0
        return matrix


def identity(to: str, from_: str) -> NamedTransform:
    """Create the identity between two frames with different names."""
    return NamedTransform(to=to, from_=from_, rotation=np.eye(3), translation=np.zeros(3))


def compose(*transforms: NamedTransform) -> NamedTransform:
    """Compose transforms in the order of a product: the last one acts first.

    Raises:
        MareyError: Two neighbours do not share a frame, or there are no transforms.
    """
    if not transforms:
        raise MareyError("There is no transform to compose.")
    whole = transforms[0]
    for transform in transforms[1:]:
        whole = whole @ transform
    return whole


@dataclass(frozen=True, eq=False, kw_only=True)
class TransformChain:
    """The five steps of [Alexander2003] table 1 for one bone, each by its own name."""

    mr_anatomic_from_mr_global: NamedTransform
    """Measured: the anatomical element in the bone's own frame in the scanner."""
    capture_anatomic_from_mr_anatomic: NamedTransform
    """Optimised: internal to external, from the markers visible in both the scanner and the laboratory."""
    deformed_from_capture_anatomic: NamedTransform
    """Measured in each frame: the deformed cluster from the bone in the reference posture."""
    bone_from_deformed: NamedTransform
    """Optimised in each frame: the correction of the skin's motion."""
    capture_global_from_bone: NamedTransform
    """Measured in each frame: the motion of the bone in the laboratory."""

    def __post_init__(self) -> None:
        for number, step in enumerate(self.steps):
            if (step.to, step.from_) != (CHAIN[number + 1], CHAIN[number]):
                raise MareyError(
                    f"Step {number + 1} of the chain leads to {CHAIN[number + 1]!r} from {CHAIN[number]!r}, "
                    f"not to {step.to!r} from {step.from_!r}."
                )

    @property
    def steps(self) -> tuple[NamedTransform, ...]:
        """The five steps in the order in which they are applied to a point."""
        return (
            self.mr_anatomic_from_mr_global, self.capture_anatomic_from_mr_anatomic,
            self.deformed_from_capture_anatomic, self.bone_from_deformed, self.capture_global_from_bone,
        )  # fmt: skip

    def between(self, to: str, from_: str) -> NamedTransform:
        """Compose the steps from one frame of the chain to another, in either direction.

        Raises:
            MareyError: The chain has no such frame.
        """
        unknown = [name for name in (to, from_) if name not in CHAIN]
        if unknown:
            raise MareyError(f"The chain has no frame {', '.join(unknown)}. It has: {', '.join(CHAIN)}.")
        start, end = CHAIN.index(from_), CHAIN.index(to)
        if start == end:
            return identity(to, from_)
        if start > end:
            return self.between(from_, to).inverse()
        return compose(*reversed(self.steps[start:end]))


def bone_steps(
    cluster: BoneMotion, corrected: BoneMotion, segment: str
) -> tuple[NamedTransform, NamedTransform, NamedTransform]:
    """Create the last three steps of the chain from the motion of a bone before and after the skin correction.

    The cluster's frame coincides with the bone's in the reference posture, so that the third step is the identity; the
    fourth is the correction of the bone relative to the cluster; the fifth is the motion of the cluster. The fourth
    step has the covariance of the corrected motion.

    Args:
        cluster: The motion of the bone by the cluster alone (the rigid fit, or the point cluster technique).
        corrected: The estimate of the method; pass the same motion twice for a method without a correction.
        segment: Name of the bone.

    Returns:
        The steps `deformed_from_capture_anatomic`, `bone_from_deformed` and `capture_global_from_bone`.
    """
    moved = NamedTransform(
        to=CAPTURE_GLOBAL, from_=CAPTURE_BONE, rotation=cluster.bone(segment)[0], translation=cluster.bone(segment)[1]
    )
    covariance = corrected.covariance[:, corrected.segments.index(segment)]
    bone = NamedTransform(
        to=CAPTURE_GLOBAL, from_=CAPTURE_DEFORMED, rotation=corrected.bone(segment)[0],
        translation=corrected.bone(segment)[1], covariance=covariance,
    )  # fmt: skip
    return identity(CAPTURE_DEFORMED, CAPTURE_ANATOMIC), moved.inverse() @ bone, moved


def _propagated(jacobian: Floats, covariance: Floats) -> Floats:
    return np.asarray(jacobian @ covariance @ np.swapaxes(jacobian, -1, -2))


def _composed(first: NamedTransform, second: NamedTransform) -> Floats | None:
    """Return the covariance of first @ second: R1 exp(w1) R2 exp(w2), and R1 exp(w1) (t2 + dt2) + t1 + dt1."""
    if first.covariance is None and second.covariance is None:
        return None
    batch = np.broadcast_shapes(first.rotation.shape[:-2], second.rotation.shape[:-2])
    total = np.zeros((*batch, 6, 6))
    if first.covariance is not None:
        jacobian = np.zeros((*batch, 6, 6))
        jacobian[..., :3, :3] = np.swapaxes(second.rotation, -1, -2)
        jacobian[..., 3:, :3] = -first.rotation @ rotations.hat(second.translation)
        jacobian[..., 3:, 3:] = np.eye(3)
        total = total + _propagated(jacobian, first.covariance)
    if second.covariance is not None:
        jacobian = np.zeros((*batch, 6, 6))
        jacobian[..., :3, :3] = np.eye(3)
        jacobian[..., 3:, 3:] = first.rotation
        total = total + _propagated(jacobian, second.covariance)
    return total
