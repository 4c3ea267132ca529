import numpy as np
import pytest

from marey.knee.registration.covariance import bounded_stiffness, gradient_covariance, smoothed_normals


@pytest.mark.slow
def test_the_covariance_is_right_for_every_correlation_length(rng):
    places = rng.uniform(-30, 30, (900, 3)) * (1, 1, 0.2)
    jacobian = np.column_stack([places @ rng.normal(size=(3, 3)) / 20, rng.normal(size=(900, 3))])
    fitted = np.linalg.qr(jacobian)[0]
    apart = np.linalg.norm(places[:, None] - places, axis=2)
    for length in (0.0, 4.0):
        true = np.exp(-0.5 * (apart / length) ** 2) if length else np.eye(900)
        true = true + 1e-9 * np.eye(900)
        pulled = jacobian.T @ true @ jacobian
        half, diagonals = np.linalg.cholesky(true), []
        for _ in range(3):
            deviations = half @ rng.normal(size=900)
            left = deviations - fitted @ (fitted.T @ deviations)
            diagonals.append(np.diag(gradient_covariance(places, left, jacobian)))
        # Of smooth deviations a surface of 60 mm has few independent ones: one draw determines a variance to a third.
        ratio = np.mean(diagonals, 0) / np.diag(pulled)
        assert 0.6 < np.sqrt(ratio.mean()) < 1.6, length


def test_a_measured_stiffness_is_taken_within_bounds(rng):
    half = rng.normal(size=(6, 6)) * (1, 1, 1, 0.01, 0.01, 0.01)
    supposed = half.T @ half
    np.testing.assert_allclose(bounded_stiffness(0.7 * supposed, supposed), 0.7 * supposed)
    np.testing.assert_allclose(bounded_stiffness(-supposed, supposed), 0.2 * supposed)
    np.testing.assert_allclose(bounded_stiffness(50 * supposed, supposed), 2 * supposed)


def test_rough_normals_become_those_of_the_bone_beneath(rng):
    plane = np.column_stack([rng.uniform(-20, 20, (2500, 2)), np.zeros(2500)])
    rough = np.array([0, 0, 1.0]) + 0.3 * rng.normal(size=(2500, 3))
    rough /= np.linalg.norm(rough, axis=1, keepdims=True)
    smooth = smoothed_normals(plane, rough)
    # About 80 normals around each, of 0.3 rad: 0.04.
    assert np.median(np.hypot(*smooth[:, :2].T)) < 0.06
