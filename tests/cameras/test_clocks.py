import numpy as np
import pytest

from marey.cameras.clocks import Clocks
from marey.errors import SettingProblem


def clocks(**changes):
    values = {
        "names": ("a", "b", "c"),
        "offset_s": [0.0, 0.4, -0.1],
        "drift": [0.0, 3e-4, -1e-4],
        "offset_sd_s": [0.0, 0.003, 0.004],
        "drift_sd": [0.0, 1e-5, 2e-5],
    }
    return Clocks(**(values | changes))


def test_times_are_the_inverse_of_instants():
    times = np.linspace(0, 1000, 7)
    for camera in range(3):
        np.testing.assert_allclose(clocks().times(camera, clocks().instants(camera, times)), times, atol=1e-12)
    np.testing.assert_array_equal(clocks().instants(0, times), times)


def test_an_instant_is_offset_plus_the_cameras_own_time_with_its_drift():
    assert clocks().instants(1, np.array(100.0)) == pytest.approx(100 + 0.4 + 0.03)


def test_another_first_camera_sees_the_same_events_together():
    every, some = clocks(), clocks().subset(["c", "b"])
    event = np.array([2.0, 30.0, 400.0])
    of_b, of_c = every.times(1, event), every.times(2, event)
    # The event is at c's own time on c's clock, and b's time says so too.
    np.testing.assert_allclose(some.instants(1, of_b), of_c, atol=1e-12)
    np.testing.assert_array_equal(some.instants(0, of_c), of_c)
    np.testing.assert_allclose(some.offset_sd_s, [0, 0.005])
    assert some.drift_sd[0] == 0


def test_an_unknown_camera_has_no_clock():
    with pytest.raises(SettingProblem, match="There is no clock of 'd'"):
        clocks().subset(["a", "d"])
