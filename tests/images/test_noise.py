import numpy as np
import pytest

from marey.images.noise import ROUNDING, noise_of


@pytest.mark.parametrize("sd", [1.0, 2.5])
def test_white_noise_is_found_beside_texture(rng, sd):
    image = 120 + rng.normal(0, sd, (160, 200))
    image[:, 80:] += 60 * np.sign(np.sin(np.arange(120) * 1.3))
    found = noise_of(np.clip(np.round(image), 0, 255).astype(np.uint8))
    # The noise of the quietest blocks is underestimated by a few per cent.
    assert found == pytest.approx(np.hypot(sd, ROUNDING), rel=0.15)


def test_an_image_has_at_least_the_noise_of_rounding():
    assert noise_of(np.full((64, 64), 255, np.uint8)) == ROUNDING
    assert noise_of(np.zeros((5, 5), np.uint8)) == ROUNDING
    gradient = np.tile(np.arange(64, dtype=np.uint8), (64, 1))
    assert noise_of(gradient) == ROUNDING
