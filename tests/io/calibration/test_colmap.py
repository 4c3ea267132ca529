"""COLMAP's text files: its quaternions, its origin of pixels, and its lens models."""

import numpy as np
import pytest
from tests.rig_files import assert_same_pixels, made_rig, write_colmap

from marey.errors import FileProblem
from marey.io.calibration.readers import read_rig


def test_pixels_are_counted_from_the_centre_of_the_first_one(tmp_path):
    rig = made_rig()
    write_colmap(tmp_path, rig)
    assert_same_pixels(read_rig(tmp_path), rig)
    assert_same_pixels(read_rig(tmp_path / "images.txt"), rig)


def test_a_camera_is_named_like_the_folder_of_its_pictures(tmp_path):
    rig = made_rig()
    write_colmap(tmp_path, rig, pictures="{}/frame_0001.png")
    assert read_rig(tmp_path).names == rig.names


def test_pictures_without_points_have_an_empty_second_line(tmp_path):
    rig = made_rig()
    write_colmap(tmp_path, rig)
    path = tmp_path / "images.txt"
    path.write_text(path.read_text().replace("1.0 2.0 -1", ""))
    assert_same_pixels(read_rig(tmp_path), rig)


@pytest.mark.parametrize(
    ("line", "matrix", "lens", "fisheye"),
    [
        ("SIMPLE_PINHOLE 640 480 500 320 240", [500, 500], [], False),
        ("SIMPLE_RADIAL 640 480 500 320 240 -0.1", [500, 500], [-0.1, 0, 0, 0], False),
        ("RADIAL 640 480 500 320 240 -0.1 0.02", [500, 500], [-0.1, 0.02, 0, 0], False),
        ("FULL_OPENCV 640 480 500 501 320 240 .1 .02 .001 .002 .03 .1 .02 .03", [500, 501],
         [0.1, 0.02, 0.001, 0.002, 0.03, 0.1, 0.02, 0.03], False),
        ("OPENCV_FISHEYE 640 480 500 501 320 240 .01 .02 .001 .002", [500, 501], [0.01, 0.02, 0.001, 0.002], True),
        ("SIMPLE_RADIAL_FISHEYE 640 480 500 320 240 .01", [500, 500], [0.01, 0, 0, 0], True),
    ],
)  # fmt: skip
def test_lens_models_become_those_of_opencv(tmp_path, line, matrix, lens, fisheye):
    (tmp_path / "cameras.txt").write_text(f"7 {line}\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 3 7 left.jpg\n\n")
    camera = read_rig(tmp_path)["left"]
    assert np.allclose(np.diag(camera.matrix)[:2], matrix)
    assert np.allclose(camera.matrix[:2, 2], [319.5, 239.5])
    assert np.allclose(camera.distortion, lens)
    assert camera.fisheye is fisheye


@pytest.mark.parametrize(
    ("lenses", "poses", "message"),
    [
        ("1 FOV 640 480 500 501 320 240 1\n", "1 1 0 0 0 0 0 3 1 a.jpg\n\n", "has the lens model FOV"),
        ("1 PINHOLE 640 480 500 320 240\n", "1 1 0 0 0 0 0 3 1 a.jpg\n\n", "do not fit the lens model PINHOLE"),
        ("1 PINHOLE 640\n", "1 1 0 0 0 0 0 3 1 a.jpg\n\n", "has 3 fields in line 1"),
        ("1 PINHOLE 640 480 500 501 320 nan\n", "1 1 0 0 0 0 0 3 1 a.jpg\n\n", "not 3 x 3 finite numbers"),
        ("1 PINHOLE 640 480 500 501 320 240\n", "1 2 0 0 0 0 0 3 1 a.jpg\n\n", "needs a rotation"),
        ("1 PINHOLE 640 480 500 501 320 240\n", "1 1 0 0 0 0 0 x 1 a.jpg\n\n", "not a number"),
        ("1 PINHOLE 640 480 500 501 320 240\n", "1 1 0 0 0 0 0 3 2 a.jpg\n\n", "which cameras.txt does not have"),
        ("1 PINHOLE 640 480 500 501 320 240\n", "1 1 0 0 0 0 0 3 1\n\n", "has 9 fields in line 1"),
        ("1 PINHOLE 640 480 500 501 320 240\n", "1 1 0 0 0 0 0 3 1 ../a.jpg\n\n", "a name that is a path"),
        ("1 PINHOLE 640 480 500 501 320 240\n",
         "1 1 0 0 0 0 0 3 1 a/1.jpg\n\n2 1 0 0 0 0 0 4 1 a/2.jpg\n\n", "several poses of camera 'a'"),
        ("1 PINHOLE 640 480 500 501 320 240\n", "# none\n", "has no camera"),
    ],
)  # fmt: skip
def test_a_wrong_file_is_an_error_that_names_it(tmp_path, lenses, poses, message):
    (tmp_path / "cameras.txt").write_text(lenses)
    (tmp_path / "images.txt").write_text(poses)
    with pytest.raises(FileProblem, match=message) as caught:
        read_rig(tmp_path)
    assert "s.txt" in str(caught.value)


def test_both_files_are_needed(tmp_path):
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 640 480 500 501 320 240\n")
    with pytest.raises(FileProblem, match=r"images.txt: does not exist. Both"):
        read_rig(tmp_path)


def test_what_colmap_writes_is_read(tmp_path):
    """The corner of an image is (0, 0) in COLMAP, and the centre of its first pixel in marey."""
    pycolmap = pytest.importorskip("pycolmap")
    rig = made_rig()
    model = pycolmap.Reconstruction()
    for number, camera in enumerate(rig, 1):
        pose = camera.camera_from_world
        parameters = [*np.diag(camera.matrix)[:2], *(camera.matrix[:2, 2] + 0.5), *camera.distortion]
        lens = pycolmap.Camera(
            model="OPENCV", width=camera.width, height=camera.height, params=parameters, camera_id=number
        )
        model.add_camera_with_trivial_rig(lens)
        picture = pycolmap.Image(name=f"{camera.name}.jpg", camera_id=number, image_id=number)
        placed = pycolmap.Rigid3d(pycolmap.Rotation3d(pose.rotation), pose.translation)
        model.add_image_with_trivial_frame(picture, placed)
        point = pose.rotation @ np.array([0.1, 0.2, 0.3]) + pose.translation
        pixel = np.asarray(lens.img_from_cam(point[None])).ravel() - 0.5
        assert np.allclose(pixel, camera.project(np.array([0.1, 0.2, 0.3])), atol=1e-6)
    model.write_text(tmp_path)
    assert_same_pixels(read_rig(tmp_path), rig)
