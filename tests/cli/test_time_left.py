"""The estimate of the time left, on stages whose steps take simulated times."""

import itertools

import numpy as np
import pytest

from marey.cli.time_left import LEAST_REMAINING, LEAST_SHARE, TimeLeft

COUNT = 120


def steady() -> np.ndarray:
    return np.full(COUNT, 0.8)


def slow_first_step() -> np.ndarray:
    return np.concatenate([[16.0], np.full(COUNT - 1, 0.1)])


def irregular() -> np.ndarray:
    return np.random.default_rng(5).gamma(2.0, 0.4, COUNT)


def in_batches(size: int) -> np.ndarray:
    """Steps that threads finish together, up to a millisecond."""
    return np.tile(np.concatenate([[0.4 * size], np.full(size - 1, 1e-3)]), COUNT // size)


def ever_slower() -> np.ndarray:
    return np.geomspace(0.4, 1.2, COUNT)


def ever_faster() -> np.ndarray:
    return np.geomspace(1.2, 0.4, COUNT)


def empty_frames_first() -> np.ndarray:
    """As in a take whose first frames show no person."""
    return np.concatenate([np.full(12, 0.02), np.full(COUNT - 12, 0.4)])


def slow_first_batch() -> np.ndarray:
    steps = in_batches(4)
    steps[0] += 10.0
    return steps


STAGES = {
    "steady": steady(), "slow first step": slow_first_step(), "irregular": irregular(), "in twos": in_batches(2),
    "in eights": in_batches(8), "ever slower": ever_slower(), "ever faster": ever_faster(),
    "empty frames first": empty_frames_first(),
    "slow first batch": slow_first_batch(), "three steps": np.array([25.0, 3.0, 4.0]), "few steps": np.full(8, 2.0),
}  # fmt: skip


@pytest.mark.parametrize("steps", STAGES.values(), ids=STAGES)
def test_the_estimate_is_never_off_by_more_than_a_factor_of_three(steps):
    left = TimeLeft(len(steps), started=50.0)
    ends = 50.0 + np.cumsum(steps)
    shown = 0
    for number, end in enumerate(ends[:-1], start=1):
        left.add(1, end)
        estimate = left.estimate(end)
        if estimate is None:
            continue
        shown += 1
        assert number >= LEAST_SHARE * len(steps)
        # Within the time of a step (or of a batch of steps) a factor means nothing.
        slack = np.sort(steps)[-2]
        assert (ends[-1] - end) / 3 - slack <= estimate <= 3 * (ends[-1] - end) + slack, number
    # Without the first seconds and the last ones, where there is no estimate.
    assert shown >= (0.45 * len(steps) if len(steps) > 10 else 1)


def test_the_last_seconds_have_no_estimate():
    left = TimeLeft(100)
    for number in range(1, 100):
        left.add(1, 0.1 * number)
        if number > 40:
            remaining = 0.1 * (100 - number)
            assert (left.estimate(0.1 * number) is None) == (remaining < LEAST_REMAINING - 1e-6), number


def test_steps_of_an_earlier_run_do_not_count():
    left = TimeLeft(100, done=60)
    for second in itertools.islice(itertools.count(1.0), 10):
        left.add(1, second)
    assert left.estimate(10.0) == pytest.approx(30.0)


def test_between_two_steps_the_estimate_falls_by_at_most_one_step():
    left = TimeLeft(100)
    for second in (1.0, 2.0, 3.0, 4.0, 5.0, 6.0):
        left.add(1, second)
    assert left.estimate(6.5) == pytest.approx(93.5)
    assert left.estimate(60.0) == pytest.approx(93.0)
