"""Autoregressive processes: gradient of the cost, and estimation from a synthetic path."""

import numpy as np

from marey.nonrigid.core.weight_processes import estimated_processes, initial_processes


def test_the_right_side_is_minus_the_gradient_of_the_cost(rng):
    weights = rng.normal(size=(8, 2))
    processes = initial_processes(weights, 1e-6)
    diagonal, first, second = (np.zeros((8, 3, 3)) for _ in range(3))
    right = np.zeros((8, 3))
    processes.add(diagonal, first, second, right, weights, 1)
    step = 1e-6 * rng.normal(size=weights.shape)
    change = processes.cost(weights + step) - processes.cost(weights - step)
    np.testing.assert_allclose(change, -2 * (right[:, 1:] * step).sum(), rtol=1e-5)
    assert (right[:, 0] == 0).all()


def test_autoregression_and_innovation_are_estimated(rng):
    weights = np.zeros((4000, 1))
    for f in range(2, 4000):
        weights[f] = 1.5 * weights[f - 1] - 0.7 * weights[f - 2] + 0.1 * rng.normal()
    processes = initial_processes(weights, 1e-6)
    processes = estimated_processes(weights, (np.zeros((4000, 1, 1)),) * 3)
    np.testing.assert_allclose(processes.autoregression[0], [1.5, -0.7], atol=0.05)
    np.testing.assert_allclose(processes.innovation_variance, 0.01, rtol=0.1)
