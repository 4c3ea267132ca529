import numpy as np
import pytest

from marey.images import background as backgrounds


def textured(rng, shape=(60, 80, 3)):
    return np.clip(rng.normal(120, 30, shape), 20, 235)


def shown(picture, rng, noise=2.0):
    return np.clip(np.round(picture + rng.normal(0, noise, picture.shape)), 0, 255).astype(np.uint8)


def test_gain_offset_and_noise_are_found_though_a_quarter_is_covered(rng):
    truth = textured(rng)
    plate = backgrounds.from_pictures([np.round(truth).astype(np.uint8)])
    picture = 0.9 * truth + 5.0
    picture[10:40, 10:50] = (10, 20, 200)
    exposure = backgrounds.exposure(shown(picture, rng, 3.0), plate)
    assert np.allclose(exposure.gain, 0.9, atol=0.01)
    assert np.allclose(exposure.offset, 5.0, atol=1.5)
    assert np.allclose(exposure.noise, 3.0, rtol=0.35)


def test_the_median_of_a_clip_forgets_who_walks_through(rng):
    truth = textured(rng)
    pictures = []
    for k in range(9):
        picture = truth.copy()
        picture[:, 8 * k : 8 * k + 8] = 0
        pictures.append(shown(picture, rng, 1.0))
    assert abs(backgrounds.from_pictures(pictures).mean - truth).max() < 5


def test_the_take_itself_gives_the_background_where_each_pixel_is_empty_at_some_time(rng):
    truth = textured(rng)
    pictures = []
    for k in range(10):
        picture = truth.copy()
        # A moving person of changing colour covers six tenths of the time.
        if k < 6:
            picture[20:40, 20:40] = 25.0 * k
        pictures.append(shown(picture, rng, 1.0))
    assert abs(backgrounds.from_take(pictures).mean - truth).max() < 6


def test_pictures_of_two_sizes_are_refused():
    with pytest.raises(ValueError, match="one size"):
        backgrounds.from_pictures([np.zeros((4, 4, 3), np.uint8), np.zeros((5, 4, 3), np.uint8)])
    with pytest.raises(ValueError, match="at least one"):
        backgrounds.from_take([])
    plate = backgrounds.from_pictures([np.zeros((4, 4, 3), np.uint8)])
    with pytest.raises(ValueError, match="background of"):
        backgrounds.exposure(np.zeros((5, 4, 3), np.uint8), plate)
