"""Texture channels: invariant under rotation, distinct for different textures, and their densities."""

import cv2
import numpy as np
import pytest

from marey.images.features.texture import (
    CELLS,
    CLASSES,
    root_tensor,
    smoothed_counts,
    texture_cells,
    texture_channels,
    texture_density,
)


def stripes(angle, *, period=8.0, contrast=50.0, size=96):
    y, x = np.mgrid[:size, :size]
    wave = np.sin(2 * np.pi / period * (x * np.cos(angle) + y * np.sin(angle)))
    return np.clip(np.rint(128 + contrast * wave), 0, 255).astype(np.uint8)[..., None].repeat(3, 2)


def as_matrices(tensor):
    return np.moveaxis(np.array([[tensor[0], tensor[2]], [tensor[2], tensor[1]]]), (0, 1), (-2, -1))


def test_the_squared_root_is_the_sum_of_outer_products(rng):
    image = rng.integers(0, 256, (12, 15, 3), dtype=np.uint8)
    gradients = [
        np.stack([cv2.Sobel(image[..., c].astype(float), -1, *d, scale=1 / 8) for d in ((1, 0), (0, 1))], -1)
        for c in range(3)
    ]
    tensor = sum(g[..., :, None] * g[..., None, :] for g in gradients)
    root = as_matrices(root_tensor(image))
    np.testing.assert_allclose(root @ root, tensor, rtol=1e-3, atol=0.05)


def test_the_tensor_of_a_turned_image_is_the_turned_tensor(rng):
    image = rng.integers(0, 256, (16, 20, 3), dtype=np.uint8)
    # A quarter turn takes (x, y) to (y, -x).
    turned = np.rot90(root_tensor(np.rot90(image)), -1, axes=(1, 2))
    np.testing.assert_allclose(turned, root_tensor(image)[[1, 0, 2]] * np.array([1, 1, -1])[:, None, None], atol=1e-3)


def test_the_channels_do_not_depend_on_the_orientation():
    inner = slice(24, -24)
    straight, oblique = (np.median(texture_channels(stripes(a))[:, inner, inner], (1, 2)) for a in (0.0, 0.6))
    np.testing.assert_allclose(oblique, straight, rtol=0.3)
    quarter = texture_channels(np.ascontiguousarray(np.rot90(stripes(0.6))))
    np.testing.assert_allclose(quarter, np.rot90(texture_channels(stripes(0.6)), axes=(1, 2)), rtol=1e-2, atol=1e-2)


def test_contrast_scale_and_coherence_measure_what_they_are_called(rng):
    inner = slice(24, -24)

    def channels(image):
        return np.median(texture_channels(image)[:, inner, inner], (1, 2))

    weak, strong = channels(stripes(0.3, contrast=15)), channels(stripes(0.3, contrast=60))
    assert strong[0] > 2 * weak[0]
    fine, coarse = channels(stripes(0.3, period=6)), channels(stripes(0.3, period=24))
    assert coarse[1] > 2 * fine[1]
    speckles = cv2.GaussianBlur(rng.normal(128, 120, (96, 96)), (0, 0), 1.5).clip(0, 255).astype(np.uint8)
    assert channels(stripes(0.3))[2] > 0.9 > 0.7 > channels(speckles[..., None])[2]


@pytest.mark.parametrize("shape", [(41, 57, 3), (40, 56, 1)])
def test_every_pixel_has_a_cell(rng, shape):
    cells = texture_cells(rng.integers(0, 256, shape, dtype=np.uint8))
    assert cells.shape == shape[:2]
    assert cells.max() < CELLS


def test_a_density_sums_to_one_and_is_uniform_without_pixels(rng):
    cells = texture_cells(rng.integers(0, 256, (40, 40, 3), dtype=np.uint8))
    np.testing.assert_allclose(texture_density(cells, rng.random((40, 40)) < 0.5).sum(), 1, rtol=1e-5)
    np.testing.assert_allclose(texture_density(cells, np.zeros((40, 40), bool)), 1 / CELLS)


def test_counts_are_smoothed_over_neighbouring_classes_only():
    counts = np.zeros(CLASSES, np.float32)
    counts[4, 2, 1] = 64
    smooth = smoothed_counts(counts.reshape(CELLS)).reshape(CLASSES)
    weights = np.array([1, 2, 1])
    np.testing.assert_allclose(smooth[3:6, 1:4, 0:3], weights[:, None, None] * weights[:, None] * weights)
    np.testing.assert_allclose(smooth.sum(), 64)
    edge = np.zeros(CELLS, np.float32)
    edge[0] = 8
    np.testing.assert_allclose(smoothed_counts(np.stack([edge, counts.ravel()])).sum(1), [8, 64])
