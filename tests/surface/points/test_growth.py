import numpy as np
import pytest
from tests.surface.points.test_checks import GRID, neighbours

from marey.surface.points.growth import beside_front


def beside_by_formula(front, waiting, sd, region):
    """Nodes beside a front and their most precise neighbours, of all at once."""
    beside = neighbours(GRID)
    nodes = np.unique(beside[front])
    nodes = nodes[(nodes >= 0) & waiting[nodes]]
    certain = np.append(sd, np.inf)[beside[nodes]]
    if region is not None:
        certain = np.where(region[beside[nodes]] == region[nodes][:, None], certain, np.inf)
    best = certain.argmin(axis=1)
    usable = np.isfinite(certain.min(axis=1))
    return nodes[usable], beside[nodes, best][usable]


@pytest.mark.parametrize("divided", [False, True])
def test_nodes_beside_a_front_start_from_their_most_precise_neighbours(rng, divided):
    matched = rng.random(len(GRID)) < 0.3
    sd = np.where(matched, rng.uniform(0.01, 0.1, len(GRID)), np.inf)
    front = np.flatnonzero(matched & (rng.random(len(GRID)) < 0.5))
    waiting = ~matched & (rng.random(len(GRID)) < 0.8)
    region = rng.integers(0, 3, len(GRID)) if divided else None
    before = waiting.copy()
    found = beside_front(front, waiting, sd, region, GRID)
    expected = beside_by_formula(front, waiting, sd, region)
    assert 100 < len(expected[0]) < waiting.sum()
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(waiting, before)


def test_nothing_lies_beside_an_empty_front():
    nothing = np.zeros(0, np.int64)
    nodes, _ = beside_front(nothing, np.ones(len(GRID), bool), np.full(len(GRID), 0.1), None, GRID)
    assert not len(nodes)
