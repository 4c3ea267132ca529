import numpy as np
import pytest
from tests import made_walk

from marey.cameras.shutter import RollingShutter
from marey.fit.clocks.estimate import LARGEST_SD_FRAMES, estimate_clocks
from marey.fit.clocks.signals import tangent_signals

FINE = 0.12
"""Largest error of an offset [frames]. The tangents are rounded by 0.4 px and move by 1 to 3 px per frame: some 60
samples of each of 12 signals leave about 0.02 frames."""


def estimate(offsets, drifts=None, *, frames=None, rates=None, still=False):
    cameras, true = made_walk.cameras(len(offsets)), made_walk.clocks(offsets, drifts)
    masks = made_walk.silhouettes(cameras, true, frames=frames, rates=rates, still=still)
    rates = rates or [made_walk.RATE] * len(cameras)
    times = [np.arange(len(own)) / rate for own, rate in zip(masks, rates, strict=True)]
    return estimate_clocks(true.names, times, tangent_signals(cameras, masks)), true


def errors(found, true, at=0.0):
    """Errors (C,) of the instants at a time [frames]."""
    return np.array([found.clocks.instants(c, at) - true.instants(c, at) for c in range(len(true.names))]) * 30


@pytest.mark.parametrize("offsets", [[0, 0.37, -2.6, 5.25], [0, 10, 3, 1], [0, 0, 0, 0]])
def test_offsets_below_and_above_a_frame_are_found_within_their_stated_error(offsets):
    found, true = estimate(offsets, [0, 6e-5, -1.2e-4, 3e-4])
    assert found.undetermined == {}
    off = errors(found, true)
    assert np.abs(off).max() < FINE
    assert (np.abs(off[1:]) < 4 * found.clocks.offset_sd_s[1:] * 30).all()
    assert (found.clocks.offset_sd_s[1:] * 30 < FINE).all()
    assert off[0] == found.clocks.offset_sd_s[0] == 0
    assert np.abs(errors(found, true, at=made_walk.FRAMES / 30)).max() < FINE


def test_the_drift_of_a_longer_take_is_found():
    # A video of 29.97 Hz whose container states 30 Hz drifts by 1000 ppm: 0.3 frames in ten seconds.
    found, true = estimate([0, 2, -1], [0, 1e-3, 0], frames=[300] * 3)
    drift, sd = found.clocks.drift, found.clocks.drift_sd
    assert (np.abs(drift - true.drift) <= 4 * sd).all()
    assert drift[1] > 3 * sd[1]
    assert np.abs(errors(found, true, at=0)).max() < FINE
    assert np.abs(errors(found, true, at=10)).max() < FINE


def test_cameras_of_other_rates_and_lengths_are_compared_in_time():
    found, true = estimate([0, 2.3, -1.4, 0.5], frames=[100, 100, 190, 80], rates=[30, 30, 60, 30])
    assert found.undetermined == {}
    assert np.abs(errors(found, true)).max() < FINE


def test_rolling_shutters_are_compared_row_by_row():
    cameras, true, readouts = made_walk.cameras(3), made_walk.clocks([0, 1.3, -2.6]), [0.03, -0.03, 0.0]
    masks = made_walk.silhouettes(cameras, true, readouts=readouts)
    times = [np.arange(len(own)) / made_walk.RATE for own in masks]
    shutter = RollingShutter(readout_s=np.abs(readouts), sides=("top", "bottom", "top"))
    known = estimate_clocks(true.names, times, tangent_signals(cameras, masks, shutter))
    assert np.abs(errors(known, true)).max() < FINE
    # Without the readouts, the head and the feet of one body show other instants: the outlines do not agree.
    ignored = estimate_clocks(true.names, times, tangent_signals(cameras, masks))
    assert known.residual_px < 0.7 * ignored.residual_px


def test_nothing_that_moves_determines_no_clock():
    found, _ = estimate([0, 3, 0, 0], still=True)
    assert set(found.undetermined) == {"cam02", "cam03", "cam04"}
    assert found.clocks.names == ("cam01",)
    assert all("nothing moves enough" in why or "equally well" in why for why in found.undetermined.values())
    assert LARGEST_SD_FRAMES <= 0.5


def test_a_camera_that_sees_nothing_has_no_clock():
    cameras, true = made_walk.cameras(), made_walk.clocks([0, 1, 2, 3])
    masks = made_walk.silhouettes(cameras, true)
    masks[2] = [np.zeros_like(mask) for mask in masks[2]]
    times = [np.arange(len(own)) / made_walk.RATE for own in masks]
    found = estimate_clocks(true.names, times, tangent_signals(cameras, masks))
    assert found.undetermined == {"cam03": "it shares no moving point with another camera"}
    assert found.clocks.names == ("cam01", "cam02", "cam04")
    assert np.abs(found.clocks.offset_s * 30 - [0, 1, 3]).max() < FINE
