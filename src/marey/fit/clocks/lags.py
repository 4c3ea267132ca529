"""Search for the offsets of all cameras to about a frame: the lags at which their epipolar signals agree best."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Integers
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
    """How well the signals of two cameras agree at each lag of the second behind the first."""

    difference_px: Floats
    """(L, n) absolute differences of the signals at the samples of one camera, at most `LARGEST_PX` [px]; NaN where one
    of them has no sample."""
    block: Integers
    """(n,) number of the block of time of each sample."""

    @property
    def mean_px(self) -> Floats:
        """(L,) mean difference [px]; NaN for lags with too few samples."""
        counts = np.count_nonzero(np.isfinite(self.difference_px), axis=1)
        enough = counts >= max(LEAST_COMMON_SAMPLES, LEAST_COMMON * counts.max(initial=0))
        mean = np.nansum(self.difference_px, axis=1) / np.maximum(counts, 1)
        return np.where(enough, mean, np.nan)


def pair_costs(signals: Sequence[SampledSignal], lags: Floats, count: int) -> dict[tuple[int, int], PairCosts]:
    """Compare the signals of each pair of cameras at each lag.

    Args:
        signals: Signals of all pairs.
        lags: (L,) offsets of the second camera of a pair, less the first's [s].
        count: Number of cameras C.

    Returns:
        The costs by pair of cameras, the smaller number first.
    """
    found: dict[tuple[int, int], list[tuple[Floats, Integers]]] = defaultdict(list)
    still = np.zeros(count)
    for signal in signals:
        i, j = sorted(signal.cameras)
        rows = []
        for lag in lags:
            offsets = still.copy()
            offsets[j] = lag
            rows.append(np.minimum(np.abs(signal.compared(offsets, still).residual_px), LARGEST_PX))
        found[i, j].append((np.array(rows), (signal.times[0] / BLOCK_S).astype(np.int64)))
    return {
        pair: PairCosts(np.concatenate([row for row, _ in parts], axis=1), np.concatenate([b for _, b in parts]))
        for pair, parts in found.items()
    }


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
        before, after, blocks = [], [], []
        for (i, j), costs in self.costs.items():
            now = lags[j] - lags[i] + self.reach
            new = now + (change if camera == j else -change)
            if camera in (i, j) and 0 <= now <= 2 * self.reach and 0 <= new <= 2 * self.reach:
                before.append(costs.difference_px[now])
                after.append(costs.difference_px[new])
                blocks.append(costs.block)
        if not blocks:
            return None
        loss, block = np.concatenate(after) - np.concatenate(before), np.concatenate(blocks)
        known = np.isfinite(loss)
        if np.count_nonzero(known) < LEAST_COMMON_SAMPLES:
            return None
        usual = float(np.concatenate(before)[known].mean())
        sums = np.bincount(block[known], weights=loss[known] - loss[known].mean())
        groups = max(len(np.unique(block[known])), 2)
        sd = float(np.sqrt(groups / (groups - 1) * np.sum(sums**2)) / np.count_nonzero(known))
        return _Loss(float(loss[known].mean()), sd, usual)


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
