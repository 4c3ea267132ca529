import numpy as np
from scipy import ndimage

from marey.knee.outlines.boundary_elements import FEATURES, boundary_elements, learned_costs, step_costs
from marey.knee.outlines.wire_tree import MOST_COST

SPACING = (0.5, 0.8)
RIGHT, DOWN, LEFT, UP = range(4)


def test_features_are_those_of_a_plane_whatever_the_spacing():
    row, column = np.mgrid[:30, :40]
    image = 7.0 * row * SPACING[0] - 4.0 * column * SPACING[1]
    features = boundary_elements(image, SPACING).features[10, 10]
    across = features[:, FEATURES.index("across")]
    # The inside is to the left: it lies above a step to the right, and on the right of the image of a step down.
    np.testing.assert_allclose(across, [7, 4, -7, -4], rtol=1e-4)
    np.testing.assert_allclose(features[:, FEATURES.index("magnitude")], np.hypot(7, 4), rtol=1e-4)
    rise = features[:, FEATURES.index("outside")] - features[:, FEATURES.index("inside")]
    assert (np.sign(rise) == np.sign(across)).all()


def test_inside_and_outside_are_read_in_the_pixels_on_the_left_and_right_hand():
    image = np.zeros((20, 20))
    image[:10] = 100.0
    found = boundary_elements(image, (1.0, 1.0)).features
    features = found[10, 10]
    smooth = ndimage.gaussian_filter(image, 0.6, mode="nearest")
    np.testing.assert_allclose(features[RIGHT, :2], [smooth[9, 0], smooth[10, 0]], rtol=1e-3)
    np.testing.assert_allclose(features[LEFT, :2], features[RIGHT, 1::-1])
    assert features[DOWN, 0] == found[11, 10, UP, 1]


def test_there_is_no_step_out_of_the_slice_and_along_its_border_only_one_way():
    costs = step_costs(boundary_elements(np.random.default_rng(1).normal(size=(12, 15)), (1.0, 1.0)))
    assert costs.shape == (13, 16, 4)
    assert not costs[:, -1, RIGHT].any()
    assert not costs[-1, :, DOWN].any()
    assert not costs[0, :, RIGHT].any()
    assert costs[0, 1:, LEFT].all()
    assert costs[-1, :-1, RIGHT].all()
    assert not costs[:, 0, UP].any()
    inner = costs[1:-1, 1:-1]
    assert inner.min() >= 1
    assert inner.max() <= MOST_COST


def test_a_step_costs_in_proportion_to_its_length():
    costs = step_costs(boundary_elements(np.zeros((12, 12)), (0.5, 1.0)))
    np.testing.assert_allclose(costs[5, 5, DOWN] / costs[5, 5, RIGHT], 0.5, atol=0.002)


def test_learned_costs_distinguish_an_outline_from_the_reversed_edge(rng: np.random.Generator):
    image = np.where(np.arange(60)[:, None] < 30, 20.0, 80.0) + rng.normal(0, 5, (60, 60))
    elements = boundary_elements(image, (1.0, 1.0))
    learned = learned_costs([(elements, np.arange(60)[:, None] + np.zeros(60) < 30)])
    costs = step_costs(elements, learned)
    assert np.median(costs[30, 5:-5, RIGHT]) < 0.2 * MOST_COST
    assert np.median(costs[30, 5:-5, LEFT]) > 0.8 * MOST_COST
    assert np.median(costs[10, 5:-5, RIGHT]) > 0.8 * MOST_COST


def test_costs_are_the_odds_of_all_features_taken_together(rng: np.random.Generator):
    elements = boundary_elements(rng.normal(size=(30, 30)), (1.0, 1.0))
    learned = learned_costs([(elements, np.arange(30)[:, None] - 0.5 * np.arange(30) < 12)])
    assert learned is not None
    features = elements.features[7, 9, RIGHT].astype(float)
    places = [np.clip(np.searchsorted(learned.ends[i], features[i], side="right") - 1, 0, 40) for i in range(4)]
    odds = sum(learned.log_odds[i, places[i]] for i in range(4)) - 4.0
    expected = np.rint((0.05 + 0.95 / (1 + np.exp(odds))) * MOST_COST)
    assert abs(step_costs(elements, learned)[7, 9, RIGHT] - expected) <= 1


def test_nothing_is_learned_from_a_short_example(rng: np.random.Generator):
    elements = boundary_elements(rng.normal(size=(30, 30)), (1.0, 1.0))
    mask = np.zeros((30, 30), bool)
    mask[5:10, 5:10] = True
    assert learned_costs([(elements, mask)]) is None


def test_the_steps_round_a_mask_have_it_to_their_left():
    row, column = np.mgrid[:20, :20]
    mask = np.hypot(row - 9, column - 11) < 5
    around = boundary_elements(np.where(mask, 10.0, 50.0), (1.0, 1.0)).around(mask)
    rows, columns = np.abs(np.diff(mask.astype(int), axis=0)).sum(), np.abs(np.diff(mask.astype(int), axis=1)).sum()
    assert len(around) == rows + columns
    assert (around[:, FEATURES.index("across")] > 0).all()
    assert (around[:, FEATURES.index("inside")] < around[:, FEATURES.index("outside")]).all()


def test_where_a_mask_meets_the_border_there_is_no_step():
    elements = boundary_elements(np.zeros((20, 20)), (1.0, 1.0))
    assert len(elements.around(np.ones((20, 20), bool))) == 0
