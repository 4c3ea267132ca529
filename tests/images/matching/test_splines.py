import numpy as np
import pytest
from scipy import ndimage
from tests.reference_matching import noise_shares, sample

from marey.errors import SettingProblem
from marey.images.matching.splines import slopes, spline_of, weights


@pytest.mark.parametrize("shape", [(40, 50), (5, 9), (130, 70)])
def test_coefficients_are_those_of_scipy(rng, shape):
    image = rng.normal(100, 30, shape)
    expected = ndimage.spline_filter(image, 3, mode="mirror")
    np.testing.assert_allclose(spline_of(image).coefficients, expected, atol=1e-3)


def test_a_spline_takes_the_images_values_at_the_pixels(rng):
    image = rng.integers(0, 256, (30, 40), dtype=np.uint8)
    y, x = np.mgrid[1:28, 1:38]
    values, _ = sample(spline_of(image), np.stack([x, y], axis=-1).astype(float))
    np.testing.assert_allclose(values, image[1:28, 1:38], atol=1e-3)


def test_gradients_are_those_of_differences(rng):
    picture = spline_of(rng.normal(100, 30, (30, 40)))
    places, step = rng.uniform(3, 25, (50, 2)), 1e-5
    _, gradient = sample(picture, places)
    for axis in range(2):
        shift = step * np.eye(2)[axis]
        difference = (sample(picture, places + shift)[0] - sample(picture, places - shift)[0]) / (2 * step)
        np.testing.assert_allclose(gradient[:, axis], difference, atol=1e-4)


def test_weights_sum_to_one_and_slopes_to_nothing(rng):
    t = rng.uniform(0, 1, 20)
    np.testing.assert_allclose(weights(t).sum(-1), 1, atol=1e-12)
    np.testing.assert_allclose(slopes(t).sum(-1), 0, atol=1e-12)


def test_nothing_is_known_beyond_the_border(rng):
    picture = spline_of(rng.normal(100, 30, (30, 40)))
    outside = np.array([[0.9, 10], [10, 0.5], [38.0, 10], [10, 28.5], [np.nan, 10], [-5, 4], [400, 9]])
    assert np.isnan(sample(picture, outside)[0]).all()


def test_a_missing_pixel_is_missing_about_itself_alone(rng):
    image = ndimage.gaussian_filter(rng.normal(100, 300, (40, 50)), 2)
    whole = spline_of(image)
    image[20, 30] = np.nan
    holed = spline_of(image)
    known = np.isfinite(holed.coefficients)
    assert (~known).sum() == 49
    assert not known[17:24, 27:34].any()
    np.testing.assert_allclose(
        holed.coefficients[known], whole.coefficients[known], atol=0.02 * image[~np.isnan(image)].std()
    )


def test_noise_between_pixels_is_as_stated(rng):
    noise = rng.normal(0, 1, (400, 400))
    picture = spline_of(noise)
    y, x = np.mgrid[5:390, 5:390]
    for at, (value, slope) in zip(
        (0.0, 0.25, 0.5), zip(*(share[[0, 32, 64]] for share in noise_shares(129)[:2]), strict=True), strict=True
    ):
        found, gradient = sample(picture, np.stack([x + at, y.astype(float)], axis=-1))
        # About 150 000 positions with correlated neighbours: an accuracy of 1 %.
        assert found.var() == pytest.approx(value, rel=0.02)
        assert gradient[..., 0].var() == pytest.approx(slope, rel=0.02)


@pytest.mark.parametrize("image", [np.zeros((5, 6, 3)), np.zeros((1, 9)), np.zeros((5, 6), complex)])
def test_an_image_that_is_not_grey_is_rejected(image):
    with pytest.raises(SettingProblem, match="A grey image has"):
        spline_of(image)
