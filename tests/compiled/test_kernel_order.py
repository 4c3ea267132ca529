import numpy as np
import pytest

from marey.compiled.kernel_order import insert, middle


@pytest.mark.parametrize("count", [1, 2, 7, 12])
def test_inserted_values_are_in_order_and_have_their_median(rng, count):
    values, ascending = np.round(rng.normal(size=count), 1), np.empty(count)
    for k, value in enumerate(values):
        insert(ascending, k, value)
    np.testing.assert_array_equal(ascending, np.sort(values))
    assert middle(ascending, count) == pytest.approx(np.median(values), rel=1e-15)
