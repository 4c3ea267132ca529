"""Functions of a coordinate: values, slopes, what lies beyond the ends."""

import numpy as np
import pytest

from marey.body.articulation.coordinate_functions import (
    constant,
    linear,
    pack,
    piecewise_linear,
    polynomial,
    scaled,
    simm_spline,
)
from marey.body.articulation.jointed_kinematics import function_at
from marey.errors import MareyError


def kinds(rng):
    x, y = np.cumsum(rng.uniform(0.2, 1.0, 7)) - 2, rng.normal(size=7)
    return [
        constant(0.3),
        linear(-2.0, 0.5),
        polynomial(np.array([0.5, -1.0, 0.25, 2.0])),
        piecewise_linear(x, y),
        simm_spline(x, y),
        simm_spline(x[:3], y[:3]),
        scaled(simm_spline(x[:4], y[:4]), -1.5),
    ]


def test_every_slope_is_the_difference_of_values(rng):
    x = rng.uniform(-3, 4, 200)
    for function in kinds(rng):
        # Where a line breaks within the step the difference is that of neither side.
        x = x[np.abs(x[:, None] - function.starts).min(1) > 1e-4]
        difference = (function.at(x + 1e-6)[0] - function.at(x - 1e-6)[0]) / 2e-6
        assert np.allclose(function.at(x)[1], difference, atol=1e-7)


def test_the_kernel_gives_what_the_function_gives(rng):
    functions = kinds(rng)
    packed = pack(functions)
    for x in rng.uniform(-3, 4, 50):
        for which, function in enumerate(functions):
            assert np.allclose(function_at(packed, which, x), function.at(x), rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("lay", [piecewise_linear, simm_spline])
def test_the_curve_goes_through_its_points_and_on_straight(lay, rng):
    x, y = np.cumsum(rng.uniform(0.2, 1.0, 6)), rng.normal(size=6)
    function = lay(x, y)
    assert np.allclose(function.at(x)[0], y)
    for end, away in ((x[0], -2.0), (x[-1], 2.0)):
        value, slope = function.at(end + 0.1 * away)
        assert np.isclose(function.at(end + away)[0], value + 0.9 * away * slope)


def test_the_spline_is_a_cubic_where_its_points_lie_on_one(rng):
    cubic = polynomial(rng.normal(size=4))
    x = np.cumsum(rng.uniform(0.2, 1.0, 6))
    inside = np.linspace(x[0], x[-1], 50)
    assert np.allclose(simm_spline(x, cubic.at(x)[0]).at(inside), cubic.at(inside))


def test_two_points_give_a_line_and_three_a_parabola():
    assert simm_spline([0.0, 2.0], [1.0, 5.0]).at(1.0) == (3.0, 2.0)
    assert np.isclose(simm_spline([0.0, 1.0, 3.0], [0.0, 1.0, 9.0]).at(2.0)[0], 4.0)


def test_points_that_do_not_ascend_are_rejected():
    with pytest.raises(MareyError, match="ascending"):
        simm_spline([0.0, 0.0, 1.0], [1.0, 2.0, 3.0])
    with pytest.raises(MareyError, match="ascending"):
        piecewise_linear([0.0], [1.0])
