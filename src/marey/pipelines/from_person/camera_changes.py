"""Whether cameras that a person has refined differ from the given ones by more than their standard deviations."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from marey.arrays import Floats
from marey.cameras.camera import Camera
from marey.cameras.parameters import LENS_PARAMETERS, PARAMETERS
from marey.geometry import rotations

SIGNIFICANT = 1e-3
"""Probability of changes as large as these if the given cameras are right, below which the person contradicts them. The
true cameras of `reach`, before which the person stays in one place, have 0.6 with 60 frames and 0.01 with 40: the
misfits of a body in few postures are alike. Chosen by hand."""
_FREE = 1e-9
"""Variance, as a share of the largest, above which a direction of the parameters was estimated. Chosen by hand."""


@dataclass(frozen=True, kw_only=True)
class CameraChanges:
    """The changes of all cameras together, against their covariance."""

    chi_square: float
    """Sum of the squared changes in standard deviations, of independent directions."""
    degrees_of_freedom: int
    probability: float
    """Probability of changes as large as these if the given cameras are right."""
    most: str
    """The camera whose change is the largest in its own standard deviations."""

    @property
    def significant(self) -> bool:
        """Whether the person contradicts the given cameras, so that the new ones should be used."""
        return self.probability < SIGNIFICANT

    @property
    def chance(self) -> str:
        """The probability as a text."""
        return f"{self.probability:.2g}" if self.probability >= 1e-3 else "below 0.001"

    def finding(self) -> dict[str, str]:
        """Return what follows for the use of the cameras, as a finding."""
        known = f"(chi-square {self.chi_square:.1f}, {self.degrees_of_freedom} degrees of freedom, probability "
        known += f"{self.chance})"
        if self.significant:
            text = f"The cameras have changed by more than their standard deviations explain {known}, most {self.most}."
            return {"code": "use-new-cameras", "severity": "note", "text": text, "advice": "Use the new cameras."}
        text = f"The changes of the cameras are within their standard deviations {known}."
        advice = "Keep the given cameras: the person does not contradict them."
        return {"code": "keep-given-cameras", "severity": "note", "text": text, "advice": advice}


def camera_changes(before: Sequence[Camera], after: Sequence[Camera], covariance: Floats) -> CameraChanges:
    """Compare cameras with those from which their refinement began.

    Args:
        before: C given cameras.
        after: The refined cameras in the same order.
        covariance: (15 C, 15 C) of the parameters of the refined cameras. Directions without variance, as the position
            of the cameras as a whole, are not compared.
    """
    changes = np.array([_pose_change(old, new) for old, new in zip(before, after, strict=True)])
    free = (PARAMETERS * np.arange(len(changes))[:, None] + np.arange(LENS_PARAMETERS, PARAMETERS)).ravel()
    poses = covariance[np.ix_(free, free)]
    chi_square, degrees = _chi_square(changes.ravel(), poses)
    size = changes.shape[1]
    own = [_chi_square(each, poses[size * c : size * (c + 1), size * c : size * (c + 1)]) for c, each in
           enumerate(changes)]  # fmt: skip
    least = int(np.argmin([chdtrc(count, value) if count else 1.0 for value, count in own]))
    probability = float(chdtrc(degrees, chi_square)) if degrees else 1.0
    return CameraChanges(
        chi_square=chi_square, degrees_of_freedom=degrees, probability=probability, most=after[least].name
    )


def _pose_change(before: Camera, after: Camera) -> Floats:
    """Return the change (6,) of the pose's parameters: left rotation [rad] and translation [m]."""
    old, new = before.camera_from_world, after.camera_from_world
    return np.concatenate([rotations.log(new.rotation @ old.rotation.T), new.translation - old.translation])


def _chi_square(change: Floats, covariance: Floats) -> tuple[float, int]:
    """Return the squared change (n,) in standard deviations, and the number of directions with a variance."""
    variances, directions = np.linalg.eigh(0.5 * (covariance + covariance.T))
    free = variances > _FREE * max(float(variances.max()), 1e-300)
    return float(((directions.T @ change)[free] ** 2 / variances[free]).sum()), int(free.sum())
