"""Keypoints and their matches, which need no calibration."""

import numpy as np
from tests import scenes

from marey.images.matching.keypoints import keypoints, matched_keypoints

CAMERA = scenes.camera_at("one", 0)


def filmed(rng: np.random.Generator) -> np.ndarray:
    return scenes.Ball.draw(rng).filmed(CAMERA, rng)


def test_matches_follow_a_turned_image(rng):
    image = filmed(rng)
    here, there = matched_keypoints(keypoints(image), keypoints(np.ascontiguousarray(image[::-1, ::-1])))
    back = np.array(CAMERA.size) - 1 - there
    assert len(here) > 100
    # A keypoint is exact to a fraction of a pixel.
    assert np.median(np.linalg.norm(back - here, axis=1)) < 0.3


def test_keypoints_stay_within_a_mask(rng):
    image = filmed(rng)
    mask = np.zeros(image.shape[:2], bool)
    mask[:, :130] = True
    assert len(keypoints(image, mask).pixels) > 50
    assert keypoints(image, mask).pixels[:, 0].max() < 131


def test_pixels_of_large_images_are_those_of_the_image(rng):
    small = filmed(rng)
    large = np.repeat(np.repeat(small, 8, axis=0), 8, axis=1)
    here, there = matched_keypoints(keypoints(small), keypoints(large))
    assert len(here) > 50
    assert np.median(np.linalg.norm((there + 0.5) / 8 - 0.5 - here, axis=1)) < 0.5


def test_an_image_without_texture_has_no_matches(rng):
    flat = keypoints(np.full((240, 260, 3), 90, np.uint8))
    assert len(flat.pixels) == 0
    assert len(matched_keypoints(flat, keypoints(filmed(rng)))[0]) == 0
