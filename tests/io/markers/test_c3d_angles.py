"""Joint angles as points of a C3D."""

import ezc3d
import numpy as np

from marey.io.markers.c3d import c3d_of_points, positions_in, read_c3d
from marey.io.markers.c3d_angles import add_angles, angle_points
from marey.io.opensim.trc import PointPaths

NAMES = ("left_knee_flexion", "left_knee_adduction", "left_knee_rotation", "left_toe_extension", "left_knee_plane")


def content(points: int = 2, frames: int = 4) -> ezc3d.c3d:
    places = np.random.default_rng(3).normal(size=(frames, points, 3))
    time = np.arange(frames) / 50.0
    return c3d_of_points(PointPaths(names=tuple(f"p{n}" for n in range(points)), time=time, rate=50.0, points=places))


def made_angles() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(4)
    return rng.normal(size=(4, 5)), rng.uniform(1, 2, (4, 5))


def test_angles_of_a_joint_are_one_point_and_a_second_set_has_its_own_label():
    angles, spread = made_angles()
    points = angle_points(NAMES, angles, spread)
    assert [point.label for point in points] == [
        "left_knee_angles", "left_knee_angles_sd", "left_toe_angles", "left_toe_angles_sd", "left_knee_plane_angles",
        "left_knee_plane_angles_sd",
    ]  # fmt: skip
    assert points[0].description == "x flexion, y adduction, z rotation"
    np.testing.assert_array_equal(points[0].values, angles[:, :3])
    np.testing.assert_array_equal(points[3].values, np.stack([spread[:, 3], 0 * spread[:, 3], 0 * spread[:, 3]], 1))


def test_angles_are_read_again_and_are_not_positions(tmp_path):
    c3d = content()
    angles, spread = made_angles()
    angles[2, 1] = np.nan
    add_angles(c3d, angle_points(NAMES, angles, spread))
    c3d.write(str(tmp_path / "a.c3d"))
    again = ezc3d.c3d(str(tmp_path / "a.c3d"))
    group = again["parameters"]["POINT"]
    at = group["LABELS"]["value"].index("left_knee_angles")
    assert group["ANGLES"]["value"][0] == "left_knee_angles"
    assert group["ANGLE_UNITS"]["value"] == ["deg"]
    assert group["DESCRIPTIONS"]["value"][at] == "x flexion, y adduction, z rotation"
    residuals = again["data"]["meta_points"]["residuals"][0, at]
    assert list(residuals < 0) == [False, False, True, False]  # An unknown component makes the point missing.
    np.testing.assert_allclose(again["data"]["points"][:3, at, [0, 1, 3]].T, angles[[0, 1, 3], :3], rtol=1e-6)
    labels, points, *_ = positions_in(again, "mm")
    assert labels == ["p0", "p1"]
    assert points.shape == (4, 2, 3)


def test_a_file_with_many_points_and_angles_of_another_program_keeps_them(tmp_path):
    c3d = content(points=254)
    angles, spread = made_angles()
    add_angles(c3d, angle_points(NAMES, angles, spread))
    c3d.write(str(tmp_path / "first.c3d"))
    again = ezc3d.c3d(str(tmp_path / "first.c3d"))
    add_angles(again, angle_points(NAMES[:1], 2 * angles[:, :1], spread[:, :1]))
    again.write(str(tmp_path / "second.c3d"))
    paths = read_c3d(tmp_path / "second.c3d")
    assert paths.names[254:] == (
        "left_knee_angles", "left_knee_angles_sd", "left_toe_angles", "left_toe_angles_sd", "left_knee_plane_angles",
        "left_knee_plane_angles_sd", "left_knee_angles_2", "left_knee_angles_sd_2",
    )  # fmt: skip
    np.testing.assert_allclose(1e3 * paths.points[:, 254, 0], angles[:, 0], rtol=1e-6)
    np.testing.assert_allclose(1e3 * paths.points[:, 260, 0], 2 * angles[:, 0], rtol=1e-6)
    listed = ezc3d.c3d(str(tmp_path / "second.c3d"))["parameters"]["POINT"]["ANGLES"]["value"]
    assert len(listed) == 8
