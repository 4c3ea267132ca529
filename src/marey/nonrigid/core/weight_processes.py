"""Weights of deformation modes as second-order autoregressive processes: normal equations and estimation."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Integers, freeze_fields

INITIAL_AUTOREGRESSION = (1.9, -0.95)
"""Coefficients of the last weight and the one before from which estimation starts: a slowly varying oscillation of
about 28 frames. Chosen by hand; results were not measured against other values."""
_LEAST_INNOVATION = 1e-16
"""Smallest innovation variance, as a fraction of the weight's mean square; keeps exact data solvable."""


@dataclass(frozen=True, eq=False)
class WeightProcesses:
    """Autoregressive processes of M weights, c_f = a_1 c_f-1 + a_2 c_f-2 plus a random innovation."""

    weight_variance: Floats
    """(M,) variance of a weight."""
    autoregression: Floats
    """(M, 2) coefficients a_1 and a_2."""
    innovation_variance: Floats
    """(M,) variance of the innovation."""

    def __post_init__(self) -> None:
        freeze_fields(self, "weight_variance", "autoregression", "innovation_variance")

    def among(self, kept: Integers) -> "WeightProcesses":
        """Return the processes of the selected weights.

        Args:
            kept: (n,) indices of weights, or a mask (M,).
        """
        return WeightProcesses(self.weight_variance[kept], self.autoregression[kept], self.innovation_variance[kept])

    def innovations(self, weights: Floats) -> Floats:
        """Compute the part of weights (F, M) that the two preceding frames do not predict, (F - 2, M)."""
        return np.asarray(
            weights[2:] - self.autoregression[:, 0] * weights[1:-1] - self.autoregression[:, 1] * weights[:-2]
        )

    def cost(self, weights: Floats) -> float:
        """Compute minus the log-probability of weights (F, M), up to a constant."""
        squares = (self.innovations(weights) ** 2 / self.innovation_variance).sum()
        squares += (weights[:2] ** 2 / self.weight_variance).sum()
        logarithms = (len(weights) - 2) * np.log(self.innovation_variance).sum()
        logarithms += 2 * np.log(self.weight_variance).sum()
        return 0.5 * float(squares + logarithms)

    def add(self, diagonal: Floats, first: Floats, second: Floats, right: Floats, weights: Floats, start: int) -> float:
        """Add the processes to normal equations, as in `solve_banded`, whose unknowns from `start` on are the weights.

        Args:
            diagonal: (F, D, D) blocks; changed in place, as are the other blocks.
            first: (F, D, D) blocks that couple a frame with the next.
            second: (F, D, D) blocks that couple a frame with the next but one.
            right: (F, D) right-hand side.
            weights: (F, M) current weights.
            start: Index of the first weight among the unknowns of a frame.

        Returns:
            Sum of the squared innovations and of the first two frames' squared weights, each over its variance.
        """
        frames, own = len(weights), np.arange(start, start + weights.shape[1])
        left, precision = self.innovations(weights), 1 / self.innovation_variance
        by = (-self.autoregression[:, 1], -self.autoregression[:, 0], np.ones(len(own)))
        for k in range(3):
            span = slice(k, frames - 2 + k)
            diagonal[span, own, own] += precision * by[k] ** 2
            right[span, start:] -= precision * by[k] * left
        first[:-2, own, own] += precision * by[0] * by[1]
        first[1:-1, own, own] += precision * by[1] * by[2]
        second[:-2, own, own] += precision * by[0] * by[2]
        diagonal[:2, own, own] += 1 / self.weight_variance
        right[:2, start:] -= weights[:2] / self.weight_variance
        return float((left**2 * precision).sum() + (weights[:2] ** 2 / self.weight_variance).sum())


def initial_processes(weights: Floats, floor: float) -> WeightProcesses:
    """Create processes with the initial autoregression (`INITIAL_AUTOREGRESSION`).

    Args:
        weights: (F, M).
        floor: Added to all variances.
    """
    autoregression = np.tile(INITIAL_AUTOREGRESSION, (weights.shape[1], 1))
    variance = (weights**2).mean(0) + floor
    unit = WeightProcesses(variance, autoregression, np.ones(weights.shape[1]))
    return WeightProcesses(variance, autoregression, (unit.innovations(weights) ** 2).mean(0) + floor)


def estimated_processes(weights: Floats, covariance: tuple[Floats, Floats, Floats]) -> WeightProcesses:
    """Estimate the processes from weights and their uncertainty (the M step of expectation maximisation).

    Args:
        weights: (F, M) expected weights.
        covariance: (F, M, M) of a frame's weights, with those of the next frame, and of the next but one.
    """
    c, frames = weights, len(weights)
    here, near, far = (np.einsum("fmm->fm", part) for part in covariance)
    now, last, before = ((c[k:][: frames - 2] ** 2 + here[k:][: frames - 2]).sum(0) for k in (2, 1, 0))
    now_last = (c[2:] * c[1:-1] + near[1:-1]).sum(0)
    last_before, now_before = (c[1:-1] * c[:-2] + near[:-2]).sum(0), (c[2:] * c[:-2] + far[:-2]).sum(0)
    normal = np.moveaxis(np.array([[last, last_before], [last_before, before]]), -1, 0)
    normal = normal + 1e-12 * (last + before)[:, None, None] * np.eye(2) + 1e-300 * np.eye(2)
    right = np.stack([now_last, now_before], 1)
    autoregression = np.linalg.solve(normal, right[..., None])[..., 0]
    left = now - 2 * (autoregression * right).sum(1)
    left += np.einsum("mi,mij,mj->m", autoregression, normal, autoregression)
    innovation = np.maximum(left / (frames - 2), _LEAST_INNOVATION * now / frames + 1e-300)
    return WeightProcesses((c**2 + here).mean(0) + 1e-300, autoregression, innovation)
