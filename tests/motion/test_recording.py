"""Values between the frames of a recording: each column between its own gaps."""

import numpy as np
from scipy.interpolate import CubicSpline

from marey.motion.recording import interpolated


def test_columns_are_interpolated_between_their_own_gaps(rng):
    time, at = np.arange(20) / 10, np.linspace(-0.1, 2.0, 85)
    values = rng.normal(size=(20, 2, 3))
    values[7:9, 0] = np.nan
    values[12, 1, 2] = np.nan
    found = interpolated(time, values, at)
    assert found.shape == (85, 2, 3)
    for row in range(2):
        for column in range(3):
            gap = {0: range(7, 9), 1: range(12, 13) if column == 2 else range(0)}[row]
            expected = np.full(len(at), np.nan)
            runs = [(0, 20)] if len(gap) == 0 else [(0, gap.start), (gap.stop, 20)]
            for start, end in runs:
                inside = (at > time[start] - 1e-9) & (at < time[end - 1] + 1e-9)
                expected[inside] = CubicSpline(time[start:end], values[start:end, row, column])(at[inside])
            np.testing.assert_allclose(found[:, row, column], expected, atol=1e-9)


def test_slopes_are_those_of_the_splines_and_short_runs_are_straight(rng):
    time, values = np.arange(9.0), rng.normal(size=9)
    values[3] = np.nan
    at = np.array([0.5, 1.5, 3.0, 5.25])
    slopes = interpolated(time, values[:, None], at, derivative=1)[:, 0]
    np.testing.assert_allclose(slopes[:2], np.diff(values[:3]))
    assert np.isnan(slopes[2])
    np.testing.assert_allclose(slopes[3], CubicSpline(time[4:], values[4:])(5.25, 1))
