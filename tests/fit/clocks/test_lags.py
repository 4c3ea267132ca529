"""Costs of lags, compared with the plain formula."""

import numpy as np
from tests import made_walk

from marey.fit.clocks.comparison import SampledSignal
from marey.fit.clocks.lags import LARGEST_PX, MOST_BLOCKS, add_costs, pair_costs
from marey.fit.clocks.signals import tangent_signals


def test_costs_are_bounded_sums_of_differences_in_blocks(rng: np.random.Generator):
    first = np.stack([rng.uniform(-np.pi, np.pi, 40), rng.uniform(0.01, 0.3, 40)], axis=1)
    second = np.stack([rng.uniform(-np.pi, np.pi, 33), rng.uniform(0.01, 0.3, 33)], axis=1)
    first[3:6, 0] = second[10, 0] = np.nan
    block, reach = np.arange(40) // 8, 12
    sums, counts = np.zeros((2, 2 * reach + 1, 5))
    add_costs(first, second, block, reach, sums, counts)
    expected, number = np.zeros_like(sums), np.zeros_like(counts)
    for row, lag in enumerate(range(-reach, reach + 1)):
        for i in range(40):
            if 0 <= i - lag < 33 and np.isfinite(first[i, 0] - second[i - lag, 0]):
                turn = abs(np.angle(np.exp(1j * (first[i, 0] - second[i - lag, 0]))))
                expected[row, block[i]] += min(turn / np.hypot(first[i, 1], second[i - lag, 1]), LARGEST_PX)
                number[row, block[i]] += 1
    assert (expected[number > 0] < LARGEST_PX * number[number > 0]).any()
    np.testing.assert_allclose(sums, expected, atol=1e-12)
    np.testing.assert_array_equal(counts, number)


def test_costs_of_a_long_video_need_no_more_memory_than_those_of_a_shorter_one():
    cameras, clocks = made_walk.cameras(2), made_walk.clocks([0, 0])
    signals = tangent_signals(cameras, made_walk.silhouettes(cameras, clocks, frames=[40, 40]))
    for seconds in (100.0, 1000.0):
        times = np.linspace(0.0, seconds, 40)
        costs = pair_costs([SampledSignal.of(signal, [times, times]) for signal in signals], seconds / 80, 5)[0, 1]
        assert costs.counts.shape == (11, 1 + min(2 * seconds, MOST_BLOCKS))
        assert costs.counts.sum() > 0
