import numpy as np
import pytest

from marey.cameras.epipolar import EpipolarPlanes, epipolar_lines
from marey.geometry.rigid import RigidTransform


@pytest.fixture
def cameras(make_camera):
    beside = RigidTransform.from_vector(np.array([0.0, 0.2, 0.03]), np.array([-0.6, 0.02, 0.1]))
    first = make_camera()
    return first, make_camera(name="cam02", camera_from_world=beside @ first.camera_from_world)


def points_before(camera, rng, count=100):
    depth = rng.uniform(2, 5, (count, 1))
    straight = np.array([0.3, 0.25]) * rng.uniform(-1, 1, (count, 2))
    return camera.camera_from_world.inverse().apply(np.hstack([straight * depth, depth]))


def lines_by_formula(first, second, pixels, starts):
    """Tangents of all epipolar lines at once."""
    ray, other = first.rays(pixels).directions, second.rays(starts).directions
    baseline, cosine = second.centre - first.centre, np.sum(ray * other, axis=-1)
    depth = (ray @ baseline - cosine * (other @ baseline)) / (1 - cosine**2)
    depth = np.where(depth > 0, depth, np.nan)
    points, derivative = second.project_with_derivative(first.centre + depth[:, None] * ray)
    along = np.einsum("nij,nj->ni", derivative, ray)
    return points, along / np.linalg.norm(along, axis=1, keepdims=True)


def test_lines_are_those_of_the_formula(cameras, rng):
    first, second = cameras
    pixels, starts = (rng.uniform(0, 1, (200, 2)) * camera.size for camera in cameras)
    expected = lines_by_formula(first, second, pixels, starts)
    assert 20 < np.isnan(expected[0][:, 0]).sum() < 180
    for found, wanted in zip(epipolar_lines(first, second, pixels, starts), expected, strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-9)


def test_a_point_lies_on_the_line_that_starts_beside_it(cameras, rng):
    first, second = cameras
    points = points_before(first, rng)
    truth = second.project(points)
    on_line, along = epipolar_lines(first, second, first.project(points), truth + rng.uniform(-3, 3, truth.shape))
    seen = np.isfinite(truth).all(-1)
    beside = (truth - on_line)[seen]
    across = beside[:, 0] * along[seen, 1] - beside[:, 1] * along[seen, 0]
    np.testing.assert_allclose(across, 0, atol=0.01)
    np.testing.assert_allclose(np.linalg.norm(along[seen], axis=-1), 1, atol=1e-12)


def test_the_tangent_leaves_the_curve_little_in_ten_pixels(cameras, rng):
    first, second = cameras
    points = points_before(first, rng)
    pixels = first.project(points)
    on_line, along = epipolar_lines(first, second, pixels, second.project(points))
    further, _ = epipolar_lines(first, second, pixels, on_line + 10 * along)
    beside = further - on_line
    across = beside[:, 0] * along[:, 1] - beside[:, 1] * along[:, 0]
    assert np.nanmax(np.abs(across)) < 0.02


def test_depth_grows_in_the_direction_of_the_line(cameras, rng):
    first, second = cameras
    points = points_before(first, rng)
    _, along = epipolar_lines(first, second, first.project(points), second.project(points))
    away = second.project(points + 1e-4 * (points - first.centre)) - second.project(points)
    seen = np.isfinite(away).all(-1)
    assert (np.sum(away * along, axis=-1)[seen] > 0).all()


def test_rays_that_do_not_meet_before_the_camera_give_no_line(cameras):
    first, second = cameras
    middle = np.array([[320.0, 240.0]])
    behind = first.centre - 3 * first.rays(middle).directions
    start = np.array([[20.0, 240.0], [620.0, 240.0]])
    on_line, along = epipolar_lines(first, second, np.repeat(middle, 2, 0), start)
    assert np.isnan(second.project(behind)).all()
    assert np.isnan(on_line).all(-1).any()
    np.testing.assert_array_equal(np.isnan(on_line), np.isnan(along))
    same, _ = epipolar_lines(first, first, middle, middle)
    assert np.isnan(same).all()


def test_a_point_is_in_the_same_epipolar_plane_for_both_cameras(cameras, rng):
    first, second = cameras
    planes = EpipolarPlanes.between(first, second)
    points = points_before(first, rng)
    seen = np.isfinite(first.project(points) + second.project(points)).all(-1)
    angles = [planes.angles(c.rays(c.project(points[seen])).directions)[0] for c in cameras]
    np.testing.assert_allclose(angles[0], angles[1], atol=1e-9)
    assert np.ptp(angles[0]) > 0.1
    beside = planes.angles(second.rays(second.project(points[seen] + [0, 0, 0.1])).directions)[0]
    assert np.abs(beside - angles[0]).max() > 0.01


def test_the_plane_of_a_ray_turns_faster_near_the_baseline(cameras):
    planes = EpipolarPlanes.between(*cameras)
    slant = np.array([0.1, 0.8, 1.5])
    rays = np.cos(slant)[:, None] * planes.axis + np.sin(slant)[:, None] * planes.zero
    across = np.cross(planes.axis, planes.zero)
    angle, lever = planes.angles(rays)
    turned, _ = planes.angles(rays + 1e-6 * across)
    np.testing.assert_allclose(angle, 0, atol=1e-12)
    np.testing.assert_allclose((turned - angle) * lever, 1e-6, rtol=1e-4)


def test_cameras_in_one_place_have_no_epipolar_planes(cameras):
    assert EpipolarPlanes.between(cameras[0], cameras[0]) is None
