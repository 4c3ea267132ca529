"""Paths through a sequence of frames in each of which several postures are possible."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats


@dataclass(frozen=True, eq=False)
class PosturePaths:
    """All paths that have one of several postures in each frame: a hidden Markov chain."""

    support: Sequence[Floats]
    """(n,) log-likelihood of each posture, for each of T frames."""
    changes: Sequence[Floats]
    """(n, m) log-probability of each change from a posture to one of the next frame, for each of T - 1 pairs of
    frames; constants do not matter."""

    def best(self) -> list[int]:
        """Return the posture of each frame on the most probable path (Viterbi's algorithm)."""
        total, before = self.support[0], list[Floats]()
        for change, own in zip(self.changes, self.support[1:], strict=True):
            ways = total[:, None] + change
            before.append(ways.argmax(axis=0))
            total = ways.max(axis=0) + own
        path = [int(total.argmax())]
        for step in reversed(before):
            path.append(int(step[path[-1]]))
        return path[::-1]

    def probabilities(self) -> list[Floats]:
        """Return the probability of each posture (n,) in each frame over all paths (forward-backward algorithm)."""
        forward: list[Floats] = [self.support[0]]
        for change, own in zip(self.changes, self.support[1:], strict=True):
            forward.append(_log_sum(forward[-1][:, None] + change, axis=0) + own)
        backward: list[Floats] = [np.zeros(len(self.support[-1]))]
        for change, own in zip(reversed(self.changes), reversed(self.support[1:]), strict=True):
            backward.append(_log_sum(change + own + backward[-1], axis=1))
        joint = [ahead + behind for ahead, behind in zip(forward, reversed(backward), strict=True)]
        return [np.exp(each - _log_sum(each, axis=0)) for each in joint]


def _log_sum(logarithms: Floats, axis: int) -> Floats:
    """Return the logarithm of the sum of numbers that are given by their logarithms."""
    largest = logarithms.max(axis=axis, keepdims=True)
    return np.asarray(np.log(np.exp(logarithms - largest).sum(axis=axis)) + largest.squeeze(axis))
