"""Patterns of residuals over an image: radial, tangential, at one place, or none."""

import numpy as np
import pytest

from marey.arrays import Floats
from marey.calibration.quality.lens_pattern import LensPattern, lens_pattern

SIZE, CENTRE = (1280, 720), np.array([640.0, 360.0])


def pattern_of(kind: str, noise: float = 0.1) -> LensPattern:
    rng = np.random.default_rng(5)
    pixels = rng.uniform(0, 1, (6000, 2)) * SIZE
    x, y = (pixels - CENTRE).T / 640.0
    s = x * x + y * y
    errors: dict[str, Floats] = {
        "none": np.zeros_like(pixels),
        "radial": np.stack([x * (s - 0.7), y * (s - 0.7)], -1),
        "tangential": np.stack([2 * x * y, s + 2 * y * y], -1) * 0.4,
        "place": np.where(((x > 0.5) & (y < -0.2))[:, None], [0.8, 0.3], [0.0, 0.0]),
    }
    found = lens_pattern(
        pixels, errors[kind] + rng.normal(0, noise, pixels.shape), np.repeat(np.arange(120), 50), SIZE, CENTRE
    )
    assert found is not None
    return found


@pytest.mark.parametrize("kind", ["radial", "tangential", "place"])
def test_the_kind_of_a_pattern_is_recognised(kind: str):
    found = pattern_of(kind)
    assert found.kind == kind
    assert found.significance > 20
    assert found.amplitude_px > 0.1


def test_the_worst_part_of_the_image_is_named():
    assert pattern_of("place").worst == "top right"


def test_noise_alone_has_no_pattern():
    found = pattern_of("none")
    # The mean of a cell is known to 0.01 px; its square exceeds that of noise by chance by a few deviations at most.
    assert found.amplitude_px < 0.01
    assert found.significance < 4
