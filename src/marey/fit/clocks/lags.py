"""Search for the offsets of all cameras to about half a frame: the lags at which their signals agree best."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Integers
from marey.compiled.kernels import kernel
from marey.fit.clocks.comparison import SampledSignal

LARGEST_PX = 15.0
"""Differences of two signals above this count as this [px]: a silhouette with an error, or a wrong lag. Chosen by
hand."""
LEAST_COMMON = 0.3
"""Least share of the largest number of common samples of two cameras for which a lag is compared. Chosen by hand."""
LEAST_COMMON_SAMPLES = 20
"""Least number of common samples of two cameras for which a lag is compared. Chosen by hand."""
BLOCK_S = 0.5
"""Length of the blocks of time whose errors count as independent [s]: about a step. Chosen by hand."""
MOST_BLOCKS = 400
"""Largest number of blocks that are compared lag by lag; those of videos of more than 200 s are longer, so that memory
does not grow any further. Chosen by hand."""
SWEEPS = 20
"""Largest number of sweeps over the cameras in which lags are improved one by one. Chosen by hand."""
CLEAR_SD = 3.0
"""Number of standard deviations by which the best lag of a camera must agree better than any other one. Chosen by
hand."""
CLEAR_PX, CLEAR_SHARE = 0.5, 0.5
"""A lag is clearly worse, however few common samples there are, if the mean difference of the signals grows by more
than this [px] and by more than this share of itself. Chosen by hand: of the wrong lags of five rendered takes, each 4
frames or more from the right one, the least increase was by 60 %."""


@dataclass(frozen=True, eq=False)
class PairCosts:
    """How well the signals of two cameras agree at each lag, in blocks of time."""

    sums_px: Floats
    """(L, B) sum of the signals' absolute differences, each at most `LARGEST_PX` [px]."""
    counts: Floats
    """(L, B) number of samples in the sum."""

    @property
    def mean_px(self) -> Floats:
        """(L,) mean difference [px]; NaN for lags with too few samples."""
        counts = self.counts.sum(axis=1)
        enough = counts >= max(LEAST_COMMON_SAMPLES, LEAST_COMMON * counts.max(initial=0.0))
        return np.where(enough, self.sums_px.sum(axis=1) / np.maximum(counts, 1), np.nan)


def pair_costs(signals: Sequence[SampledSignal], step: float, reach: int) -> dict[tuple[int, int], PairCosts]:
    """Compare the signals of each pair of cameras at each lag, a multiple of a step.

    Args:
        signals: Signals of all pairs.
        step: Step of the lags [s]; the signals are sampled with it.
        reach: Largest lag [steps].

    Returns:
        The costs by pair of cameras, the smaller number first, at lags of the second one from -reach to reach.
    """
    duration = max((max(times[-1] for times in signal.times) for signal in signals), default=0.0)
    length = max(BLOCK_S, duration / MOST_BLOCKS)
    shape = 2 * reach + 1, 1 + int(duration / length)
    found: dict[tuple[int, int], PairCosts] = {}
    for signal in signals:
        i, j = sorted(signal.cameras)
        pair = found.setdefault((i, j), PairCosts(np.zeros(shape), np.zeros(shape)))
        first, second = signal.resampled(i, step), signal.resampled(j, step)
        block = (np.arange(len(first)) * step / length).astype(np.int64)
        add_costs(first, second, block, reach, pair.sums_px, pair.counts)
    return found


@kernel
def add_costs(first, second, block, reach, sums, counts):
    """Compare two sampled signals at each lag.

    Args:
        first: (n, 2) angle [rad] and radians per pixel of the first camera; NaN if unknown.
        second: (m, 2) the same of the second one.
        block: (n,) block of time of each sample of the first one.
        reach: Largest lag [samples].
        sums: (2 reach + 1, B) to which the bounded differences are added [px].
        counts: (2 reach + 1, B) to which the numbers of known samples are added.
    """
    for row in range(2 * reach + 1):
        lag = row - reach
        for i in range(max(0, lag), min(len(first), len(second) + lag)):
            turn = first[i, 0] - second[i - lag, 0]
            turn = abs(turn - 2.0 * math.pi * np.rint(turn / (2.0 * math.pi)))
            spread = math.sqrt(first[i, 1] ** 2 + second[i - lag, 1] ** 2)
            # A comparison with NaN is false: what is unknown does not count.
            if turn < LARGEST_PX * spread:
                sums[row, block[i]] += turn / spread
                counts[row, block[i]] += 1.0
            elif turn >= LARGEST_PX * spread:
                sums[row, block[i]] += LARGEST_PX
                counts[row, block[i]] += 1.0


@dataclass(frozen=True, eq=False)
class LagSearch:
    """The lags of all cameras, as multiples of a step."""

    costs: Mapping[tuple[int, int], PairCosts]
    """Costs of each pair, at lags from -M to M steps."""
    count: int
    """Number of cameras C."""
    reach: int
    """Largest lag M of two cameras [steps]."""

    def best(self) -> Integers:
        """Return the lag (C,) of each camera behind the first [steps], at which all pairs together agree best.

        From the lags that each camera alone suggests for all others, those of single cameras are changed as long as
        the sum over all pairs falls.
        """
        tables = {pair: self._table(costs) for pair, costs in self.costs.items()}
        found = [self._improved(self._suggested(tables, centre), tables) for centre in range(self.count)]
        lags = min(found, key=lambda lags: self._total(lags, tables))
        return np.asarray(lags - lags[0])

    def _table(self, costs: PairCosts) -> Floats:
        """Return the cost of each lag from -2 M to 2 M; those that cannot be compared count as the largest one."""
        mean = np.nan_to_num(costs.mean_px, nan=LARGEST_PX)
        return np.pad(mean, self.reach, constant_values=LARGEST_PX)

    def _suggested(self, tables: Mapping[tuple[int, int], Floats], centre: int) -> Integers:
        lags = np.zeros(self.count, np.int64)
        for (i, j), table in tables.items():
            lag = int(np.argmin(table)) - 2 * self.reach
            if i == centre:
                lags[j] = lag
            elif j == centre:
                lags[i] = -lag
        return lags

    def _improved(self, lags: Integers, tables: Mapping[tuple[int, int], Floats]) -> Integers:
        for _ in range(SWEEPS):
            before = lags.copy()
            for c in range(self.count):
                lags[c] += int(np.argmin(self._change_of(c, lags, tables))) - self.reach
            if np.array_equal(lags, before):
                break
        return lags

    def _change_of(self, camera: int, lags: Integers, tables: Mapping[tuple[int, int], Floats]) -> Floats:
        """Return the sum of the camera's costs for changes of its lag from -M to M."""
        total = np.zeros(2 * self.reach + 1)
        for (i, j), table in tables.items():
            if camera in (i, j):
                change = np.arange(-self.reach, self.reach + 1) * (1 if camera == j else -1)
                total += table[np.clip(lags[j] - lags[i] + change + 2 * self.reach, 0, len(table) - 1)]
        return total

    def _total(self, lags: Integers, tables: Mapping[tuple[int, int], Floats]) -> float:
        return sum(
            float(table[np.clip(lags[j] - lags[i] + 2 * self.reach, 0, len(table) - 1)])
            for (i, j), table in tables.items()
        )

    def rival(self, camera: int, lags: Integers, *, apart: int) -> int | None:
        """Return another lag at which a camera agrees with the others about as well, for example one step later.

        Args:
            camera: The camera.
            lags: (C,) the lags of all cameras.
            apart: Least difference from the camera's lag [steps].

        Returns:
            The lag that agrees best among those that are not clearly worse; None if there is none.
        """
        changes = [change for change in range(-self.reach, self.reach + 1) if abs(change) >= apart]
        losses = [(loss, change) for change in changes if (loss := self._loss(camera, lags, change)) is not None]
        near = [(loss.mean_px, change) for loss, change in losses if not loss.is_clear]
        return int(lags[camera]) + min(near)[1] if near else None

    def _loss(self, camera: int, lags: Integers, change: int) -> "_Loss | None":
        """Compare a changed lag of a camera with its present one; None if they have too few samples in common."""
        before: list[Floats] = []
        after: list[Floats] = []
        weights: list[Floats] = []
        for (i, j), costs in self.costs.items():
            now = lags[j] - lags[i] + self.reach
            new = now + (change if camera == j else -change)
            if camera in (i, j) and 0 <= now <= 2 * self.reach and 0 <= new <= 2 * self.reach:
                counts = costs.counts[[now, new]]
                usual, other = costs.sums_px[[now, new]] / np.maximum(counts, 1)
                before.append(usual)
                after.append(other)
                weights.append(counts.min(axis=0))
        weight, loss = np.array(weights), np.array(after) - np.array(before)
        total = float(weight.sum())
        if total < LEAST_COMMON_SAMPLES:
            return None
        mean = float(np.sum(weight * loss) / total)
        sums = np.sum(weight * (loss - mean), axis=0)
        groups = max(int(np.count_nonzero(weight.any(axis=0))), 2)
        sd = float(np.sqrt(groups / (groups - 1) * np.sum(sums**2)) / total)
        return _Loss(mean, sd, float(np.sum(weight * np.array(before)) / total))


@dataclass(frozen=True)
class _Loss:
    """By how much another lag agrees worse."""

    mean_px: float
    """Mean increase of the signals' differences [px]."""
    sd_px: float
    """Standard deviation of the mean over blocks of time [px]."""
    usual_px: float
    """Mean difference at the present lag [px]."""

    @property
    def is_clear(self) -> bool:
        """Whether the other lag is clearly worse."""
        by_size = self.mean_px > max(CLEAR_PX, CLEAR_SHARE * self.usual_px)
        return by_size or self.mean_px > CLEAR_SD * self.sd_px
