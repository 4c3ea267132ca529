"""The background of a camera from images in which the person is elsewhere."""

import numpy as np
import pytest

from marey.images.silhouettes import uncovered
from marey.images.silhouettes.uncovered import (
    ALIKE,
    ENOUGH,
    background_where_uncovered,
    background_with_empty,
    shows_nobody,
)

SIZE = (42, 56)
COUNT = 12
NOISE = 1.5


def room(rng):
    """A room of large patches, each of one colour."""
    patches = rng.integers(40, 200, (SIZE[0] // 7, SIZE[1] // 7, 3))
    return patches.repeat(7, 0).repeat(7, 1).astype(float)


def filmed(room, rng, factor=1.0):
    noisy = factor * room + rng.normal(0, NOISE, room.shape)
    return np.clip(np.round(noisy), 0, 255).astype(np.uint8)


def passing(rng):
    """Images of a person of 14 columns, who walks by and of whom 7 columns always hide the left border."""
    empty = room(rng)
    pictures, covered = [], []
    for i in range(COUNT):
        mask = np.zeros(SIZE, bool)
        mask[:, 7 + 3 * i : 21 + 3 * i] = True
        mask[:, :7] = True
        picture = filmed(empty, rng)
        picture[mask] = [20, 30, 220]
        pictures.append(picture)
        covered.append(mask)
    return empty, pictures, covered


def test_the_room_is_recovered_where_it_is_uncovered_and_unknown_where_it_never_is(rng):
    empty, pictures, covered = passing(rng)
    found = background_where_uncovered(pictures, covered)
    free = ~np.logical_and.reduce(covered)
    times = np.sum(~np.stack(covered), axis=0)
    np.testing.assert_array_equal(found.confidence[~free], 0.0)
    assert np.array_equal(np.flatnonzero(~free.any(0)), np.arange(7))
    # The error of a mean of n images is noise / sqrt(n); rounding and the factors of brightness add a little.
    error = (found.mean - empty)[free]
    assert np.sqrt(np.mean(error**2)) < 1.5 * NOISE / np.sqrt(times[free].min())
    # Of the images in which a pixel is free nearly all have the colour: 6 grey levels are 2.8 sd of a difference.
    assert found.confidence[free & (times >= ENOUGH)].mean() > 0.95


def test_few_images_make_a_pixel_less_certain(rng):
    pictures = [filmed(room(np.random.default_rng(1)), rng) for _ in range(COUNT)]
    covered = [np.zeros(SIZE, bool) for _ in range(COUNT)]
    for i in range(2, COUNT):
        covered[i][:, :10] = True
    found = background_where_uncovered(pictures, covered)
    np.testing.assert_allclose(found.confidence[:, :10].max(), 2 / ENOUGH)
    assert found.confidence[:, 10:].mean() > 0.95


def test_a_screen_that_changes_has_a_low_confidence_and_its_most_frequent_colour(rng):
    empty = room(rng)
    pictures = [filmed(empty, rng) for _ in range(COUNT)]
    # Two colours in turn, in 7 and 5 of 12 images; beside it, a new colour in every image.
    for i, picture in enumerate(pictures):
        picture[7:21, 7:21] = [200, 90, 40] if i % 2 == 0 or i == 1 else [40, 120, 210]
        picture[7:21, 28:42] = [255 - 20 * i, 10 + 20 * i, 20 * (i % 3)]
    found = background_where_uncovered(pictures, [np.zeros(SIZE, bool)] * COUNT)
    np.testing.assert_allclose(found.confidence[8:20, 8:20], 7 / 12, atol=1e-6)
    # All images are brought to one brightness, whose factors err by the noise.
    np.testing.assert_allclose(found.mean[8:20, 8:20], np.broadcast_to([200, 90, 40], (12, 12, 3)), atol=3)
    np.testing.assert_allclose(found.confidence[8:20, 29:41], 1 / 12, atol=1e-6)


def test_flicker_is_compensated(rng):
    empty = 0.8 * room(rng)
    factors = 1.0 + 0.1 * np.sin(np.arange(COUNT))
    pictures = [filmed(empty, rng, factor) for factor in factors]
    found = background_where_uncovered(pictures, [np.zeros(SIZE, bool)] * COUNT)
    # Without compensation 10 % of 150 grey levels would be many times the tolerance of equal colours.
    assert found.confidence.mean() > 0.9
    error = found.mean - factors[COUNT // 2] * empty
    assert np.abs(error.mean()) < 1.0


def test_a_person_who_stays_in_one_image_is_not_part_of_the_room_of_grey_images(rng):
    empty, pictures, covered = passing(rng)
    grey = [picture[..., :1] for picture in pictures]
    found = background_where_uncovered(grey, covered)
    assert found.mean.shape == (*SIZE, 1)
    free = ~np.logical_and.reduce(covered)
    assert np.sqrt(np.mean((found.mean - empty[..., :1])[free] ** 2)) < NOISE


def plain(pictures, free):
    """The most frequent colour of every pixel, as the kernel's words say."""
    height, width, channels = pictures.shape[1:]
    mean, share, number = np.zeros((height, width, channels)), np.zeros((height, width)), np.zeros((height, width))
    for y in range(height):
        for x in range(width):
            own = pictures[free[:, y, x], y, x]
            number[y, x] = len(own)
            if len(own):
                alike = (np.abs(own[:, None] - own) <= ALIKE).all(axis=2)
                best = alike[alike.sum(axis=1).argmax()]
                mean[y, x], share[y, x] = own[best].mean(axis=0), best.mean()
    return mean, share, number


def test_the_kernel_is_the_plain_formula(rng):
    pictures = rng.integers(100, 125, (9, 12, 10, 3)).astype(np.float32)
    free = rng.random((9, 12, 10)) < 0.6
    free[:, 0, 0] = False
    factors = np.ones((9, 3), np.float32)
    found = uncovered._most_frequent_uncovered(pictures.astype(np.uint8), factors, free, np.float32(ALIKE))
    expected = plain(pictures, free)
    # A colour that more than half of the images have ends the search: another one may have more images like it.
    sure = expected[1] <= 0.5
    assert sure.sum() > 60
    np.testing.assert_array_equal(found[2], expected[2])
    np.testing.assert_allclose(found[0][sure], expected[0][sure], rtol=1e-5)
    np.testing.assert_allclose(found[1][sure], expected[1][sure], rtol=1e-6)
    assert (found[1][~sure] > 0.5).all()


@pytest.mark.parametrize(("pictures", "covered"), [(0, 0), (2, 1)])
def test_no_images_and_masks_of_another_number_are_rejected(pictures, covered):
    image, mask = np.zeros((*SIZE, 3), np.uint8), np.zeros(SIZE, bool)
    with pytest.raises(ValueError, match="needs images, and a mask for each of them"):
        background_where_uncovered([image] * pictures, [mask] * covered)


def test_an_image_of_the_empty_room_shows_what_the_person_always_hides(rng):
    empty, pictures, covered = passing(rng)
    always = np.logical_and.reduce(covered)
    others = [filmed(empty, rng, factor=0.9) for _ in range(ENOUGH)]
    found = background_with_empty(pictures, covered, always, others)
    error = found.mean[always] - empty[always]
    # The noise of one image; the factor of brightness errs by a hundredth, two grey levels at most.
    assert np.sqrt(np.mean(error**2)) < NOISE + 2
    assert found.confidence[always].min() > 0.5


def test_an_image_with_the_person_teaches_nothing(rng):
    empty, pictures, covered = passing(rng)
    always = np.logical_and.reduce(covered)
    still_there = [pictures[0].copy(), filmed(empty, rng)]
    # In the second, the person has left its usual place, but is at another one, where the room is known.
    still_there[1][:, 30:44] = [20, 30, 220]
    plainly = background_where_uncovered(pictures, covered)
    for other in still_there:
        found = background_with_empty(pictures, covered, always, [other])
        np.testing.assert_array_equal(found.mean, plainly.mean)
        np.testing.assert_array_equal(found.confidence, plainly.confidence)


def test_without_a_place_that_is_always_hidden_an_empty_image_adds_nothing(rng):
    empty, pictures, covered = passing(rng)
    background = background_where_uncovered(pictures, covered)
    assert not shows_nobody(filmed(empty, rng), background, np.zeros(SIZE, bool), 100.0)
