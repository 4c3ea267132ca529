import numpy as np
import pytest

from marey.fit.clocks.smoothing import smoothed

TIMES = np.arange(40) / 30


def test_a_parabola_is_returned_with_its_slope():
    values = 2 - 3 * TIMES + 5 * TIMES**2
    at = np.linspace(0, TIMES[-1] - 1e-9, 57)
    found, slope = smoothed(TIMES, values, at, 1 / 30)
    np.testing.assert_allclose(found, 2 - 3 * at + 5 * at**2, atol=1e-9)
    np.testing.assert_allclose(slope, -3 + 10 * at, atol=1e-7)


def test_a_time_beside_a_missing_sample_has_no_value():
    values = np.ones(40)
    values[10] = np.nan
    found, _ = smoothed(TIMES, values, np.array([9.0, 9.5, 10.0, 10.5, 11.0, 12.4]) / 30, 1 / 30)
    np.testing.assert_array_equal(np.isnan(found), [False, True, True, True, False, False])


def test_times_outside_and_too_few_samples_have_no_value():
    found, slope = smoothed(TIMES, np.ones(40), np.array([-0.01, 2.0]), 1 / 30)
    assert np.isnan(found).all()
    assert np.isnan(slope).all()
    assert np.isnan(smoothed(TIMES[:3], np.ones(3), TIMES[:1], 1 / 30)[0]).all()


def test_the_noise_between_two_samples_is_about_that_at_a_sample(rng):
    noise = rng.normal(size=(300, 40))
    middle = TIMES[15:25]
    at, between = (
        np.std([smoothed(TIMES, row, where, 1 / 30)[0] for row in noise]) for where in (middle, middle + 0.5 / 30)
    )
    # Linear interpolation would reduce it by 1 - sqrt(1/2) = 29 %. The standard error of the ratio is about 2 %.
    assert between == pytest.approx(at, rel=0.1)
