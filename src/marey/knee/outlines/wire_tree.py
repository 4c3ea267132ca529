"""Cheapest paths along the edges between pixels, computed only as far as they are needed."""

import numpy as np
from numpy.typing import NDArray

from marey.arrays import Integers
from marey.compiled.kernels import kernel

MOST_COST = 1023
"""Largest cost of a step, below the number of buckets."""
_BUCKETS = 1024
"""Number of buckets of the queue: a power of two above the largest cost."""
_FAR = np.iinfo(np.int32).max
"""Cost of a corner that has not been reached."""
_NONE = -1
"""Entry that marks the end of a list, and the step into the root."""

Costs = NDArray[np.int32]


class WireTree:
    """The cheapest paths from one corner to the others, computed on the fly after [Falcao2000].

    The tree grows until it contains the queried corner, and is kept, so that further queries only extend it. Corners
    wait in a ring of buckets by their cost ([Dial1969]), without sorting.

    Args:
        costs: (rows + 1, columns + 1, 4) integers from 1 to `MOST_COST`: cost of the step from each corner to
            the right, down, to the left and up; 0 where there is no step, as at the border of the slice.
        root: Row and column of the corner where the paths begin.
    """

    def __init__(self, costs: Costs, root: tuple[int, int]):
        rows, self._columns = costs.shape[:2]
        corners = rows * self._columns
        self._costs = np.ascontiguousarray(costs).reshape(-1)
        self._least = np.full(corners, _FAR, np.int32)
        self._step_in = np.full(corners, _NONE, np.int8)
        self._settled = np.zeros(corners, np.bool_)
        # Each step enters the queue at most once, when its start is settled: its index is its entry.
        self._behind = np.empty(4 * corners, np.int32)
        self._first = np.full(_BUCKETS, _NONE, np.int32)
        self._reached = np.zeros(2, np.int64)
        start = self._number(root)
        self._least[start] = 0
        _settle(start, self._columns, *self._arrays)

    def cost(self, corner: tuple[int, int]) -> int:
        """Return the sum of the costs of the cheapest path from the root to a corner.

        Raises:
            ValueError: No path leads there.
        """
        at = self._grown_to(corner)
        return int(self._least[at])

    def path(self, corner: tuple[int, int]) -> Integers:
        """Return rows and columns (n, 2) of the corners of the cheapest path from the root to a corner.

        Raises:
            ValueError: No path leads there.
        """
        back = _walked_back(self._grown_to(corner), self._columns, self._step_in)
        return np.stack(np.divmod(back[::-1], self._columns), axis=1)

    @property
    def _arrays(self) -> tuple[np.ndarray, ...]:
        return self._costs, self._least, self._step_in, self._settled, self._behind, self._first, self._reached

    def _number(self, corner: tuple[int, int]) -> int:
        return int(corner[0] * self._columns + corner[1])

    def _grown_to(self, corner: tuple[int, int]) -> int:
        at = self._number(corner)
        if not self._settled[at]:
            _grow(at, self._columns, *self._arrays)
        if not self._settled[at]:
            raise ValueError(f"no path leads to corner {corner}")
        return at


def reversed_costs(costs: Costs) -> Costs:
    """Return the costs of all steps reversed: a tree on them contains the paths that end at its root."""
    turned = np.zeros_like(costs)
    turned[:, 1:, 2], turned[:, :-1, 0] = costs[:, :-1, 0], costs[:, 1:, 2]
    turned[1:, :, 3], turned[:-1, :, 1] = costs[:-1, :, 1], costs[1:, :, 3]
    return turned


@kernel
def _settle(at, columns, costs, least, step_in, settled, behind, first, reached):  # type: ignore[no-untyped-def]
    """Make a corner's cost final, and queue its neighbours with their costs through it."""
    settled[at] = True
    for step in range(4):
        price = costs[4 * at + step]
        if price == 0:
            continue
        neighbour = at + _offset(step, columns)
        cost = least[at] + price
        if cost >= least[neighbour]:
            continue
        least[neighbour] = cost
        step_in[neighbour] = step
        bucket = cost & (_BUCKETS - 1)
        behind[4 * at + step] = first[bucket]
        first[bucket] = 4 * at + step
        reached[1] += 1


@kernel
def _grow(goal, columns, costs, least, step_in, settled, behind, first, reached):  # type: ignore[no-untyped-def]
    """Settle corners in the order of their costs until the goal is; `reached`: the cost so far, and steps waiting."""
    while not settled[goal] and reached[1] > 0:
        bucket = reached[0] & (_BUCKETS - 1)
        entry = first[bucket]
        if entry < 0:
            reached[0] += 1
            continue
        first[bucket] = behind[entry]
        reached[1] -= 1
        at = (entry >> 2) + _offset(entry & 3, columns)
        if not settled[at]:  # otherwise a cheaper step has reached it
            _settle(at, columns, costs, least, step_in, settled, behind, first, reached)


@kernel(inline="always")
def _offset(step, columns):  # type: ignore[no-untyped-def]
    """Return the change of a corner's number by a step."""
    if step == 0:
        return 1
    if step == 1:
        return columns
    return -1 if step == 2 else -columns


@kernel
def _walked_back(at, columns, step_in):  # type: ignore[no-untyped-def]
    """Return the corners from one to the root."""
    corners = [at]
    while step_in[at] >= 0:
        at -= _offset(step_in[at], columns)
        corners.append(at)
    return np.array(corners)
