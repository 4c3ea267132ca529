"""The filter has the gain that its cut-off implies, no lag, and does not change gaps."""

import numpy as np
import pytest

from marey.errors import SettingProblem
from marey.motion.filters import low_pass


def test_the_gain_at_the_cutoff_is_one_over_the_root_of_two_and_there_is_no_lag():
    time = np.arange(2000) / 100
    for frequency in (0.5, 6.0, 30.0):
        wave = np.sin(2 * np.pi * frequency * time)
        smooth = low_pass(wave, rate=100, cutoff_hz=6.0)[500:1500]
        both = np.stack([wave, np.cos(2 * np.pi * frequency * time)], 1)[500:1500]
        in_phase, lagging = np.linalg.lstsq(both, smooth, rcond=None)[0]
        bent = np.tan(np.pi * frequency / 100) / np.tan(np.pi * 6 / 100)
        gain = 1 / (1 + (np.sqrt(2) - 1) * bent**4)
        assert in_phase == pytest.approx(gain, abs=1e-6)
        assert abs(lagging) < 1e-6
        if frequency == 6.0:
            assert in_phase == pytest.approx(1 / np.sqrt(2), abs=1e-6)


def test_a_straight_line_passes_unchanged():
    line = np.linspace(0, 5, 40)
    np.testing.assert_allclose(low_pass(line, rate=30, cutoff_hz=6), line, atol=1e-6)


def test_gaps_stay_and_what_lies_beyond_them_does_not_matter(rng):
    values = rng.normal(size=(60, 2, 3))
    values[20:25, 0] = np.nan
    smooth = low_pass(values, rate=30, cutoff_hz=5)
    np.testing.assert_array_equal(np.isnan(smooth), np.isnan(values))
    alone = low_pass(values[:20], rate=30, cutoff_hz=5)
    np.testing.assert_allclose(smooth[:20, 0], alone[:, 0])
    lonely = np.array([np.nan, 1.0, np.nan, 2.0, 3.0])
    assert low_pass(lonely, rate=30, cutoff_hz=5)[1] == 1.0


@pytest.mark.parametrize("cutoff", [0.0, 15.0, np.nan])
def test_a_cutoff_that_cannot_be_is_rejected_with_what_can(cutoff: float):
    with pytest.raises(SettingProblem, match=r"below 15 Hz"):
        low_pass(np.zeros(10), rate=30, cutoff_hz=cutoff)
