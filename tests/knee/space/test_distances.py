import numpy as np
import pytest
from scipy import ndimage

from marey.knee.space.distances import distance_within


@pytest.mark.parametrize(
    ("shape", "spacing"), [((14, 17, 19), (1.0, 1.0, 1.0)), ((9, 21, 16), (1.4, 0.37, 0.5)), ((23, 31), (0.5, 0.31))]
)
def test_distances_are_those_of_scipy(shape, spacing, rng):
    for level in (-0.05, 0.0, 0.1):
        mask = ndimage.gaussian_filter(rng.normal(size=shape), 2) > level
        wanted = ndimage.distance_transform_edt(mask, sampling=spacing)
        np.testing.assert_allclose(distance_within(mask, spacing), wanted, rtol=1e-12)


def test_a_single_place_outside_is_the_end_of_all_distances():
    mask = np.ones((4, 5, 6), bool)
    mask[1, 2, 3] = False
    k, j, i = np.indices(mask.shape)
    wanted = np.sqrt((3 * (k - 1)) ** 2 + (2.0 * (j - 2)) ** 2 + (i - 3) ** 2)
    np.testing.assert_allclose(distance_within(mask, (3, 2, 1)), wanted)


def test_where_nothing_is_outside_the_edge_is_infinitely_far():
    assert np.isinf(distance_within(np.ones((3, 4, 5), bool))).all()
    assert (distance_within(np.zeros((3, 4), bool)) == 0).all()
