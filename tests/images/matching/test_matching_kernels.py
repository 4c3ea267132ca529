import numpy as np
import pytest
from tests.reference_matching import noise_shares

from marey.images.matching.matching_kernels import kept_in_both, kept_in_slopes, kept_in_values


@pytest.mark.parametrize("kernel", [kept_in_values, kept_in_slopes, kept_in_both])
def test_noise_between_pixels_is_that_of_the_sum_over_all_pixels(kernel):
    number = [kept_in_values, kept_in_slopes, kept_in_both].index(kernel)
    places, stated = np.linspace(0, 1, 33), noise_shares(33)[number]
    # A constant of the values has single precision.
    np.testing.assert_allclose([kernel(place) for place in places], stated, atol=1e-7)
