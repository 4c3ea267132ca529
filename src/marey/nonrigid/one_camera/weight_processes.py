"""Weights of basis shapes as processes that each remember two frames: equations, and their estimate from the answer."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Integers

FIRST_MEMORY = (1.9, -0.95)
LEAST = 1e-16


@dataclass
class WeightProcesses:
    """What foretells M weights: c_f = memory_1 c_f-1 + memory_2 c_f-2 and a surprise; changed by `learn`."""

    spread: Floats
    """(M,) variance of a weight."""
    memory: Floats
    """(M, 2)."""
    surprise: Floats
    """(M,) variance."""

    def among(self, kept: Integers) -> "WeightProcesses":
        """Keep some weights alone."""
        return WeightProcesses(self.spread[kept], self.memory[kept], self.surprise[kept])

    def left(self, weights: Floats) -> Floats:
        """Give what the memory does not foretell (F - 2, M)."""
        return np.asarray(weights[2:] - self.memory[:, 0] * weights[1:-1] - self.memory[:, 1] * weights[:-2])

    def cost(self, weights: Floats) -> float:
        """Give minus the logarithm of the weights' probability, up to a constant."""
        squares = (self.left(weights) ** 2 / self.surprise).sum() + (weights[:2] ** 2 / self.spread).sum()
        logarithms = (len(weights) - 2) * np.log(self.surprise).sum() + 2 * np.log(self.spread).sum()
        return 0.5 * float(squares + logarithms)

    def add(self, diagonal: Floats, first: Floats, second: Floats, right: Floats, weights: Floats, start: int) -> None:
        """Add the processes to normal equations as in `solve_banded` whose unknowns from `start` on are the weights."""
        frames, own = len(weights), np.arange(start, start + weights.shape[1])
        left, precision = self.left(weights), 1 / self.surprise
        by = (-self.memory[:, 1], -self.memory[:, 0], np.ones(len(own)))
        for k in range(3):
            span = slice(k, frames - 2 + k)
            diagonal[span, own, own] += precision * by[k] ** 2
            right[span, start:] -= precision * by[k] * left
        first[:-2, own, own] += precision * by[0] * by[1]
        first[1:-1, own, own] += precision * by[1] * by[2]
        second[:-2, own, own] += precision * by[0] * by[2]
        diagonal[:2, own, own] += 1 / self.spread
        right[:2, start:] -= weights[:2] / self.spread

    def learn(self, weights: Floats, covariance: tuple[Floats, Floats, Floats]) -> None:
        """Estimate the processes anew; covariance (F, M, M) of the weights, with the next and the next but one."""
        c, frames = weights, len(weights)
        here, near, far = (np.einsum("fmm->fm", part) for part in covariance)
        now, last, before = ((c[k:][: frames - 2] ** 2 + here[k:][: frames - 2]).sum(0) for k in (2, 1, 0))
        now_last = (c[2:] * c[1:-1] + near[1:-1]).sum(0)
        last_before, now_before = (c[1:-1] * c[:-2] + near[:-2]).sum(0), (c[2:] * c[:-2] + far[:-2]).sum(0)
        normal = np.moveaxis(np.array([[last, last_before], [last_before, before]]), -1, 0)
        normal = normal + 1e-12 * (last + before)[:, None, None] * np.eye(2) + 1e-300 * np.eye(2)
        right = np.stack([now_last, now_before], 1)
        self.memory = np.linalg.solve(normal, right[..., None])[..., 0]
        left = now - 2 * (self.memory * right).sum(1)
        left += np.einsum("mi,mij,mj->m", self.memory, normal, self.memory)
        self.surprise = np.maximum(left / (frames - 2), LEAST * now / frames + 1e-300)
        self.spread = (c**2 + here).mean(0) + 1e-300


def processes_of(weights: Floats, floor: float) -> WeightProcesses:
    """Start from weights (F, M) with a memory of slow waves; floor is the least variance."""
    memory = np.tile(FIRST_MEMORY, (weights.shape[1], 1))
    begun = WeightProcesses((weights**2).mean(0) + floor, memory, np.ones(weights.shape[1]))
    begun.surprise = (begun.left(weights) ** 2).mean(0) + floor
    return begun
