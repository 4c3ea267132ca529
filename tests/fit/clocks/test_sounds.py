import numpy as np
import pytest
from tests.made_walk import clocks

from marey.fit.clocks.clock_fit import DRIFT_SD
from marey.fit.clocks.estimate import ClockEstimate
from marey.fit.clocks.sounds import SOUND_SD_S, combined, onsets, sound_clocks

RATE, SECONDS = 8000, 8.0
CLAPS = (1.3, 2.9, 3.4, 5.75)


def recorded(rng, offset, *, claps=CLAPS, noise=0.003):
    """Sound of claps at instants, in a recording that begins at an offset, with noise of its own."""
    samples = noise * rng.normal(size=int(RATE * SECONDS))
    for instant in claps:
        first = round((instant - offset) * RATE)
        if 0 <= first < len(samples) - 800:
            samples[first : first + 800] += 0.5 * rng.normal(size=800) * np.exp(-np.arange(800) / 150)
    return onsets(samples, RATE, 0.0)


@pytest.mark.parametrize("offset", [0.0, 0.4137, -1.05])
def test_the_offset_is_found_to_a_few_milliseconds(rng, offset):
    found = sound_clocks(["cam01", "cam02"], [recorded(rng, 0.0), recorded(rng, offset)])
    assert found.undetermined == {}
    assert found.clocks.offset_s[1] == pytest.approx(offset, abs=0.003)
    assert found.clocks.offset_sd_s[1] == SOUND_SD_S


def test_the_begin_of_the_sound_in_the_video_counts(rng):
    first, own = recorded(rng, 0.0), recorded(rng, 0.0)
    later = type(own)(strength=own.strength, begin_s=0.25)
    found = sound_clocks(["cam01", "cam02"], [first, later])
    assert found.clocks.offset_s[1] == pytest.approx(-0.25, abs=0.003)


def test_noise_silence_and_repeated_sounds_give_no_answer(rng):
    first = recorded(rng, 0.0)
    noise, silent = recorded(rng, 0.0, claps=()), onsets(np.zeros(RATE * 8), RATE, 0.0)
    found = sound_clocks(["cam01", "cam02", "cam03", "cam04"], [first, noise, silent, None])
    assert found.clocks.names == ("cam01",)
    assert found.undetermined["cam02"] == "no sound is clearly that of the first camera"
    assert found.undetermined["cam04"] == "it recorded no sound"
    steps = tuple(np.arange(0.2, 7.5, 0.5))
    same = sound_clocks(["cam01", "cam02"], [recorded(rng, 0.0, claps=steps), recorded(rng, 0.1, claps=steps)])
    assert same.clocks.names == ("cam01",)


def estimate(offset, sd, undetermined=None):
    made = clocks([0.0, offset])
    own = type(made)(
        names=made.names, offset_s=made.offset_s, drift=np.array([0, 1e-5]), offset_sd_s=np.array([0, sd]),
        drift_sd=np.array([0, 1e-4]),
    )  # fmt: skip
    return ClockEstimate(own, undetermined or {}, 1.0, 1)


def test_sources_are_weighted_by_their_precision():
    found = combined([estimate(3.0, 0.001), estimate(6.0, 0.002)], ["cam01", "cam02"])
    assert found.clocks.offset_s[1] == pytest.approx((0.1 / 1 + 0.2 / 4) / 1.25)
    assert found.clocks.offset_sd_s[1] == pytest.approx(0.001 / np.sqrt(1.25))
    # The prior of a drift is in both of them, and counts once.
    assert found.clocks.drift_sd[1] == pytest.approx((2 / 1e-4**2 - 1 / DRIFT_SD**2) ** -0.5)


def test_a_camera_that_one_source_determines_is_determined():
    reasons = {"cam03": "it recorded no sound"}
    found = combined(
        [estimate(3.0, 0.001, reasons), estimate(3.0, 0.001, {"cam03": "nothing moves"})], ["cam01", "cam02", "cam03"]
    )
    assert found.clocks.names == ("cam01", "cam02")
    assert found.undetermined == {"cam03": "it recorded no sound; nothing moves"}
