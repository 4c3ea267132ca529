"""Total variation flow against an implicit step by a general solver, and the scale that its speed measures."""

import numpy as np
import pytest

from marey.images.features.tv_flow import FLAT, LARGEST_SCALE, diffusivity, local_scale, tv_flow


def plain_diffusivity(channels):
    """1 / |grad u|, with the mean square of the differences to both sides; none beyond the border."""
    total = np.full(channels.shape[1:], FLAT**2)
    for channel in channels:
        for axis in (0, 1):
            step = np.diff(channel, axis=axis) ** 2 / 2
            before, after = [(0, 0), (0, 0)], [(0, 0), (0, 0)]
            before[axis], after[axis] = (1, 0), (0, 1)
            total += np.pad(step, before) + np.pad(step, after)
    return 1 / np.sqrt(total)


def plain_step(channels, step):
    """The mean of an implicit step along the rows and one along the columns, by dense matrices."""
    conduct = plain_diffusivity(channels)

    def along_rows(rows, weights):
        result = np.empty_like(rows)
        for k, (row, g) in enumerate(zip(rows, weights, strict=True)):
            link = 2 * step * 0.5 * (g[1:] + g[:-1])
            matrix = np.eye(len(row)) - np.diag(link, 1) - np.diag(link, -1)
            matrix += np.diag(np.append(link, 0)) + np.diag(np.insert(link, 0, 0))
            result[k] = np.linalg.solve(matrix, row)
        return result

    return np.stack([0.5 * (along_rows(u, conduct) + along_rows(u.T, conduct.T).T) for u in channels])


@pytest.fixture
def channels(rng):
    return rng.normal(0, 20, (3, 14, 17)).astype(np.float32)


def test_the_diffusivity_is_the_reciprocal_of_the_gradient(channels):
    np.testing.assert_allclose(diffusivity(channels), plain_diffusivity(channels), rtol=1e-4)


def test_a_step_of_the_flow_is_that_of_a_general_solver(channels):
    expected = plain_step(plain_step(channels.astype(float), 3.0), 3.0)
    np.testing.assert_allclose(tv_flow(channels, step=3.0, steps=2), expected, atol=1e-3)


def test_the_flow_keeps_the_mean_and_leaves_its_input(channels):
    before = channels.copy()
    smooth = tv_flow(channels, step=8.0, steps=4)
    np.testing.assert_array_equal(channels, before)
    np.testing.assert_allclose(smooth.mean((1, 2)), channels.mean((1, 2)), atol=1e-3)
    assert smooth.std() < 0.6 * channels.std()


def test_the_flow_commutes_with_a_quarter_turn(channels):
    turned = tv_flow(np.rot90(channels, axes=(1, 2)), step=3.0, steps=3)
    np.testing.assert_allclose(turned, np.rot90(tv_flow(channels, step=3.0, steps=3), axes=(1, 2)), atol=1e-3)


def test_an_edge_stays_where_noise_of_the_same_gradient_energy_is_removed(rng):
    image = np.zeros((1, 40, 40), np.float32)
    image[0, :, 20:] = 100
    noisy = image + rng.normal(0, 4, image.shape).astype(np.float32)
    smooth = tv_flow(noisy, step=4.0, steps=4)[0]
    assert smooth[:, :18].std() < 1.0
    step = np.diff(smooth.mean(0))
    assert step.argmax() == 19
    assert step[19] > 60


def test_the_scale_of_a_sinusoid_increases_with_its_period():
    across = np.arange(128)
    scales = [
        np.median(local_scale(np.tile(128 + 50 * np.sin(2 * np.pi * across / period), (64, 1)), step=6.0, steps=5))
        for period in (4, 8, 16, 32)
    ]
    assert (np.diff(scales) > 0).all()
    assert scales[-1] > 4 * scales[0]


def test_an_image_without_structure_has_the_largest_scale():
    np.testing.assert_allclose(local_scale(np.full((9, 9), 77.0), step=6.0, steps=3), LARGEST_SCALE)
