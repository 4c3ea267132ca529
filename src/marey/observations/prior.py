"""What is known before looking: limits of joints, habits, the last motion, other people's shapes."""

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
    """Angles stay within the limits of their joints: only what lies beyond counts."""

    sigma_rad: float = float(np.deg2rad(3.0))
    """How far beyond a limit an angle may stray [rad]."""

    @property
    def sigma(self) -> float:
        """Standard deviation of a residual [rad]."""
        return self.sigma_rad

    def by_angle(self, posed: PosedBody) -> tuple[Floats, Floats]:
        """Give the overshoot of each angle, zero inside the limits."""
        low, high = posed.body.skeleton.limits.T
        angles = posed.pose.angles
        residual = np.minimum(angles - low, 0.0) + np.maximum(angles - high, 0.0)
        return residual, (residual != 0.0).astype(float)


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class Habit(AngleObservation):
    """Angles lie where people's joints usually are."""

    share: float = 1.0
    """How many such observations the habit is worth."""

    @property
    def sigma(self) -> float:
        """Standard deviation of a residual, in units of each joint's own spread."""
        return 1.0 / np.sqrt(self.share)

    def by_angle(self, posed: PosedBody) -> tuple[Floats, Floats]:
        """Give each angle's distance from its habit, in units of its spread."""
        mean, sd = posed.body.skeleton.habit
        return (posed.pose.angles - mean) / sd, 1.0 / sd


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class NearPose(Observation):
    """The pose lies near another one: a prediction, or the middle of its neighbours in time."""

    pose: Pose
    spread: Floats
    """(D,) standard deviation of each coordinate [m, rad]; infinite where nothing is known."""

    @property
    def sigma(self) -> float:
        """Standard deviation of a residual, in units of the spread."""
        return 1.0

    def linearize(self, posed: PosedBody, *, shape: bool = False) -> Linearization:
        """Give the change from the other pose, in units of the spread."""
        change = self.pose.change_to(posed.pose)
        jacobian = np.zeros((len(change), _columns(posed, shape)))
        np.fill_diagonal(jacobian, 1.0 / self.spread)
        jacobian[3:6, 3:6] = rotations.inverse_left_jacobian_of(change[3:6]) / self.spread[3:6, None]
        return Linearization(change / self.spread, jacobian)


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class ShapePrior(Observation):
    """The shape numbers lie where other people's do."""

    share: float = 1.0
    """How many such observations the prior is worth."""

    @property
    def sigma(self) -> float:
        """Standard deviation of a residual, in units of the prior."""
        return 1.0 / np.sqrt(self.share)

    def linearize(self, posed: PosedBody, *, shape: bool = False) -> Linearization:
        """Give the whitened distance of the numbers from the prior's mean."""
        space = posed.body.space
        whiten = np.linalg.inv(np.linalg.cholesky(space.prior_covariance))
        jacobian = np.zeros((len(space), _columns(posed, shape)))
        if shape:
            jacobian[:, jacobian.shape[1] - len(space) :] = whiten
        return Linearization(whiten @ (posed.body.numbers - space.prior_mean), jacobian)
