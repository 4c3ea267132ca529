"""The compiled registration against plain formulas."""

import numpy as np
import pytest

from marey.calibration.boards import registration_kernels as kernels


def plain_cubic(grey: np.ndarray, x: float, y: float) -> float:
    """Catmull and Rom's cubic by its definition."""

    def weight(distance: float) -> float:
        d = abs(distance)
        if d < 1:
            return 1.5 * d**3 - 2.5 * d**2 + 1
        return -0.5 * d**3 + 2.5 * d**2 - 4 * d + 2 if d < 2 else 0.0

    ix, iy = int(np.floor(x)), int(np.floor(y))
    return sum(weight(x - i) * weight(y - j) * grey[j, i] for i in range(ix - 1, ix + 3) for j in range(iy - 1, iy + 3))


def test_a_patch_is_interpolated_by_the_cubic():
    grey = np.random.default_rng(0).integers(0, 255, (20, 24), np.uint8)
    out = np.empty((5, 6))
    kernels.moved_patch(grey, 7, 6, 0.37, -1.21, out)
    for i in range(5):
        for j in range(6):
            assert out[i, j] == pytest.approx(plain_cubic(grey, 7 + j + 0.37, 6 + i - 1.21), abs=1e-9)


def test_the_shift_of_a_smooth_pattern_is_recovered_with_its_covariance():
    rng = np.random.default_rng(2)
    y, x = np.mgrid[0:60, 0:70].astype(float)

    def pattern(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        return np.sin(0.5 * u) * np.cos(0.4 * v) + 0.4 * np.sin(0.3 * u + 0.5 * v)

    model, shift, gain, noise = pattern(x, y), np.array([0.62, -0.41]), 60.0, 1.5
    place = np.stack([x, y], -1)
    slope_y, slope_x = np.gradient(model)
    boxes = np.array([[20, 18, 42, 40], [0, 0, 1, 1]])
    scaled = []
    for _ in range(40):
        grey = 120 + gain * pattern(x - shift[0], y - shift[1]) + rng.normal(0, noise, x.shape)
        out = np.empty((2, 7))
        kernels.register_corners(
            np.round(grey).astype(np.uint8), model, slope_x, slope_y, place, np.ones(x.shape, bool), np.array([0, 0]),
            boxes, np.array([[31.0, 29.0], [0.0, 0.0]]), 9.5, np.zeros(2), 3.0, out,
        )  # fmt: skip
        apart = out[0, kernels.SHIFT_X : kernels.SHIFT_Y + 1] - shift
        covariance = np.array([[out[0, 4], out[0, 5]], [out[0, 5], out[0, 6]]])
        scaled.append(apart @ np.linalg.solve(covariance, apart) / 2)
        assert np.isnan(out[1]).all()
    # Interpolation smooths the noise of the residuals, for which the registration allows by a factor of two.
    assert 0.5 < np.mean(scaled) / 2 < 1.7


def test_slopes_are_those_of_numpy():
    image = np.random.default_rng(4).normal(0, 1, (7, 9))
    along_x, along_y = np.empty(image.shape), np.empty(image.shape)
    kernels.slopes_of(image, along_x, along_y)
    rows, columns = np.gradient(image)
    np.testing.assert_allclose(along_x, columns, atol=1e-14)
    np.testing.assert_allclose(along_y, rows, atol=1e-14)


def test_the_equations_of_shift_and_blur_are_those_of_the_derivatives():
    rng = np.random.default_rng(5)
    model, part = rng.normal(0, 1, (8, 11)), rng.normal(0, 1, (8, 11))
    inner = rng.random(model.shape) < 0.7
    down, across = np.gradient(model)
    columns = [model, np.ones_like(model), -across, -down, 0.5 * np.gradient(across, axis=1), np.gradient(down, axis=1),
               0.5 * np.gradient(down, axis=0)]  # fmt: skip
    table = np.stack([each[inner] for each in columns])
    normal, right = np.empty((7, 7)), np.empty(7)
    kernels.blur_equations(model, part, inner, normal, right)
    np.testing.assert_allclose(normal, table @ table.T, atol=1e-12)
    np.testing.assert_allclose(right, table @ part[inner], atol=1e-12)
