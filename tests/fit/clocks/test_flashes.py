import numpy as np
import pytest

from marey.fit.clocks.clock_fit import DRIFT_SD
from marey.fit.clocks.flashes import flash_clocks, light_events
from marey.images.brightness import brightness_changes

RATE = 30.0
CELLS = 48


def pictures(rng, *, offset=0.0, flashes=(), lamp=None, frames=150, rate=RATE, drift=0.0, level=None, exposure=0.95):
    """Cells (F, 48) of exposures of most of a frame period about their times; light adds to a room of other cells."""
    times = np.arange(frames) / rate
    instants = times * (1 + drift) + offset
    room = rng.uniform(40, 160, CELLS)
    begin, end = instants - 0.5 * exposure / rate, instants + 0.5 * exposure / rate
    light = sum(((begin <= at) & (at < end)).astype(float) for at in flashes) + np.zeros(frames)
    if lamp is not None:
        light += 0.5 * np.clip((end - lamp) / (end - begin), 0, 1)
    cells = room * (np.ones(frames) if level is None else level)[:, None] + 60 * light[:, None]
    # Somebody walks through a quarter of the picture.
    cells[:, :12] += 25 * np.sin(8 * instants)[:, None]
    return np.round(np.clip(cells + 0.3 * rng.normal(size=cells.shape), 0, 255)), times


def found(*cameras):
    events = [light_events(brightness_changes(cells), times) for cells, times in cameras]
    return flash_clocks([f"cam{c + 1:02d}" for c in range(len(cameras))], events, [times for _, times in cameras])


@pytest.mark.parametrize("offset", [0.0, 7 / RATE, -40 / RATE, 12.4 / RATE])
def test_a_flash_determines_the_offset_to_about_half_a_frame(rng, offset):
    clocks = found(pictures(rng, flashes=[2.01]), pictures(rng, offset=offset, flashes=[2.01])).clocks
    assert abs(clocks.offset_s[1] - offset) <= 1.001 / RATE
    # The difference of two uniform distributions of one frame.
    np.testing.assert_allclose(clocks.offset_sd_s[1] * RATE, np.sqrt(1 / 6), rtol=1e-2)
    assert clocks.drift_sd[1] == pytest.approx(DRIFT_SD)


def test_a_lamp_and_cameras_of_other_rates_are_compared_in_time(rng):
    clocks = found(
        pictures(rng, lamp=1.5), pictures(rng, offset=0.5, lamp=1.5, rate=60.0, frames=250),
        pictures(rng, offset=-0.3, lamp=1.5),
    ).clocks  # fmt: skip
    assert (np.abs(clocks.offset_s - [0, 0.5, -0.3]) < 1 / RATE).all()
    assert clocks.offset_sd_s[1] < clocks.offset_sd_s[2]


def test_the_stated_deviation_holds_over_many_offsets(rng):
    offsets = rng.uniform(-0.5, 0.5, 60)
    first = pictures(rng, flashes=[2.003])
    clocks = [found(first, pictures(rng, offset=o, flashes=[2.003], exposure=1.0)).clocks for o in offsets]
    known = [(c.offset_s[1] - o) / c.offset_sd_s[1] for c, o in zip(clocks, offsets, strict=True)]
    assert len(known) == 60
    # 60 uniform deviations relative to a triangular distribution's: the first camera's part is the same in all.
    assert 0.4 < np.sqrt(np.mean(np.square(known))) < 1.6


def test_several_flashes_determine_the_drift(rng):
    flashes = [2.003, 30.517, 58.241]
    first = pictures(rng, flashes=flashes, frames=1800, exposure=1.0)
    own = pictures(rng, flashes=flashes, frames=1800, exposure=1.0, drift=1e-3, offset=0.2)
    clocks = found(first, own).clocks
    assert abs(clocks.drift[1] - 1e-3) < 3 * clocks.drift_sd[1] < 2.4 * DRIFT_SD
    assert abs(clocks.offset_s[1] - 0.2) < 3 * clocks.offset_sd_s[1]


def test_a_flash_between_two_exposures_is_not_shown(rng):
    cells, times = pictures(rng, flashes=[2.016], exposure=0.5)
    assert light_events(brightness_changes(cells), times) == []


def drifting(frames=150):
    """Automatic exposure that darkens the picture by 40 % within a second and recovers."""
    return 1 - 0.4 * np.exp(-0.5 * ((np.arange(frames) - 70) / 15) ** 2)


def flickering(frames=150):
    """A lamp at the mains frequency, seen in every picture at another phase."""
    return 1 + 0.25 * np.sin(2.1 * np.arange(frames))


@pytest.mark.parametrize("level", [None, drifting(), flickering()])
def test_without_a_flash_there_is_no_event(rng, level):
    cells, times = pictures(rng, level=level)
    assert light_events(brightness_changes(cells), times) == []


def test_a_flash_is_found_in_spite_of_automatic_exposure(rng):
    clocks = found(pictures(rng, flashes=[2.01]), pictures(rng, offset=0.5, flashes=[2.01], level=drifting())).clocks
    assert abs(clocks.offset_s[1] - 0.5) <= 1.001 / RATE


def test_events_that_do_not_belong_together_give_no_answer(rng):
    several = pictures(rng, flashes=[1.0, 2.0, 3.0])
    for other, why in (
        (pictures(rng), "it shows no flash"),
        (pictures(rng, lamp=2.0), "no flash is clearly that of the first camera"),
        (pictures(rng, flashes=[2.0]), "no flash is clearly that of the first camera"),
        (pictures(rng, flashes=[1.0, 2.7]), "no flash is clearly that of the first camera"),
    ):
        assert found(several, other).undetermined == {"cam02": why}
