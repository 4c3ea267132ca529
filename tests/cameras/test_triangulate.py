import numpy as np
import pytest

from marey.cameras.camera import Camera
from marey.cameras.triangulate import invert_normal, solve_normal, triangulate
from marey.geometry.rigid import RigidTransform

SIGMA_PX = 0.5


@pytest.fixture
def ring(make_camera) -> list[Camera]:
    """Four cameras 4 m from the origin, all looking at it."""
    cameras = []
    for number, angle in enumerate(np.deg2rad([0, 70, 150, 250])):
        centre = 4 * np.array([np.cos(angle), np.sin(angle), 0.3])
        forward = -centre / np.linalg.norm(centre)
        right = np.cross(forward, [0, 0, 1])
        right /= np.linalg.norm(right)
        rotation = np.array([right, np.cross(forward, right), forward])
        pose = RigidTransform(rotation, -rotation @ centre)
        cameras.append(make_camera(name=f"cam{number}", camera_from_world=pose))
    return cameras


def seen(cameras, points) -> np.ndarray:
    return np.stack([camera.project(points) for camera in cameras])


def triangulated_by_formula(cameras, pixels, sigma):
    """Points and covariances by ten Gauss-Newton steps of a plain formula, from the points nearest to all rays."""
    used = np.isfinite(pixels[..., 0])
    rays = np.where(
        used[..., None], np.stack([c.rays(p).directions for c, p in zip(cameras, pixels, strict=True)]), 0.0
    )
    across = used[..., None, None] * np.eye(3) - rays[..., :, None] * rays[..., None, :]
    right = np.einsum("cnij,cj->ni", across, [camera.centre for camera in cameras])
    points = np.linalg.solve(across.sum(axis=0), right[..., None])[..., 0]
    weights = np.where(used, 1 / sigma**2, 0.0)
    for _ in range(10):
        there, slope = (
            np.stack(each) for each in zip(*(c.project_with_derivative(points) for c in cameras), strict=True)
        )
        normal = np.einsum("cn,cnij,cnik->njk", weights, slope, slope)
        right = np.einsum("cn,cnij,cni->nj", weights, slope, np.where(used[..., None], pixels - there, 0.0))
        points = points + np.linalg.solve(normal, right[..., None])[..., 0]
    return points, np.linalg.inv(normal)


def test_points_are_those_of_the_formula(ring, rng):
    pixels = seen(ring, rng.uniform(-0.6, 0.6, (60, 3))) + rng.normal(size=(4, 60, 2))
    pixels[rng.integers(0, 4, 30), np.arange(30)] = np.nan
    sigma = rng.uniform(0.2, 2.0, (4, 60))
    found = triangulate(ring, pixels, sigma_px=sigma)
    points, covariance = triangulated_by_formula(ring, pixels, sigma)
    np.testing.assert_allclose(found.points, points, atol=1e-10)
    np.testing.assert_allclose(found.covariance, covariance, rtol=1e-7, atol=1e-13)


def test_exact_pixels_give_the_exact_point(ring, rng):
    points = rng.uniform(-0.6, 0.6, (50, 3))
    found = triangulate(ring, seen(ring, points), sigma_px=1.0)
    assert np.allclose(found.points, points, rtol=0, atol=1e-9)
    assert np.all(found.views == 4)
    assert found.residual_px.max() < 1e-6


@pytest.mark.parametrize("views", [2, 4])
def test_the_covariance_is_that_of_the_errors(ring, rng, views):
    cameras = ring[:views]
    n = 4000
    points = rng.uniform(-0.6, 0.6, (n, 3))
    pixels = seen(cameras, points) + rng.normal(scale=SIGMA_PX, size=(views, n, 2))
    found = triangulate(cameras, pixels, sigma_px=SIGMA_PX)
    error = found.points - points
    whitened = np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariance), error)
    # Chi square with three degrees of freedom has the mean 3 and the variance 6.
    assert abs(whitened.mean() - 3) < 3 * np.sqrt(6 / n)
    # The squared residuals that are left have the degrees of freedom of the system.
    left = (found.residual_px / SIGMA_PX) ** 2 * views
    freedom = 2 * views - 3
    assert abs(left.mean() - freedom) < 3 * np.sqrt(2 * freedom / n)


def test_a_less_certain_view_counts_less(ring, rng):
    points = rng.uniform(-0.5, 0.5, (20, 3))
    pixels = seen(ring, points)
    pixels[0] += 30.0
    sigma = np.ones((4, 20))
    equal = triangulate(ring, pixels, sigma_px=sigma)
    sigma[0] = 1000.0
    unequal = triangulate(ring, pixels, sigma_px=sigma)
    assert np.linalg.norm(unequal.points - points, axis=1).max() < 1e-4
    assert np.linalg.norm(equal.points - points, axis=1).min() > 1e-3


def test_what_the_views_do_not_fix_is_not_given(ring):
    pixels = seen(ring, np.zeros((3, 3)))
    pixels[1:, 0] = np.nan
    pixels[2:, 1] = np.nan
    pixels[:, 2] = np.nan
    found = triangulate(ring, pixels, sigma_px=1.0)
    assert found.views.tolist() == [1, 2, 0]
    assert np.isnan(found.points[[0, 2]]).all()
    assert np.isnan(found.covariance[[0, 2]]).all()
    assert np.allclose(found.points[1], 0, atol=1e-9)


def test_parallel_rays_and_points_behind_the_cameras_are_not_given(ring):
    twin = [ring[0], ring[0].moved(RigidTransform(np.eye(3), np.array([0.0, 0.1, 0.0])))]
    straight = twin[0].project(np.zeros((1, 3)))
    assert np.isnan(triangulate(twin, np.stack([straight, straight]), sigma_px=1.0).points).all()
    # Rays that diverge meet behind the cameras.
    aside = np.array([60.0, 0])
    outward = np.stack([straight - aside, straight + aside])
    inward = np.stack([straight + aside, straight - aside])
    found = [triangulate(twin, pixels, sigma_px=1.0).points for pixels in (outward, inward)]
    assert sorted(np.isnan(points).all() for points in found) == [False, True]


def made_normal(rng, eigenvalues):
    """Symmetric matrices with given eigenvalues (n, 3), in random directions."""
    turn = np.linalg.qr(rng.normal(size=(len(eigenvalues), 3, 3)))[0]
    return np.einsum("nij,nj,nkj->nik", turn, np.asarray(eigenvalues, float), turn)


def test_systems_of_three_unknowns_are_solved_and_inverted(rng):
    normal, right = made_normal(rng, 10.0 ** rng.uniform(-2, 4, (50, 3))), rng.normal(size=(50, 3))
    found, inverse = np.empty((50, 3)), np.empty((50, 3, 3))
    solve_normal(normal, right, 0.0, found)
    invert_normal(normal, inverse)
    # Condition numbers up to 1e6, at a precision of 1e-16.
    np.testing.assert_allclose(np.einsum("nij,nj->ni", normal, found), right, atol=1e-9)
    np.testing.assert_allclose(inverse, np.linalg.inv(normal), rtol=1e-8, atol=1e-10)


def test_a_system_with_a_small_eigenvalue_is_not_solved(rng):
    normal = made_normal(rng, [[2.0, 1.0, 0.99e-3], [2.0, 1.0, 1.01e-3], [2.0, 1.0, -1.0], [np.nan, 1.0, 1.0]])
    found, inverse = np.empty((4, 3)), np.empty((4, 3, 3))
    solve_normal(normal, np.ones((4, 3)), 1e-3, found)
    assert np.isfinite(found).all(axis=1).tolist() == [False, True, False, False]
    invert_normal(normal, inverse)
    assert np.isfinite(inverse).all(axis=(1, 2)).tolist() == [True, True, False, False]
