"""Shifts of patches: against the plain least squares, within the stated covariance, and where nothing is known."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from marey.images.matching.carried_patches import match_patches

SETTINGS = {"search": 2, "least_pixels": 60, "least_noise": 0.25}
HALF = 5
SIDE = np.arange(-HALF, HALF + 1)
WINDOW = np.stack(np.meshgrid(SIDE, SIDE), -1).reshape(-1, 2).astype(float)


def texture(rng, size=80):
    grey = gaussian_filter(rng.normal(size=(size, size)), 1.5)
    return 100 + 25 * grey / grey.std()


def sampled(image, pixels, order=3):
    return map_coordinates(image, [pixels[..., 1], pixels[..., 0]], order=order, mode="nearest")


def patches(image, centres):
    """Pixels (n, k, 2) and grey values (n, k) of patches about centres (n, 2)."""
    pixels = centres[:, None] + WINDOW
    return pixels, sampled(image, pixels, order=1)


def find(image, pixels, grey, start=None, used=None, **settings):
    start = np.zeros((len(pixels), 2)) if start is None else start
    used = np.ones(grey.shape, bool) if used is None else used
    return match_patches(image, pixels, used, grey, start, **(SETTINGS | settings))


def plain_shift(image, pixels, grey, shift):
    """Gauss-Newton of shift, gain and offset by a dense least squares."""
    for _ in range(30):
        at = pixels + shift
        found = sampled(image, at, order=1)
        slopes = [0.5 * (sampled(image, at + e, order=1) - sampled(image, at - e, order=1)) for e in np.eye(2)]
        columns = np.stack([*slopes, -grey, -np.ones(len(grey))], 1)
        solved = np.linalg.lstsq(columns, found, rcond=None)[0]
        shift = shift - solved[:2]
    return shift


def test_the_shift_is_that_of_the_plain_least_squares(rng):
    image = texture(rng)
    true = np.array([0.6, -0.4])
    pixels, grey = patches(image, np.array([[30.0, 40.0], [45.0, 33.0]]))
    moved = sampled(image, np.stack(np.meshgrid(np.arange(80), np.arange(80)), -1) - true)
    found = find(0.8 * moved + 30, pixels, grey)
    for n in range(2):
        expected = plain_shift(np.asarray(0.8 * moved + 30, np.float32), pixels[n], grey[n], np.zeros(2))
        # The iteration ends at a step of 0.02 px, and its weak prior of 3 px pulls less than that.
        np.testing.assert_allclose(found.shift[n], expected, atol=0.03)
        np.testing.assert_allclose(found.shift[n], true, atol=0.1)


def test_the_covariance_of_the_shift_is_honest(rng):
    image, true, noise = texture(rng, 200), np.array([0.35, 0.2]), 3.0
    grid = np.stack(np.meshgrid(np.arange(200), np.arange(200)), -1)
    first = gaussian_filter(image + noise * rng.normal(size=image.shape), 0.8)
    second = gaussian_filter(sampled(image, grid - true) + noise * rng.normal(size=image.shape), 0.8)
    centres = np.stack(np.meshgrid(np.arange(12, 188, 14.0), np.arange(12, 188, 14.0)), -1).reshape(-1, 2)
    found = find(second, *patches(first, centres))
    away = found.shift - true
    squares = np.einsum("ni,nij,nj->n", away, found.information, away)
    # Two degrees of freedom each; the share of distinct pixels is a round number on the safe side.
    assert np.isfinite(squares).all()
    assert 0.2 < np.mean(squares) / 2 < 1.5


def test_a_start_a_few_pixels_off_is_found_by_the_search(rng):
    image = texture(rng)
    pixels, grey = patches(image, np.array([[40.0, 40.0]]))
    found = find(image, pixels + np.array([1.7, -1.2]), grey)
    np.testing.assert_allclose(found.shift, [[-1.7, 1.2]], atol=0.05)
    from_start = find(image, pixels + np.array([6.0, 0.0]), grey, np.array([[-5.0, 0.0]]))
    np.testing.assert_allclose(from_start.shift, [[-6.0, 0.0]], atol=0.05)


def test_stripes_tell_nothing_along_them(rng):
    image = np.tile(100 + 30 * np.sin(np.arange(80) / 2.0), (80, 1)) + rng.normal(size=(80, 80)) * 0.5
    pixels, grey = patches(image, np.array([[40.0, 40.0]]))
    image = np.tile(100 + 30 * np.sin((np.arange(80) - 0.5) / 2.0), (80, 1)) + rng.normal(size=(80, 80)) * 0.5
    found = find(image, pixels, grey)
    assert found.shift[0, 0] == pytest.approx(0.5, abs=0.1)
    assert found.information[0, 1, 1] < 0.02 * found.information[0, 0, 0]


def test_noise_alone_is_no_texture(rng):
    flat = 100 + 2.0 * rng.normal(size=(2, 80, 80))
    pixels, grey = patches(flat[0], np.array([[40.0, 40.0], [20.0, 50.0]]))
    found = find(flat[1], pixels, grey)
    # A standard deviation of more than a pixel: such a shift is worth nothing.
    known = np.isfinite(found.shift[:, 0])
    assert (np.linalg.eigvalsh(found.information[known]).max(1) < 15).all()
    textured = find(texture(rng), *patches(texture(rng), np.array([[40.0, 40.0]])))
    assert textured.noise[0] > 100 or np.isnan(textured.noise[0])


def test_patches_outside_the_image_or_hidden_have_no_shift(rng):
    image = texture(rng)
    pixels, grey = patches(image, np.array([[40.0, 40.0], [40.0, 40.0], [30.0, 30.0]]))
    pixels[0] += 100.0
    used = np.ones(grey.shape, bool)
    used[1, 50:] = False
    pixels[2] = np.nan
    found = find(image, pixels, grey, used=used)
    assert np.isnan(found.shift).all()
    assert not found.information.any()
