import cv2
import numpy as np
import pytest
from tests.clips import write_video

from marey.errors import FileProblem
from marey.io.calibration.readers import read_rig, write_cameras_toml

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
    other = CAMERA.replace("cam_0", "cam_1").replace("left", "right").replace("3.0]", "3.1]") + "fisheye = true\n"
    more = "\n[metadata]\nadjusted = true\nerror = 0.0\n[ground]\nz = 0\n"
    (tmp_path / "cameras.toml").write_text(CAMERA + other + more)
    rig = read_rig(tmp_path)
    assert rig.names == ("left", "right")
    assert rig["left"].size == (640, 480)
    assert not rig["left"].fisheye
    assert rig["right"].fisheye
    assert np.allclose(rig["left"].camera_from_world.rotation_vector, [1.6, 0.1, -0.2])


def test_what_is_written_is_read_back_to_the_last_bit(tmp_path, rng):
    other = CAMERA.replace("cam_0", "b").replace("left", "the 'right' one").replace("3.0]", "3.1]")
    (tmp_path / "Calib.toml").write_text(CAMERA + other)
    rig = read_rig(tmp_path)
    write_cameras_toml(rig, tmp_path / "cameras.toml")
    again = read_rig(tmp_path / "cameras.toml")
    assert again.names == rig.names
    for old, new in zip(rig, again, strict=True):
        assert np.array_equal(old.matrix, new.matrix)
        assert np.array_equal(old.distortion, new.distortion)
        assert np.allclose(old.packed[:12], new.packed[:12], rtol=0, atol=1e-15)


def test_all_faults_of_a_file_are_reported_at_once(tmp_path):
    wrong = CAMERA.replace("[ -0.1, 0.02, 0.001, -0.001]", "[-0.1, 0.02, 0.001]")
    missing = CAMERA.replace("cam_0", "b").replace('"left"', '"right"').replace("rotation", "rotated")
    shape = CAMERA.replace("cam_0", "c").replace('"left"', '"top"').replace("[ 0.1, 0.2, 3.0]", '"far"')
    (tmp_path / "cameras.toml").write_text(wrong + missing + shape)
    with pytest.raises(FileProblem) as caught:
        read_rig(tmp_path)
    message = str(caught.value)
    assert str(tmp_path / "cameras.toml") in message
    assert "camera 'left' has 3 distortion coefficients" in message
    assert "camera 'right' has no rotation" in message
    assert "camera 'top' needs a translation of 3 numbers" in message
    assert "Each camera is a table" in message


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[cam\n", "is not TOML"),
        ("", "has no camera"),
        (CAMERA + CAMERA.replace("cam_0", "cam_1"), "has several cameras named 'left'"),
        (CAMERA.replace("-0.001]", "nan]"), "a distortion coefficient that is not finite"),
        (CAMERA.replace("[ -0.1,", "[ -5.0,"), "not invertible"),
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


def test_the_error_on_a_folder_without_calibration_names_the_formats(tmp_path):
    with pytest.raises(FileProblem, match=r"has no calibration.*Add cameras\.toml"):
        read_rig(tmp_path)
    with pytest.raises(FileProblem, match="does not exist"):
        read_rig(tmp_path / "nowhere")


CALISCOPE = """
[cameras.1]
cam_id = 1
rotation_count = 1
error = 0.3
size = [ 640, 480,]
matrix = [ [ 500.0, 0.0, 320.0,], [ 0.0, 501.0, 240.0,], [ 0.0, 0.0, 1.0,],]
distortions = [ -0.1, 0.02, 0.001, -0.001, 0.0,]
exposure = -5
grid_count = 20
ignore = false
translation = [ 0.1, 0.2, 3.0,]
rotation = [ 1.6, 0.1, -0.2,]

[cameras.2]
cam_id = 2
size = [ 640, 480,]
ignore = true
"""


def test_caliscopes_cameras_belong_to_the_images_as_they_are_stored(tmp_path):
    (tmp_path / "camera_array.toml").write_text(CALISCOPE)
    rig = read_rig(tmp_path)
    assert rig.names == ("cam_1",)
    assert rig["cam_1"].size == (640, 480)
    assert rig["cam_1"].matrix[1, 1] == 501.0
    matrix = cv2.Rodrigues(np.array([1.6, 0.1, -0.2]))[0]
    rows = str(matrix.tolist())
    (tmp_path / "camera_array.toml").write_text(CALISCOPE.replace("[ 1.6, 0.1, -0.2,]", rows))
    again = read_rig(tmp_path)
    assert np.allclose(again["cam_1"].packed, rig["cam_1"].packed)


def test_a_camera_that_caliscope_did_not_place_is_named(tmp_path):
    (tmp_path / "camera_array.toml").write_text(CALISCOPE.replace("ignore = true", "ignore = false"))
    with pytest.raises(FileProblem, match="camera 'cam_2' has no matrix and no distortions and no rotation"):
        read_rig(tmp_path)


def write_opencv_pair(folder, *, size: bool = True, skip: str = "", rodrigues_only: bool = False):
    inner = cv2.FileStorage(str(folder / "intri.yml"), cv2.FILE_STORAGE_WRITE)
    outer = cv2.FileStorage(str(folder / "extri.yml"), cv2.FILE_STORAGE_WRITE)
    names = ["01", "02"]
    for storage in (inner, outer):
        storage.startWriteStruct("names", cv2.FILE_NODE_SEQ)
        for name in names:
            storage.write("", name)
        storage.endWriteStruct()
    for number, name in enumerate(names):
        vector = np.array([[1.2], [0.3 * number], [-1.2]])
        values = {
            f"K_{name}": np.array([[60.0, 0, 32], [0, 61, 24], [0, 0, 1]]),
            f"dist_{name}": np.array([[-0.1, 0.02, 0.001, -0.001, 0.0]]),
        }
        pose = {
            f"R_{name}": vector,
            f"Rot_{name}": cv2.Rodrigues(vector)[0],
            f"T_{name}": np.array([[0.1], [0.2], [3.0]]),
        }
        for key, value in values.items():
            if key != skip:
                inner.write(key, value)
        for key, value in pose.items():
            if key != skip and not (rodrigues_only and key.startswith("Rot_")):
                outer.write(key, value)
        if size:
            inner.write(f"H_{name}", 48)
            inner.write(f"W_{name}", 64)
    inner.release()
    outer.release()


@pytest.mark.parametrize("rodrigues_only", [True, False])
def test_opencvs_yaml_pair_is_read(tmp_path, rodrigues_only):
    write_opencv_pair(tmp_path, rodrigues_only=rodrigues_only)
    rig = read_rig(tmp_path)
    assert rig.names == ("01", "02")
    assert rig["02"].size == (64, 48)
    assert rig["02"].matrix[1, 1] == 61
    assert len(rig["02"].distortion) == 5
    assert np.allclose(rig["02"].camera_from_world.rotation_vector, [1.2, 0.3, -1.2])
    assert np.allclose(rig["02"].camera_from_world.translation, [0.1, 0.2, 3.0])
    assert read_rig(tmp_path / "extri.yml").names == rig.names


def test_a_size_that_the_yaml_leaves_out_is_the_videos(tmp_path):
    write_opencv_pair(tmp_path, size=False)
    with pytest.raises(FileProblem, match=r"camera '01' has no W_01, no H_01 and no video.*camera '02'"):
        read_rig(tmp_path)
    write_video(tmp_path / "01.mp4", 2)
    write_video(tmp_path / "02.mp4", 2)
    assert read_rig(tmp_path)["01"].size == (64, 48)


def test_what_is_missing_in_the_yaml_pair_is_named(tmp_path):
    write_opencv_pair(tmp_path, skip="dist_02")
    with pytest.raises(FileProblem, match=r"intri.yml: camera '02' has no dist_02\. intri.yml should have names"):
        read_rig(tmp_path)
    (tmp_path / "extri.yml").unlink()
    with pytest.raises(FileProblem, match=r"extri.yml: does not exist. Both intri.yml and extri.yml are needed"):
        read_rig(tmp_path)
    (tmp_path / "intri.yml").write_text("names: [oh")
    (tmp_path / "extri.yml").write_text("")
    with pytest.raises(FileProblem, match="YAML"):
        read_rig(tmp_path)


QUALISYS = """<?xml version='1.0' encoding='ASCII'?>
<calibration><cameras>
<camera active="1" serial="21001" model="Miqus Video" viewrotation="0">
<fov_video left="32" top="16" right="1951" bottom="1095"/>
<fov_video_max left="0" top="0" right="1983" bottom="1111"/>
<transform x="{x}" y="{y}" z="{z}" {r}/>
<intrinsic focallength="9.3" sensorMinU="0" sensorMaxU="126975" sensorMinV="0" sensorMaxV="71167"
 focalLengthU="107520" focalLengthV="107584" centerPointU="64000" centerPointV="35200" skew="0"
 radialDistortion1="-0.046" radialDistortion2="0.14" radialDistortion3="0.01"
 tangentalDistortion1="0.0006" tangentalDistortion2="-0.0007"/>
</camera>
<camera active="0" serial="21002"/>
</cameras></calibration>
"""


def qualisys_text(centre_mm, axes) -> str:
    r = " ".join(f'r{i + 1}{j + 1}="{axes[i, j]:.9f}"' for i in range(3) for j in range(3))
    return QUALISYS.format(x=centre_mm[0], y=centre_mm[1], z=centre_mm[2], r=r)


def test_a_qualisys_camera_sees_points_in_front_of_it(tmp_path):
    # A camera 3 m along X and 1.5 m up that looks at the origin: its own axes are right, up and backward.
    centre = np.array([3.0, 0.0, 1.5])
    backward = centre / np.linalg.norm(centre)
    right = np.array([0.0, 1.0, 0.0])
    axes = np.array([right, np.cross(backward, right), backward])
    (tmp_path / "lab.qca.txt").write_text(qualisys_text(centre * 1000, axes))
    rig = read_rig(tmp_path)
    camera = rig["21001"]
    assert rig.names == ("21001",)
    assert camera.size == (1920, 1080)
    assert np.allclose(camera.centre, centre)
    assert np.allclose(camera.matrix, [[1680, 0, 968], [0, 1681, 534], [0, 0, 1]])
    assert np.allclose(camera.distortion, [-0.046, 0.14, 0.0006, -0.0007, 0.01])
    middle, left, above = camera.project(np.array([[0.0, 0, 0], [0, -0.2, 0], [0, 0, 0.2]]))
    assert np.allclose(middle, [968, 534])
    assert left[0] < 968
    assert above[1] < 534


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("<calibration>", "<calibration", "is not XML"),
        ('active="1"', 'active="0"', "has no active camera"),
        ('focalLengthU="107520"', "", "camera '21001' has no number for focalLengthU in <intrinsic>"),
        ("fov_video_max", "fov_other", "has no <fov_video_max>"),
        ('sensorMaxU="126975"', 'sensorMaxU="5000"', "units per pixel; 64 or 1"),
        ('r11="1.', 'r11="2.', "needs a rotation"),
    ],
)
def test_a_wrong_qualisys_file_is_rejected(tmp_path, old, new, message):
    text = qualisys_text((0, 0, 0), np.eye(3))
    assert old in text
    (tmp_path / "lab.qca.txt").write_text(text.replace(old, new))
    with pytest.raises(FileProblem, match=message):
        read_rig(tmp_path)


def test_the_error_on_an_unknown_format_names_the_known_ones(tmp_path):
    (tmp_path / "cameras.json").write_bytes(b"")
    with pytest.raises(FileProblem, match=r"not a calibration of a known format. The known formats are cameras.toml"):
        read_rig(tmp_path / "cameras.json")


def test_two_calibrations_in_a_folder_are_too_many(tmp_path):
    (tmp_path / "Calib_a.toml").write_text(CAMERA)
    (tmp_path / "Calib_b.toml").write_text(CAMERA)
    with pytest.raises(FileProblem, match=r"several calibrations \(Calib_a.toml, Calib_b.toml\)"):
        read_rig(tmp_path)


@pytest.mark.slow
def test_the_shared_calibrations_are_read_and_written(shared, tmp_path):
    for path in sorted((shared / "data").glob("*/*/*ameras.toml")):
        rig = read_rig(path)
        write_cameras_toml(rig, tmp_path / "cameras.toml")
        again = read_rig(tmp_path)
        assert np.allclose(again.packed[:, :32], rig.packed[:, :32], rtol=1e-14, atol=1e-14)
