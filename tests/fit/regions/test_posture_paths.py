"""Paths through several postures per frame, against the list of all paths."""

from itertools import pairwise, product

import numpy as np
import pytest

from marey.fit.regions.posture_paths import PosturePaths

COUNTS = (3, 1, 4, 2)
"""Number of postures in each frame."""


@pytest.fixture
def paths(rng) -> PosturePaths:
    support = [rng.normal(0, 2, count) for count in COUNTS]
    changes = [rng.normal(0, 2, pair) for pair in pairwise(COUNTS)]
    return PosturePaths(support, changes)


def logarithms(paths: PosturePaths) -> dict[tuple[int, ...], float]:
    """Return the logarithm of the weight of each path."""
    return {
        path: sum(own[i] for own, i in zip(paths.support, path, strict=True))
        + sum(change[i, j] for change, (i, j) in zip(paths.changes, pairwise(path), strict=True))
        for path in product(*map(range, COUNTS))
    }


def test_the_best_path_is_the_best_of_all(paths):
    every = logarithms(paths)
    assert tuple(paths.best()) == max(every, key=lambda path: every[path])


def test_probabilities_are_the_shares_of_all_paths(paths):
    weights = {path: np.exp(value) for path, value in logarithms(paths).items()}
    total = sum(weights.values())
    for frame, (count, found) in enumerate(zip(COUNTS, paths.probabilities(), strict=True)):
        shares = [sum(w for path, w in weights.items() if path[frame] == i) / total for i in range(count)]
        np.testing.assert_allclose(found, shares, rtol=1e-10)


def test_large_differences_do_not_overflow(paths):
    steep = PosturePaths([1e4 * own for own in paths.support], [1e4 * change for change in paths.changes])
    best = steep.best()
    for i, found in zip(best, steep.probabilities(), strict=True):
        assert found[i] == pytest.approx(1.0)
        assert np.isfinite(found).all()


def test_a_single_frame_needs_no_changes():
    alone = PosturePaths([np.log([0.2, 0.8])], [])
    assert alone.best() == [1]
    np.testing.assert_allclose(alone.probabilities()[0], [0.2, 0.8])
