import numpy as np
import pytest
from tests.textures import Texture

from marey.images.matching.scanning import patches_at, pyramid_of, scan, scan_patches


@pytest.fixture(scope="module")
def picture() -> np.ndarray:
    y, x = np.indices((200, 240), float)
    texture = Texture.draw(np.random.default_rng(8), count=40, shortest=5.0, longest=40.0)
    return texture(np.stack([x, y], axis=-1)).astype(np.float32)


def test_the_score_is_the_correlation_of_the_grey_values(picture):
    expected, size = np.array([[60.0, 70.0], [91.0, 52.0]]), 9
    rng = np.random.default_rng(0)
    patches = rng.normal(100, 20, (2, size, size)).astype(np.float32)
    found, score = scan_patches(patches, picture - 128, expected, reach=5)
    for patch, middle, place, value in zip(patches, expected.astype(int), found.astype(int), score, strict=True):
        best = max(
            (np.corrcoef(patch.ravel(), picture[y - 4 : y + 5, x - 4 : x + 5].ravel())[0, 1], x, y)
            for x in range(middle[0] - 5, middle[0] + 6)
            for y in range(middle[1] - 5, middle[1] + 6)
        )
        assert value == pytest.approx(best[0], abs=1e-4)
        assert place.tolist() == [best[1], best[2]]


@pytest.mark.parametrize("reach", [6, 14, 40])
def test_a_shifted_image_is_found_shifted(picture, rng, reach):
    shift = np.array([4, -5]) if reach < 10 else np.array([9, -12]) if reach < 20 else np.array([31, -26])
    padded = np.pad(picture, 40, mode="reflect")
    moved = padded[40 - shift[1] : 240 - shift[1], 40 - shift[0] : 280 - shift[0]]
    pixels = rng.uniform([70, 80], [140, 120], (50, 2))
    found, score = scan(pyramid_of(picture), pyramid_of(moved), pixels, pixels, size=13, reach=reach)
    np.testing.assert_allclose(found - pixels, np.broadcast_to(shift, (50, 2)), atol=1e-9)
    assert score.min() > 0.99


def test_gain_and_offset_change_nothing(picture):
    pixels = np.array([[70.0, 61.0], [100.0, 80.0]])
    patches = patches_at(picture, pixels, size=13)
    first = scan_patches(patches, picture - 128, pixels + 2, reach=4)
    second = scan_patches(0.4 * patches + 31, picture - 128, pixels + 2, reach=4)
    np.testing.assert_allclose(first[0], second[0])
    np.testing.assert_allclose(first[1], second[1], atol=1e-5)


def test_patches_are_cut_out_as_they_are(picture):
    whole = patches_at(picture, np.array([[1.0, 1.0], [238.0, 198.0], [239.0, 70.0]]), size=3)
    np.testing.assert_array_equal(whole[:2], np.stack([picture[:3, :3], picture[197:, 237:]]))
    assert np.isnan(whole[2]).all()


def test_what_lies_beyond_the_image_is_not_found(picture):
    pyramid = pyramid_of(picture)
    pixels = np.array([[2.0, 60.0], [60.0, 60.0], [60.0, 60.0], [np.nan, 3.0]])
    expected = np.array([[60.0, 60.0], [-50.0, 60.0], [1e12, 0.0], [60.0, 60.0]])
    found, score = scan(pyramid, pyramid, pixels, expected, size=13, reach=8)
    assert np.isnan(found).all()
    assert np.isnan(score).all()


def test_a_flat_patch_resembles_nothing(picture):
    flat = np.full((1, 9, 9), 77.0, np.float32)
    _, score = scan_patches(flat, picture - 128, np.array([[60.0, 60.0]]), reach=3)
    assert np.isnan(score).all()
    _, score = scan_patches(picture[None, :9, :9], np.zeros((50, 50), np.float32), np.array([[25.0, 25.0]]), reach=3)
    assert np.isnan(score).all()


def test_a_small_image_has_a_small_pyramid():
    assert len(pyramid_of(np.zeros((20, 30), np.uint8)).levels) == 1
    assert [level.shape for level in pyramid_of(np.zeros((101, 150), np.uint8)).levels] == [
        (101, 150),
        (50, 75),
        (25, 37),
        (12, 18),
    ]
