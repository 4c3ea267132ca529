"""Assignment of contour pixels where two limbs are equally near."""

import numpy as np
import pytest

from marey.images.silhouettes.nearest import nearest_other, nearest_within, sort_into_cells
from marey.observations.correspondence import pair_both_ways
from marey.observations.votes import SLACK, SPLIT, WINDOW, elect_limbs

ROWS = np.arange(60.0)
LEFT, RIGHT = 1, 2


def line(x, rows=ROWS):
    return np.stack([np.broadcast_to(x, rows.shape), rows], 1).astype(float)


def facing(count, x=1.0):
    return np.tile([x, 0.0], (count, 1))


def two_parallel_limbs(contour_x):
    """The near borders of two parallel limbs, 8 pixels apart and alike in direction, and an outline between them."""
    rim = np.concatenate([line(10.0), line(18.0)])
    limb = np.repeat([LEFT, RIGHT], 60)
    contour = line(contour_x)
    counts, cells = (np.ones(120, bool), np.ones(60, bool)), sort_into_cells(contour)
    return limb, pair_both_ways(rim, facing(120), limb, counts[0], cells, facing(60), counts[1], 25.0, 0.3, True)


def test_the_neighbours_decide_between_two_parallel_limbs():
    # The outline follows the left limb but for some pixels in the middle, which lie a little nearer to the right one.
    x = np.full(60, 12.0)
    x[28:33] = 14.4
    limb, (i, j) = two_parallel_limbs(x)
    own = i[-60:]
    np.testing.assert_array_equal(j[-60:], np.arange(60))
    assert (limb[own] == LEFT).all()
    # From the rim, too: no pixel of the right limb takes one of those.
    assert not np.isin(j[limb[i] == RIGHT], np.arange(28, 33)).any()


def test_without_a_majority_a_pixel_is_not_matched():
    # The whole outline is midway between the limbs: no pixel is unambiguous, and none can vote.
    _, (i, j) = two_parallel_limbs(np.full(60, 14.0))
    assert len(i) == len(j) == 0
    # Above the middle it follows the left limb, below the right one: as many vote for either.
    x = np.where(ROWS < 30, 11.0, 17.0)
    x[30] = 14.0
    _, (_, j) = two_parallel_limbs(x)
    np.testing.assert_array_equal(np.unique(j), np.delete(np.arange(60), 30))


def pair_of(cells, label, x, y, reach, slack):
    first = nearest_within(cells, x, y, reach)
    return first, nearest_other(cells, label, first, x, y, reach, slack) if first >= 0 else -1


def scattered(rng):
    rim, contour = rng.uniform(0, 60, (90, 2)), rng.uniform(0, 60, (80, 2))
    inward = rng.normal(size=(2, 90, 2))
    rim_in, contour_in = inward / np.linalg.norm(inward, axis=2, keepdims=True)
    return rim, rim_in, rng.integers(0, 3, 90), contour, contour_in[:80]


def test_votes_never_change_unambiguous_pixels(rng):
    for _ in range(5):
        rim, rim_in, limb, contour, contour_in = scattered(rng)
        cells, rim_cells = sort_into_cells(contour), sort_into_cells(rim)
        all_rim, all_contour = np.ones(90, bool), np.ones(80, bool)
        voted = pair_both_ways(rim, rim_in, limb, all_rim, cells, contour_in, all_contour, 9.0, -0.8, True)
        one = pair_both_ways(rim, rim_in, limb, all_rim, cells, contour_in, all_contour, 9.0, -0.8, False)
        near = np.array([pair_of(rim_cells, limb, x, y, 9.0, SLACK) for x, y in contour])
        apart = np.linalg.norm(rim[near[:, 0]] - rim[near[:, 1]], axis=1) > SPLIT
        alike = ((rim_in[near] * contour_in[:, None]).sum(2) >= -0.8).all(1)
        ambiguous = (near[:, 1] >= 0) & apart & alike
        assert 5 < ambiguous.sum() < 70
        before = [pair for pair in zip(*one, strict=True) if not ambiguous[pair[1]]]
        after = [pair for pair in zip(*voted, strict=True) if not ambiguous[pair[1]]]
        assert before == after


def test_the_vote_agrees_with_plain_counting(rng):
    rim, contour = rng.uniform(0, 50, (60, 2)), rng.uniform(0, 50, (70, 2))
    inward = rng.normal(size=(70, 2))
    inward /= np.linalg.norm(inward, axis=1, keepdims=True)
    limb = rng.integers(0, 3, 60)
    nearest, second = rng.integers(-1, 60, (2, 70))
    second[rng.random(70) > 0.4] = -1
    second[nearest < 0] = -1
    taken, ambiguous = elect_limbs(nearest, second, rim, limb, sort_into_cells(contour), inward)
    apart = np.linalg.norm(rim[nearest] - rim[second], axis=1) > SPLIT
    np.testing.assert_array_equal(ambiguous, (second >= 0) & apart)
    for j in range(70):
        near = np.linalg.norm(contour - contour[j], axis=1) <= WINDOW
        voters = near & (inward @ inward[j] >= 0.7) & ~ambiguous & (nearest >= 0)
        share = [np.mean(limb[nearest[voters]] == limb[k]) if voters.any() else 0.0 for k in (nearest[j], second[j])]
        wanted = nearest[j]
        if ambiguous[j]:
            wanted = second[j] if share[1] > 0.5 else nearest[j] if share[0] > 0.5 else -1
        assert taken[j] == wanted


@pytest.mark.parametrize("slack", [0.0, 2.0, 30.0])
def test_the_second_nearest_is_that_of_another_label(rng, slack):
    pixels, label = rng.uniform(0, 40, (50, 2)), rng.integers(0, 3, 50)
    cells = sort_into_cells(pixels)
    for x, y in rng.uniform(-10, 50, (200, 2)):
        distance = np.linalg.norm(pixels - (x, y), axis=1)
        first, second = pair_of(cells, label, x, y, 12.0, slack)
        if distance.min() > 12.0:
            assert (first, second) == (-1, -1)
            continue
        assert first == distance.argmin()
        others = np.where(label != label[first], distance, np.inf)
        good = others.min() <= min(distance.min() + slack, 12.0)
        assert second == (others.argmin() if good else -1)
