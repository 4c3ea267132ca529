import numpy as np
import pytest

from marey.errors import FileProblem
from marey.io.calibration import read_rig, write_cameras_toml

CAMERA = """
[cam_0]
name = "left"
size = [ 640.0, 480.0]
matrix = [ [ 500.0, 0.0, 320.0], [ 0.0, 501.0, 240.0], [ 0.0, 0.0, 1.0]]
distortions = [ -0.1, 0.02, 0.001, -0.001]
rotation = [ 1.6, 0.1, -0.2]
translation = [ 0.1, 0.2, 3.0]
"""


def test_the_layout_of_pose2sim_and_anipose_is_read(tmp_path):
    other = CAMERA.replace("cam_0", "cam_1").replace("left", "right") + "fisheye = true\n"
    (tmp_path / "cameras.toml").write_text(CAMERA + other + "\n[metadata]\nadjusted = true\nerror = 0.0\n")
    rig = read_rig(tmp_path)
    assert rig.names == ("left", "right")
    assert rig["left"].size == (640, 480)
    assert not rig["left"].fisheye
    assert rig["right"].fisheye
    assert np.allclose(rig["left"].camera_from_world.rotation_vector, [1.6, 0.1, -0.2])


def test_what_is_written_is_read_back_to_the_last_bit(tmp_path, rng):
    (tmp_path / "Calib.toml").write_text(CAMERA + CAMERA.replace("cam_0", "b").replace("left", 'the \\"right\\" one'))
    rig = read_rig(tmp_path)
    write_cameras_toml(rig, tmp_path / "cameras.toml")
    again = read_rig(tmp_path / "cameras.toml")
    assert again.names == rig.names
    for old, new in zip(rig, again, strict=True):
        assert np.array_equal(old.matrix, new.matrix)
        assert np.array_equal(old.distortion, new.distortion)
        assert np.allclose(old.packed[:12], new.packed[:12], rtol=0, atol=1e-15)


def test_all_faults_of_a_file_are_told_at_once(tmp_path):
    wrong = CAMERA.replace("[ -0.1, 0.02, 0.001, -0.001]", "[-0.1, 0.02, 0.001]")
    missing = CAMERA.replace("cam_0", "b").replace('"left"', '"right"').replace("rotation", "rotated")
    shape = CAMERA.replace("cam_0", "c").replace('"left"', '"top"').replace("[ 0.1, 0.2, 3.0]", '"far"')
    (tmp_path / "cameras.toml").write_text(wrong + missing + shape)
    with pytest.raises(FileProblem) as caught:
        read_rig(tmp_path)
    message = str(caught.value)
    assert str(tmp_path / "cameras.toml") in message
    assert "camera 'left' has 3 lens numbers" in message
    assert "camera 'right' has no rotation" in message
    assert "camera 'top' needs a translation of 3 numbers" in message
    assert "Each camera is a table" in message


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[cam\n", "is not TOML"),
        ("", "has no camera"),
        (CAMERA + CAMERA.replace("cam_0", "cam_1"), "two cameras are called 'left'"),
        (CAMERA.replace("-0.001]", "nan]"), "a lens number that is not finite"),
        (CAMERA.replace("[ -0.1,", "[ -5.0,"), "folds back inside the picture"),
        (CAMERA.replace("640.0", "0.0"), "has the size 0 x 480"),
        (CAMERA + 'fisheye = "no"', "must be true or false"),
        (CAMERA + CAMERA.replace("cam_0", "b").replace("left", "b").replace("3.0]", "3000.0]"), "not in metres"),
    ],
)
def test_a_wrong_file_is_an_error_that_names_it(tmp_path, text, message):
    (tmp_path / "cameras.toml").write_text(text)
    with pytest.raises(FileProblem, match=message) as caught:
        read_rig(tmp_path)
    assert "cameras.toml" in str(caught.value)


def test_a_folder_without_a_calibration_is_told_what_to_put_there(tmp_path):
    with pytest.raises(FileProblem, match=r"holds no calibration.*Put cameras\.toml"):
        read_rig(tmp_path)
    with pytest.raises(FileProblem, match="does not exist"):
        read_rig(tmp_path / "nowhere")
