import numpy as np
import pytest
import trimesh
from tests.surfaces import CAMERAS, no_points, some_points

from marey.errors import FileProblem
from marey.io.npz import read_arrays
from marey.io.shapes.measured_surface import read_surface, write_ply, write_surface


def test_a_written_surface_is_read_in_single_precision(tmp_path, rng):
    points = some_points(rng, [3, 3, 4, 9])
    write_surface(tmp_path / "surface.npz", [points.of_frame(frame) for frame in points.frames], CAMERAS)
    back = read_surface(tmp_path / "surface.npz")
    assert back.camera_names == CAMERAS
    for name, array in points.arrays().items():
        if array.dtype.kind == "f":
            np.testing.assert_allclose(back.arrays()[name], array, rtol=1e-7)
        else:
            np.testing.assert_array_equal(back.arrays()[name], array)


def test_the_file_has_the_documented_keys(tmp_path, rng):
    write_surface(tmp_path / "surface.npz", [some_points(rng, [0, 0])], CAMERAS)
    shapes = {name: array.shape for name, array in read_arrays(tmp_path / "surface.npz").items()}
    assert shapes == {
        "frame": (2,), "points": (2, 3), "covariance": (2, 3, 3), "camera_names": (3,), "pixels": (2, 3, 2),
        "correlation": (2, 3), "residual_px": (2,), "colour": (2, 3),
    }  # fmt: skip


@pytest.mark.parametrize("parts", [[], [no_points(CAMERAS)]])
def test_a_written_surface_without_points_is_read(tmp_path, parts):
    write_surface(tmp_path / "surface.npz", parts, CAMERAS)
    assert len(read_surface(tmp_path / "surface.npz")) == 0


def test_a_file_without_a_surface_is_rejected(tmp_path, rng):
    arrays = some_points(rng, [0, 0]).arrays()
    np.savez(tmp_path / "short.npz", **{**arrays, "residual_px": arrays["residual_px"][:1]})
    with pytest.raises(FileProblem, match=r"short\.npz: cannot be used: .*residual_px"):
        read_surface(tmp_path / "short.npz")
    np.savez(tmp_path / "other.npz", points=arrays["points"])
    with pytest.raises(FileProblem, match="lacks frame"):
        read_surface(tmp_path / "other.npz")


def test_other_programs_read_the_coloured_points(tmp_path, rng):
    points = some_points(rng, [0, 0, 1])
    write_ply(tmp_path / "surface.ply", points)
    cloud = trimesh.load(tmp_path / "surface.ply")
    np.testing.assert_allclose(cloud.vertices, points.points, atol=1e-6)
    np.testing.assert_array_equal(cloud.colors[:, :3], points.colour)
