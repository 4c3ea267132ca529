import numpy as np

from marey.images.silhouettes.densities import RATIO_BINS, RATIO_RANGE, blended, colour_density, shadow_density, unknown


def test_a_density_of_colours_integrates_to_one(rng):
    image = rng.integers(0, 256, (30, 40, 3), dtype=np.uint8)
    region = rng.random((30, 40)) < 0.5
    assert np.isclose(colour_density(image, region).sum() * 8**3, 1, atol=1e-4)
    assert np.isclose(colour_density(image[..., :1], region).sum(), 1, atol=1e-4)


def test_the_cube_is_smoothed_like_a_separable_gaussian():
    image = np.full((4, 4, 3), 100, np.uint8)
    density = colour_density(image, np.ones((4, 4), bool)) * 8**3
    weights = np.exp(-(np.arange(-3, 4) ** 2) / 2)
    weights /= weights.sum()
    expected = np.zeros((32, 32, 32))
    expected[9:16, 9:16, 9:16] = weights[:, None, None] * weights[:, None] * weights
    assert np.allclose(density, expected, atol=1e-6)


def test_what_would_fall_over_the_edge_of_the_cube_stays_on_it(rng):
    image = rng.integers(0, 256, (40, 40, 3), dtype=np.uint8)
    density = colour_density(image, np.ones((40, 40), bool)) * 8**3
    weights = np.exp(-(np.arange(-3, 4) ** 2) / 2)
    weights /= weights.sum()
    expected = np.zeros((32, 32, 32))
    np.add.at(expected, tuple((image.reshape(-1, 3) >> 3).T), 1 / 1600)
    for axis in range(3):
        moved = np.zeros_like(expected)
        for shift, weight in zip(range(-3, 4), weights, strict=True):
            places = [np.arange(32)] * 3
            places[axis] = np.clip(np.arange(32) + shift, 0, 31)
            np.add.at(moved, np.ix_(*places), weight * expected)
        expected = moved
    assert np.allclose(density, expected, atol=1e-7)


def test_the_density_of_shadows_integrates_to_one_and_follows_what_is_seen(rng):
    width = (RATIO_RANGE[1] - RATIO_RANGE[0]) / RATIO_BINS
    seen = shadow_density(rng.normal(0.6, 0.02, 100000))
    assert np.isclose(unknown(3).shadow.sum() * width, 1, atol=1e-4)
    assert np.isclose(seen.sum() * width, 1, atol=1e-2)
    assert abs(RATIO_RANGE[0] + (seen.argmax() + 0.5) * width - 0.6) < 0.02


def test_an_empty_region_has_no_density():
    assert np.ptp(colour_density(np.zeros((4, 4, 3), np.uint8), np.zeros((4, 4), bool))) == 0


def test_blending_moves_by_its_share():
    one, other = unknown(1), blended(unknown(1), unknown(1), 0.3)
    assert np.allclose(one.person, other.person)
