import numpy as np
import pytest

from marey.cameras.shutter import RollingShutter, row_shares

CORNERS = np.array([[0.0, 0.0], [99.0, 0.0], [0.0, 49.0], [99.0, 49.0]])
"""The centres of the outermost pixels of a picture of 100 x 50 px."""


@pytest.mark.parametrize(
    ("side", "first"), [("top", [0, 1]), ("bottom", [2, 3]), ("left", [0, 2]), ("right", [1, 3])]
)
def test_the_named_side_is_exposed_half_a_readout_before_the_middle(side, first):
    expected = np.full(4, 0.5)
    expected[first] = -0.5
    np.testing.assert_allclose(row_shares(side, CORNERS, (100, 50)), expected)
    np.testing.assert_allclose(row_shares(side, np.array([49.5, 24.5]), (100, 50)), 0, atol=1e-15)


def test_delays_are_those_of_the_camera():
    shutter = RollingShutter(readout_s=np.array([0.0, 0.02]), sides=("top", "bottom"))
    np.testing.assert_array_equal(shutter.delays(0, CORNERS, (100, 50)), 0)
    np.testing.assert_allclose(shutter.delays(1, CORNERS, (100, 50)), [0.01, 0.01, -0.01, -0.01])
