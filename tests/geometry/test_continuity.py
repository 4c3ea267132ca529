import numpy as np

from marey.geometry.continuity import continuous_angles


def test_jumps_by_whole_turns_are_removed_also_over_gaps():
    true = np.stack([np.linspace(150, 260, 50), np.linspace(-30, 30, 50)], 1)
    wrapped = (true + 180) % 360 - 180
    wrapped[20:30, 0] = true[20:30, 0] = np.nan
    np.testing.assert_allclose(continuous_angles(wrapped, period=360.0), true, atol=1e-9)
    centred = continuous_angles(wrapped, period=360.0, centred=True)
    np.testing.assert_allclose(centred, true - [[360.0, 0.0]], atol=1e-9)
    np.testing.assert_allclose(continuous_angles(np.radians(wrapped)), np.radians(true), atol=1e-9)


def test_one_angle_is_as_several_and_unknown_ones_stay():
    turning = np.linspace(0, 20, 100)
    wrapped = (turning + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(continuous_angles(wrapped), turning, atol=1e-9)
    np.testing.assert_array_equal(continuous_angles(wrapped), continuous_angles(wrapped[:, None])[:, 0])
    assert np.isnan(continuous_angles(np.full((3, 1), np.nan), centred=True)).all()
    assert continuous_angles(np.zeros((0, 2))).shape == (0, 2)
