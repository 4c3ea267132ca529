import cv2
import numpy as np
import pytest

from marey.cameras import lens
from marey.cameras.camera import Camera
from marey.errors import SettingProblem
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform

LENSES = {
    "none": ([], False),
    "radial": ([-0.3, 0.12, 1e-3, -2e-3], False),
    "radial, third order": ([-0.369, 0.203, 3e-4, 2e-5, -0.0712], False),
    "rational": ([2.1, 0.8, 1e-3, -5e-4, 0.05, 2.4, 1.3, 0.2], False),
    "thin prism": ([-0.2, 0.1, 1e-3, -2e-3, -0.01, 0.01, 0.02, 0.001, 2e-3, -1e-3, 1e-3, 3e-4], False),
    "fisheye": ([-0.02, 0.01, -0.004, 0.0005], True),
}


@pytest.fixture
def lens_camera(make_camera):
    def make(kind: str = "radial", **changes) -> Camera:
        distortion, fisheye = LENSES[kind]
        return make_camera(**({"distortion": distortion, "fisheye": fisheye} | changes))

    return make


def points_in_sight(camera: Camera, rng: np.random.Generator, n: int = 200) -> np.ndarray:
    spread = np.array([0.45, 0.35]) * rng.uniform(-1, 1, (n, 2))
    depth = rng.uniform(1, 8, (n, 1))
    return camera.camera_from_world.inverse().apply(np.hstack([spread * depth, depth]))


@pytest.mark.parametrize("kind", LENSES)
def test_the_projection_is_opencvs(lens_camera, kind, rng):
    camera = lens_camera(kind)
    points = points_in_sight(camera, rng)
    pose = camera.camera_from_world
    vectors = (pose.rotation_vector, pose.translation, camera.matrix)
    if camera.fisheye:
        theirs = cv2.fisheye.projectPoints(points[:, None], *vectors, camera.distortion)[0][:, 0]
    else:
        theirs = cv2.projectPoints(points, *vectors, camera.distortion)[0][:, 0]
    assert np.allclose(camera.project(points), theirs, rtol=0, atol=1e-9)


@pytest.mark.parametrize("kind", LENSES)
def test_the_derivative_is_the_change_of_the_pixel(lens_camera, kind, rng):
    camera = lens_camera(kind)
    points = points_in_sight(camera, rng)
    pixels, derivative = camera.project_with_derivative(points)
    assert np.allclose(pixels, camera.project(points), rtol=0, atol=1e-10)
    step = 1e-5
    for axis in range(3):
        change = np.eye(3)[axis] * step
        slope = (camera.project(points + change) - camera.project(points - change)) / (2 * step)
        assert np.allclose(derivative[:, :, axis], slope, rtol=1e-6, atol=1e-5)


def test_the_fisheye_is_smooth_on_its_axis(lens_camera):
    camera = lens_camera("fisheye", camera_from_world=RigidTransform.identity())
    for radius in (0.0, 0.9e-4, 1.1e-4):
        point = np.array([[radius, 0.5 * radius, 1.0]])
        _, derivative = camera.project_with_derivative(point)
        step = np.array([1e-6, 0, 0])
        slope = (camera.project(point + step) - camera.project(point - step)) / 2e-6
        assert np.allclose(derivative[:, :, 0], slope, atol=1e-4)


@pytest.mark.parametrize("kind", LENSES)
def test_undistorting_undoes_the_lens_over_the_whole_image(lens_camera, kind):
    camera = lens_camera(kind, size=(620, 460))
    grid = np.stack(np.meshgrid(np.linspace(0, 619, 32), np.linspace(0, 459, 24)), -1)
    straight = camera.undistort(grid)
    assert np.isnan(straight).mean() < 0.02
    back = camera.camera_from_world.inverse().apply(np.dstack([straight, np.ones(straight.shape[:2])]) * 3.0)
    error = np.abs(camera.project(back) - grid)
    assert np.nanmax(error) < 1e-7
    assert np.isnan(error).sum() == np.isnan(straight).sum()


def test_a_strong_lens_is_undone_up_to_where_it_folds_and_nothing_is_invented_beyond(lens_camera):
    camera = lens_camera("radial, third order", camera_from_world=RigidTransform.identity())
    radius = np.sqrt(camera.packed[lens.LIMIT])
    x = np.linspace(0, 0.999 * radius, 50)
    directions = np.column_stack([x, np.zeros(50), np.ones(50)])
    assert np.allclose(camera.undistort(camera.project(directions))[:, 0], x, rtol=0, atol=1e-9)
    beyond = np.column_stack([np.linspace(1.01, 5, 30) * radius, np.zeros(30), np.ones(30)])
    assert np.isnan(camera.project(beyond)).all()
    assert np.isnan(camera.project_with_derivative(beyond)[0]).all()
    farthest = camera.project(directions[-1:]).ravel()
    assert np.isnan(camera.undistort(farthest + np.array([5.0, 0.0]))).all()


def test_points_behind_the_camera_have_no_pixel(lens_camera):
    camera = lens_camera("none")
    behind = camera.camera_from_world.inverse().apply(np.array([[0.1, 0.1, -2.0], [0.1, 0.1, -1e-9], [0.1, 0.1, 2.0]]))
    assert np.isnan(camera.project(behind)[:2]).all()
    assert np.isfinite(camera.project(behind)[2]).all()
    assert np.isnan(camera.project_with_derivative(behind)[1][:2]).all()
    out = np.empty((3, 3))
    lens.project_points(camera.packed, behind, out)
    assert np.array_equal(out[:2, 2], [0.0, 0.0])
    assert out[2, 2] == pytest.approx(0.5)


@pytest.mark.parametrize("kind", LENSES)
def test_a_point_lies_on_the_ray_of_its_pixel(lens_camera, kind, rng):
    camera = lens_camera(kind)
    points = points_in_sight(camera, rng)
    rays = camera.rays(camera.project(points))
    assert rays.distances(points).max() < 1e-8
    assert rays.distances(camera.centre).max() < 1e-12
    assert np.all(np.sum(rays.directions * (points - camera.centre), axis=1) > 0)


@pytest.mark.parametrize("kind", LENSES)
def test_a_contour_plane_contains_the_tangent_and_its_positive_side_is_that_of_the_normal(lens_camera, kind, rng):
    camera = lens_camera(kind)
    points = points_in_sight(camera, rng)
    pixels = camera.project(points)
    angle = rng.uniform(0, 2 * np.pi, len(pixels))
    normals = np.column_stack([np.cos(angle), np.sin(angle)])
    tangents = np.column_stack([-normals[:, 1], normals[:, 0]])
    planes, offsets = camera.contour_planes(pixels, normals)
    assert np.allclose(np.linalg.norm(planes, axis=1), 1)
    assert np.allclose(planes @ camera.centre, offsets)
    assert np.abs(np.sum(planes * points, axis=1) - offsets).max() < 1e-8

    def distance(shift):
        directions = camera.rays(pixels + shift).directions
        return np.sum(planes * directions, axis=1)

    # Along the tangent the ray leaves the plane with the square of the step only; along the normal at once.
    assert np.abs(distance(1e-3 * tangents)).max() < 1e-3 * np.abs(distance(1e-3 * normals)).min()
    assert np.all(distance(1e-3 * normals) > 0)


@pytest.mark.parametrize("factor", [0.5, 0.25, 2.0])
def test_a_scaled_camera_sees_the_resized_image(lens_camera, factor, rng):
    camera = lens_camera("radial")
    points = points_in_sight(camera, rng)
    small = camera.scaled(factor)
    assert small.size == (640 * factor, 480 * factor)
    assert np.allclose(small.project(points), (camera.project(points) + 0.5) * factor - 0.5)


def test_a_moved_camera_sees_the_moved_points(lens_camera, rng):
    camera = lens_camera("radial")
    points = points_in_sight(camera, rng)
    motion = RigidTransform(rotations.exp(rng.normal(size=3)), rng.normal(size=3))
    assert np.allclose(camera.moved(motion).project(motion.apply(points)), camera.project(points))


def test_the_border_belongs_to_the_image(lens_camera):
    camera = lens_camera("none")
    pixels = np.array([[-0.5, -0.5], [-0.6, 0], [639.5, 479.5], [640, 0], [np.nan, 0]])
    assert camera.sees(pixels).tolist() == [True, False, True, False, False]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"distortion": [0.1, 0.2, 0.3]}, "has 3 distortion coefficients; a lens has 4"),
        ({"distortion": [0.1] * 5, "fisheye": True}, "a fisheye lens has 4"),
        ({"distortion": [0.1, np.nan, 0, 0]}, "not finite"),
        ({"distortion": [-3.0, 0, 0, 0]}, "not invertible"),
        ({"distortion": [5.0, 0, 0, 0]}, "implausible distortion"),
        ({"distortion": [-2.0, 0, 0, 0], "fisheye": True}, "not invertible"),
        ({"matrix": np.diag([-600.0, 600, 1])}, "must be positive"),
        ({"matrix": np.full((3, 3), 1.0)}, "not \\[\\[fx"),
        ({"size": (0, 480)}, "must be positive"),
    ],
)
def test_impossible_numbers_are_named(lens_camera, changes, message):
    with pytest.raises(SettingProblem, match=message) as caught:
        lens_camera("none", **changes)
    assert "cam01" in str(caught.value)


def test_the_arrays_of_a_camera_are_read_only(lens_camera):
    camera = lens_camera()
    for values in (camera.matrix, camera.distortion, camera.packed, camera.centre):
        with pytest.raises(ValueError, match="read-only"):
            values[...] = 0


@pytest.mark.parametrize("kind", LENSES)
def test_a_step_in_the_image_turns_the_ray_by_what_lies_between_its_ends(lens_camera, kind, rng):
    camera = lens_camera(kind)
    pixels = camera.project(points_in_sight(camera, rng, n=50))
    steps = rng.normal(size=(50, 2))
    ahead, behind = (camera.rays(pixels + s * steps).directions for s in (0.5, -0.5))
    turns = camera.ray_turns(pixels, steps)
    assert np.allclose(turns, np.linalg.norm(ahead - behind, axis=1), rtol=1e-9, atol=0)
