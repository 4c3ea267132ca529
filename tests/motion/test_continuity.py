import numpy as np

from marey.motion.continuity import continuous_degrees


def test_jumps_by_whole_turns_are_removed_also_over_gaps():
    true = np.stack([np.linspace(150, 260, 50), np.linspace(-30, 30, 50)], 1)
    wrapped = (true + 180) % 360 - 180
    wrapped[20:30, 0] = np.nan
    found = continuous_degrees(wrapped)
    expected = true - [[360.0, 0.0]] if np.median(true[:, 0]) > 180 else true
    expected[20:30, 0] = np.nan
    np.testing.assert_allclose(found, expected, atol=1e-9)
    assert np.isnan(continuous_degrees(np.full((3, 1), np.nan))).all()
