"""Priors of pose and shape: joint limits, usual angles, a predicted pose, and the shapes of people."""

from dataclasses import dataclass
from typing import final

import numpy as np

from marey.arrays import Floats
from marey.body.articulation.pose import Pose, PosedBody
from marey.geometry import rotations
from marey.observations.observation import AngleObservation, Linearization, Observation


def _columns(posed: PosedBody, shape: bool) -> int:
    return 6 + len(posed.pose.angles) + (len(posed.body.space) if shape else 0)


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class JointLimits(AngleObservation):
    """Prior that angles stay within the limits of their joints; only the excess counts."""

    sigma_rad: float = float(np.deg2rad(3.0))
    """Standard deviation of an angle's excess over its limit [rad]."""

    @property
    def sigma(self) -> float:
        """Standard deviation of a residual [rad]."""
        return self.sigma_rad

    def by_angle(self, posed: PosedBody) -> tuple[Floats, Floats]:
        """Return the excess of each angle, zero within the limits."""
        low, high = posed.body.skeleton.limits.T
        angles = posed.pose.angles
        residual = np.minimum(angles - low, 0.0) + np.maximum(angles - high, 0.0)
        return residual, (residual != 0.0).astype(float)


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class Habit(AngleObservation):
    """Prior that angles are near those of usual postures."""

    share: float = 1.0
    """Weight, as a number of observations."""

    @property
    def sigma(self) -> float:
        """Standard deviation of a residual, in units of each joint's own spread."""
        return float(1.0 / np.sqrt(self.share))

    def by_angle(self, posed: PosedBody) -> tuple[Floats, Floats]:
        """Return each angle's difference from its usual value, in units of its standard deviation."""
        mean, sd = posed.body.skeleton.habit
        return (posed.pose.angles - mean) / sd, 1.0 / sd


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class NearPose(Observation):
    """Prior that the pose is near another one: a prediction, or the mean of its neighbours in time."""

    pose: Pose
    """The other pose."""
    spread: Floats
    """(D,) standard deviation of each coordinate [m, rad]; infinite for no prior."""

    @property
    def sigma(self) -> float:
        """Standard deviation of a residual, in units of the spread."""
        return 1.0

    def linearize(self, posed: PosedBody, *, shape: bool = False) -> Linearization:
        """Return the change from the other pose, in units of the standard deviations."""
        change = self.pose.change_to(posed.pose)
        jacobian = np.zeros((len(change), _columns(posed, shape)))
        np.fill_diagonal(jacobian, 1.0 / self.spread)
        jacobian[3:6, 3:6] = rotations.inverse_left_jacobian_of(change[3:6]) / self.spread[3:6, None]
        return Linearization(change / self.spread, jacobian)


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class ShapePrior(Observation):
    """Prior of the shape parameters from the variation among people."""

    share: float = 1.0
    """Weight, as a number of observations."""

    @property
    def sigma(self) -> float:
        """Standard deviation of a residual, in units of the prior."""
        return float(1.0 / np.sqrt(self.share))

    def linearize(self, posed: PosedBody, *, shape: bool = False) -> Linearization:
        """Return the whitened difference of the numbers from the prior's mean."""
        space = posed.body.space
        whiten = np.linalg.inv(np.linalg.cholesky(space.prior_covariance))
        jacobian = np.zeros((len(space), _columns(posed, shape)))
        if shape:
            jacobian[:, jacobian.shape[1] - len(space) :] = whiten
        return Linearization(whiten @ (posed.body.numbers - space.prior_mean), jacobian)
