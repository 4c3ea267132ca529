"""Colour words and motion words of images."""

import numpy as np
import pytest

from marey.images.silhouettes.colour_words import (
    MOTION_CUTS,
    MOTION_OUTSIDE,
    MOTION_PRIOR,
    MOTION_QUANTILE,
    learned_words,
    motion_outside,
    motion_ratio,
    motion_words,
    word_features,
)

SIZE = (40, 48)


@pytest.fixture
def pictures(rng):
    """Three images of patches of random colours."""
    patches = rng.integers(0, 256, (3, SIZE[0] // 8, SIZE[1] // 8, 3)).astype(np.uint8)
    return list(patches.repeat(8, 1).repeat(8, 2))


def test_each_pixel_has_the_word_of_the_nearest_centre(pictures):
    words = learned_words(pictures, count=12)
    assert len(words) == 12
    features = word_features(pictures[0])
    distances = np.linalg.norm(features[:, :, None] - words.centres, axis=-1)
    np.testing.assert_array_equal(words.of(pictures[0]), distances.argmin(axis=-1))


def test_the_words_are_the_same_in_every_run(pictures):
    np.testing.assert_array_equal(learned_words(pictures).centres, learned_words(pictures).centres)


def test_pixels_of_one_colour_in_two_images_have_one_word_and_far_colours_have_two():
    red, blue = np.zeros((*SIZE, 3), np.uint8), np.zeros((*SIZE, 3), np.uint8)
    red[..., 2], blue[..., 0] = 220, 220
    words = learned_words([red, blue], count=2)
    assert len(np.unique(words.of(red))) == len(np.unique(words.of(blue))) == 1
    assert words.of(red)[0, 0] != words.of(blue)[0, 0]


def test_grey_images_have_words_of_lightness_and_texture_only(pictures):
    grey = pictures[0][..., :1]
    features = word_features(grey)
    # OpenCV computes the opponent colours from tables, in steps of 1/64.
    np.testing.assert_allclose(features[..., 1:3], 0.0, atol=0.2)
    assert features[..., 0].std() > 1
    assert features[..., 3].std() > 0.1
    assert learned_words([grey], count=4).of(grey).shape == SIZE


def test_motion_is_a_quantile_of_the_differences_to_other_images(pictures, rng):
    picture = pictures[0]
    others = [np.clip(picture + rng.integers(-40, 41, picture.shape), 0, 255).astype(np.uint8) for _ in range(6)]
    found = motion_words(picture, others)
    largest = np.abs(np.stack(others).astype(int) - picture.astype(int)).max(axis=-1)
    ordered = np.sort(largest, axis=0)[round(MOTION_QUANTILE * 5)]
    np.testing.assert_array_equal(found, np.sum(ordered[..., None] >= np.array(MOTION_CUTS), axis=-1))
    assert found.max() > found.min()


def test_a_still_image_and_an_image_without_others_have_no_motion(pictures):
    assert not motion_words(pictures[0], [pictures[0]] * 4).any()
    assert not motion_words(pictures[0], []).any()


def test_more_motion_speaks_more_for_a_person():
    ratio = motion_ratio(np.arange(len(MOTION_CUTS) + 1, dtype=np.uint8)[None])[0]
    assert ratio[0] < 0 < ratio[1]
    assert (np.diff(ratio) > 0).all()


def test_motion_where_something_always_moves_says_nothing_for_a_person():
    moving, still = np.full((1, 2), 5, np.uint8), np.zeros((1, 2), np.uint8)
    screen = np.array([[True, False]])
    outside = motion_outside([np.where(screen, moving, still)] * 40, [np.zeros((1, 2), bool)] * 40)
    np.testing.assert_allclose(outside.sum(axis=0), 1, rtol=1e-6)
    ratio = motion_ratio(moving, outside)
    assert ratio[0, 0] < 0 < ratio[0, 1]
    assert motion_ratio(still, outside)[0, 0] > 0


def test_motion_outside_is_learned_without_the_person_only():
    moving = np.full((2, 2), 5, np.uint8)
    unknown = motion_outside([moving] * 9, [np.ones((2, 2), bool)] * 9)
    np.testing.assert_allclose(unknown[:, 0, 0], MOTION_OUTSIDE, rtol=1e-6)
    np.testing.assert_allclose(motion_ratio(moving, unknown), motion_ratio(moving), rtol=1e-5)
    count = int(MOTION_PRIOR)
    half = motion_outside([moving] * count, [np.zeros((2, 2), bool)] * count)
    np.testing.assert_allclose(half[5, 0, 0], 0.5 + 0.5 * MOTION_OUTSIDE[5], rtol=1e-6)
