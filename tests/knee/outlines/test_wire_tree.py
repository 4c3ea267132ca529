import numpy as np
import pytest
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from marey.knee.outlines.wire_tree import MOST_COST, WireTree, reversed_costs

OFFSETS = ((0, 1), (1, 0), (0, -1), (-1, 0))


def made_costs(rng: np.random.Generator, rows: int = 23, columns: int = 31) -> np.ndarray:
    costs = rng.integers(1, MOST_COST + 1, (rows, columns, 4)).astype(np.int32)
    costs[rng.random(costs.shape) < 0.1] = 0
    costs[:, -1, 0], costs[-1, :, 1], costs[:, 0, 2], costs[0, :, 3] = 0, 0, 0, 0
    return costs


def by_scipy(costs: np.ndarray, root: tuple[int, int]) -> np.ndarray:
    rows, columns, _ = costs.shape
    row, column, step = np.nonzero(costs)
    offset = np.array(OFFSETS)[step]
    start, end = row * columns + column, (row + offset[:, 0]) * columns + column + offset[:, 1]
    graph = csr_matrix((costs[row, column, step], (start, end)), shape=(rows * columns, rows * columns))
    return dijkstra(graph, indices=root[0] * columns + root[1]).reshape(rows, columns)


def cost_along(costs: np.ndarray, path: np.ndarray) -> int:
    steps = [OFFSETS.index((int(r), int(c))) for r, c in np.diff(path, axis=0)]
    taken = costs[path[:-1, 0], path[:-1, 1], steps]
    assert (taken > 0).all()
    return int(taken.sum())


def test_costs_are_those_of_dijkstras_algorithm_in_any_order_of_asking(rng: np.random.Generator):
    costs, root = made_costs(rng), (4, 9)
    true, tree = by_scipy(costs, root), WireTree(costs, root)
    for number in rng.permutation(true.size)[:200]:
        corner = (int(number) // true.shape[1], int(number) % true.shape[1])
        if np.isfinite(true[corner]):
            assert tree.cost(corner) == true[corner]


def test_a_path_leads_from_root_to_corner_and_has_the_stated_cost(rng: np.random.Generator):
    costs = made_costs(rng)
    tree = WireTree(costs, (20, 2))
    for corner in ((0, 0), (3, 28), (20, 2)):
        path = tree.path(corner)
        assert path[0].tolist() == [20, 2]
        assert tuple(path[-1].tolist()) == corner
        assert cost_along(costs, path) == tree.cost(corner)


def test_a_tree_on_reversed_costs_contains_the_paths_that_end_at_its_root(rng: np.random.Generator):
    costs = made_costs(rng)
    turned = reversed_costs(costs)
    assert np.array_equal(reversed_costs(turned), costs)
    path = WireTree(turned, (5, 5)).path((18, 25))[::-1]
    assert WireTree(costs, (18, 25)).cost((5, 5)) == cost_along(costs, path)


def test_the_tree_grows_only_as_far_as_it_must():
    costs = np.full((200, 200, 4), 10, np.int32)
    costs[:, -1, 0], costs[-1, :, 1], costs[:, 0, 2], costs[0, :, 3] = 0, 0, 0, 0
    tree = WireTree(costs, (100, 100))
    tree.cost((100, 110))
    assert tree._settled.sum() < 2 * 11**2 + 50


def test_a_corner_that_no_path_leads_to_is_an_error(rng: np.random.Generator):
    costs = made_costs(rng)
    costs[:, 14:16] = 0
    with pytest.raises(ValueError, match="no path"):
        WireTree(costs, (4, 2)).path((4, 25))
