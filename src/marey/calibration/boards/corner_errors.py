"""Standard deviations of corners from the grey values around them."""

import cv2
import numpy as np

from marey.arrays import Floats, Image

_LEAST_SD = 0.1
"""Smallest standard deviation of a corner [px]: corners that OpenCV finds in sharp pictures of the rendered session
lie 0.1
px from the true ones (median)."""
_GREATEST_SD = 3.0
"""Largest standard deviation of a corner [px]; one beyond is no corner. Chosen by hand."""
_LEAST_NOISE = 0.5
"""Smallest standard deviation of the image noise [grey levels]: that of rounding is 0.3. Chosen by hand."""
_LAPLACIAN = np.array([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]])
"""Difference of two Laplacians, which is zero on edges and planes ([Immerkaer1996])."""


def image_noise(grey: Image) -> float:
    """Estimate the standard deviation of the noise of an image ([Immerkaer1996], with the median for the mean).

    Args:
        grey: (H, W).

    Returns:
        In grey levels.
    """
    response = cv2.filter2D(grey, cv2.CV_32F, _LAPLACIAN)[1:-1:2, 1:-1:2]
    return max(float(np.median(np.abs(response))) / (0.6745 * 6.0), _LEAST_NOISE)


def corner_covariances(grey: Image, pixels: Floats, window: Floats, noise: float) -> Floats:
    """Return the covariances of corners: the noise variance times the inverse of the gradients' scatter.

    A corner whose edges are blurred has small gradients and a large covariance.

    Args:
        grey: (H, W).
        pixels: (n, 2) corners [px].
        window: (n,) half width of the window around each corner [px].
        noise: Standard deviation of the image noise [grey levels].

    Returns:
        (n, 2, 2) [px2]; NaN for corners without gradients around them.
    """
    out = np.full((len(pixels), 2, 2), np.nan)
    for k, (pixel, half) in enumerate(zip(pixels, window, strict=True)):
        size = 2 * int(np.ceil(half)) + 3
        patch = cv2.getRectSubPix(grey, (size, size), (float(pixel[0]), float(pixel[1])), patchType=cv2.CV_32F)
        gy, gx = np.gradient(patch.astype(float))
        inner = slice(1, -1)
        gradient = np.stack([gx[inner, inner].ravel(), gy[inner, inner].ravel()], axis=-1)
        scatter = gradient.T @ gradient
        if np.linalg.eigvalsh(scatter)[0] > noise**2 / _GREATEST_SD**2:
            out[k] = noise**2 * np.linalg.inv(scatter) + _LEAST_SD**2 * np.eye(2)
    return out
