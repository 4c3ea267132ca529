"""The clock of a foreign device: offset and rate from signals and events, with honest standard deviations."""

import numpy as np
import pytest

from marey.errors import MareyError
from marey.geometry import rotations
from marey.motion.device_clock import (
    DeviceClock,
    DeviceClockSettings,
    SignalGroup,
    clock_from_events,
    clock_from_signals,
    resampled_signal,
)


def _path(rng):
    """Return a smooth function of time that does not repeat itself [any unit]."""
    hertz, phase, size = rng.uniform(0.1, 2.0, 12), rng.uniform(0, 2 * np.pi, 12), rng.uniform(0.5, 1.0, 12)
    return lambda t: (size * np.sin(2 * np.pi * hertz * t[:, None] + phase)).sum(1)


def _made(seed, *, offset, drift, rate, noise=0.1, path=None, seconds=20.0):
    rng = np.random.default_rng(seed)
    path = _path(rng) if path is None else path
    cameras, device = np.arange(0, seconds, 1 / 30), np.arange(0, seconds, 1 / rate)
    x = path(cameras) + noise * rng.standard_normal(len(cameras))
    y = 40 + 300 * (path(device + offset + drift * device) + noise * rng.standard_normal(len(device)))
    return (cameras, x[:, None]), (device, y[:, None])


@pytest.mark.slow
@pytest.mark.parametrize(("rate", "offset", "drift"), [(120, 1.2345, 1e-4), (1000, -0.777, -2e-3), (100, 0.01, 1e-2)])
def test_planted_offset_and_rate_are_found_within_their_stated_spread(rate, offset, drift):
    errors = []
    for seed in range(20):
        clock = clock_from_signals(*_made(seed, offset=offset, drift=drift, rate=rate))
        errors.append([(clock.offset_s - offset) / clock.offset_sd_s, (clock.drift - drift) / clock.drift_sd])
        assert clock.offset_sd_s < 0.1 / 30
    held = np.mean(np.abs(errors) < 1.96)
    assert held >= 0.85  # 40 numbers that are normally distributed fall below this in one of 100 cases
    assert np.std(errors) > 0.5  # the stated spread is not needlessly large


def test_known_standard_deviations_weight_frames_of_a_fast_rate():
    cameras, device = _made(3, offset=0.4, drift=1e-3, rate=120)
    fast = np.arange(0, 20, 1 / 240)
    clock = clock_from_signals((fast, np.interp(fast, cameras[0], cameras[1][:, 0])[:, None]), device,
                               sd=np.full((len(fast), 1), 0.1))  # fmt: skip
    assert abs(clock.offset_s - 0.4) < 3 * clock.offset_sd_s


AXES = SignalGroup(own=(0, 1, 2), device=(0, 1, 2))


def _made_axes(seed, *, offset, drift, seconds=20.0):
    """Three independent signals, and the same in the axes of a sensor, in another unit."""
    rng = np.random.default_rng(seed)
    paths, turn = [_path(rng) for _ in range(3)], rotations.exp(rng.normal(size=3))
    cameras, device = np.arange(0, seconds, 1 / 30), np.arange(0, seconds, 1 / 200)
    own, there = (np.stack([path(at) for path in paths], axis=1) for at in (cameras, device + offset + drift * device))
    felt = 57.3 * (there + 0.1 * rng.standard_normal(there.shape)) @ turn + [3.0, 0.0, -2.0]
    return (cameras, own + 0.3 * rng.standard_normal(own.shape)), (device, felt)


@pytest.mark.slow
def test_axes_of_a_sensor_may_be_turned_against_those_of_the_motion():
    errors = []
    exact = DeviceClockSettings(repeated_sd_s=0.0)
    for seed in range(20):
        cameras, device = _made_axes(seed, offset=0.321, drift=5e-4)
        clock = clock_from_signals(cameras, device, groups=[AXES], settings=exact)
        errors.append([(clock.offset_s - 0.321) / clock.offset_sd_s, (clock.drift - 5e-4) / clock.drift_sd])
    assert np.mean(np.abs(errors) < 1.96) >= 0.85  # of 40 numbers, as above
    assert np.std(errors) > 0.5


def test_left_handed_and_missing_axes_do_no_harm():
    cameras, (time, felt) = _made_axes(3, offset=0.321, drift=0.0)
    for changed in (felt * [1, 1, -1], felt * [1, 1, 0], felt[:, :2]):
        group = SignalGroup(own=(0, 1, 2), device=tuple(range(changed.shape[1])))
        clock = clock_from_signals(cameras, (time, changed), groups=[group])
        assert abs(clock.offset_s - 0.321) < 4 * clock.offset_sd_s < 0.02


def test_errors_that_repeat_add_to_the_offset_alone():
    signals = _made(4, offset=0.2, drift=1e-4, rate=120)
    plain, found = (
        clock_from_signals(*signals, settings=DeviceClockSettings(repeated_sd_s=sd)).covariance for sd in (0.0, 2e-3)
    )
    np.testing.assert_allclose(found - plain, np.diag([4e-6, 0.0]), rtol=1e-3, atol=1e-12)


def test_unrelated_axes_have_no_clock():
    cameras, other = _made_axes(1, offset=0.3, drift=0.0)[0], _made_axes(2, offset=0.3, drift=0.0)[1]
    with pytest.raises(MareyError, match="No clock"):
        clock_from_signals(cameras, other, groups=[AXES])


def test_periodic_motion_has_no_clock():
    signals = _made(1, offset=0.3, drift=1e-3, rate=120, path=lambda t: np.sin(2 * np.pi * t))
    with pytest.raises(MareyError, match="periodic"):
        clock_from_signals(*signals)


def test_signals_that_do_not_move_or_agree_have_no_clock():
    cameras, device = _made(1, offset=0.3, drift=0.0, rate=120)
    with pytest.raises(MareyError, match="do not move"):
        clock_from_signals(cameras, (device[0], np.ones_like(device[1])))
    other = _made(2, offset=0.3, drift=0.0, rate=120)[1]
    with pytest.raises(MareyError, match="No clock"):
        clock_from_signals(cameras, other)


@pytest.mark.slow
def test_events_give_the_clock_despite_missing_and_extra_ones():
    errors = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        device = np.cumsum(rng.uniform(0.3, 1.2, 25))
        cameras = device * 1.003 + 2.5 + 0.008 * rng.standard_normal(25)
        cameras = np.r_[np.delete(cameras, [3, 11, 12]), rng.uniform(2, 20, 2)]
        clock = clock_from_events(cameras, np.delete(device, 7))
        errors.append([(clock.offset_s - 2.5) / clock.offset_sd_s, (clock.drift - 0.003) / clock.drift_sd])
    assert np.mean(np.abs(errors) < 1.96) >= 0.8  # 24 numbers: below this in one of 160 cases


def test_regular_or_few_events_have_no_clock():
    with pytest.raises(MareyError, match="regular"):
        clock_from_events(np.arange(20) * 0.5, np.arange(20) * 0.5 + 0.1)
    with pytest.raises(MareyError, match="fewer than"):
        clock_from_events(np.arange(3.0), np.arange(20.0))


def test_resampled_signals_hold_the_truth_within_their_variance():
    inside = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        path, covariance = _path(rng), np.diag([4e-3, 1e-4]) ** 2
        offset, drift = np.array([0.2, 1e-3]) + rng.multivariate_normal([0, 0], covariance)
        clock = DeviceClock(offset_s=0.2, drift=1e-3, covariance=covariance, used=100)
        device, instants = np.arange(0, 10, 0.01), np.arange(1, 9, 1 / 30)
        values = path(device + offset + drift * device) + 0.01 * rng.standard_normal(len(device))
        found, variance = resampled_signal((device, values[:, None]), clock, instants, variance=1e-4)
        inside.append(np.abs(found[:, 0] - path(instants)) < 1.96 * np.sqrt(variance[:, 0]))
    assert 0.85 <= np.mean(inside) <= 0.995
