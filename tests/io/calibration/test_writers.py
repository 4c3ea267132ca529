"""Calibrations in the formats of other programs, read back by marey and by these programs."""

import cv2
import numpy as np
import pytest
from tests.rig_files import POINTS, assert_same_pixels, made_rig

from marey.cameras.camera import Camera
from marey.cameras.rig import Rig
from marey.errors import FileProblem, SettingProblem
from marey.geometry.rigid import RigidTransform
from marey.io.calibration.readers import read_rig, write_cameras_toml
from marey.io.calibration.writers import FORMATS, caliscope_numbers, write_rig

LENSES = [(), (-0.1, 0.03, 0.001, -0.002), (-0.1, 0.03, 0.001, -0.002, 0.01), (0.1, 0.02, 0, 0, 0, 0.1, 0.02, 0.01)]


@pytest.mark.parametrize("to", list(FORMATS))
@pytest.mark.parametrize("lens", LENSES, ids=len)
def test_what_is_written_is_read_back(tmp_path, to, lens):
    rig = made_rig(("cam_1", "cam_2", "cam_7"), lens=lens)
    files = write_rig(rig, tmp_path / "new", to=to)
    assert all(file.is_file() for file in files)
    assert_same_pixels(read_rig(files[0]), rig, tolerance=1e-9)


def test_a_file_that_exists_is_not_replaced(tmp_path):
    rig = made_rig()
    for to in ("pose2sim", "opencv"):
        files = write_rig(rig, tmp_path, to=to)
        before = [file.read_bytes() for file in files]
        with pytest.raises(FileProblem, match="already exists"):
            write_rig(made_rig(lens=()), tmp_path, to=to)
        assert [file.read_bytes() for file in files] == before


@pytest.mark.parametrize(
    ("to", "path", "message"),
    [
        ("theia", "a.json", "There is no format 'theia'; the formats are pose2sim"),
        ("opencv", "a.yml", r"has the files intri.yml and extri.yml: give a folder"),
    ],
)
def test_a_wrong_format_or_name_is_a_clear_error(tmp_path, to, path, message):
    with pytest.raises(SettingProblem, match=message):
        write_rig(made_rig(), tmp_path / path, to=to)
    assert list(tmp_path.iterdir()) == []


def test_a_fisheye_is_written_where_the_format_can_state_it(tmp_path):
    lens = np.array([0.02, 0.01, 0.001, 0.0005])
    rig = Rig(
        tuple(
            Camera(
                name=each.name, size=each.size, matrix=each.matrix, distortion=lens, fisheye=True,
                camera_from_world=each.camera_from_world,
            )
            for each in made_rig(("cam_1", "cam_2"))
        )
    )  # fmt: skip
    for to in ("pose2sim", "caliscope"):
        assert_same_pixels(read_rig(write_rig(rig, tmp_path, to=to)[0]), rig, tolerance=1e-9)
    with pytest.raises(SettingProblem, match="fisheye lens, which the YAML of OpenCV cannot state"):
        write_rig(rig, tmp_path, to="opencv")


def test_names_that_toml_cannot_hold_bare_are_quoted(tmp_path):
    names = ("links vorn", "é", "metadata", "the 'right' one", "links_vorn")
    rig = made_rig(names)
    write_cameras_toml(rig, tmp_path / "cameras.toml")
    assert_same_pixels(read_rig(tmp_path), rig, tolerance=1e-9)
    with pytest.raises(SettingProblem, match="'links vorn' cannot be written as YAML"):
        write_rig(rig, tmp_path, to="opencv")


@pytest.mark.parametrize(
    ("names", "numbers"),
    [(("cam01", "cam03"), [1, 3]), (("left", "right"), [0, 1]), (("a1", "b1"), [0, 1]), (("cam_0", "x"), [0, 1])],
)
def test_caliscope_gets_the_numbers_at_the_end_of_the_names(names, numbers):
    assert list(caliscope_numbers(names).values()) == numbers


def test_opencv_reads_what_is_written_as_easymocap_does(tmp_path):
    rig = made_rig()
    write_rig(rig, tmp_path, to="opencv")
    inner = cv2.FileStorage(str(tmp_path / "intri.yml"), cv2.FILE_STORAGE_READ)
    outer = cv2.FileStorage(str(tmp_path / "extri.yml"), cv2.FILE_STORAGE_READ)
    names = inner.getNode("names")
    assert [names.at(i).string() for i in range(names.size())] == list(rig.names)
    for camera in rig:
        matrix, lens = (inner.getNode(f"{key}_{camera.name}").mat() for key in ("K", "dist"))
        vector, shift = (outer.getNode(f"{key}_{camera.name}").mat() for key in ("R", "T"))
        assert int(inner.getNode(f"W_{camera.name}").real()) == camera.width
        pixels = cv2.projectPoints(POINTS, vector, shift, matrix, lens)[0].reshape(-1, 2)
        assert np.abs(pixels - camera.project(POINTS)).max() < 1e-9


def test_caliscope_reads_what_is_written_and_is_read(tmp_path):
    array = pytest.importorskip("caliscope.cameras.camera_array")
    rig = made_rig(("cam_1", "cam_2", "cam_7"))
    write_rig(rig, tmp_path, to="caliscope")
    cameras = array.CameraArray.from_toml(tmp_path / "camera_array.toml")
    assert cameras.all_extrinsics_calibrated()
    for number, camera in zip((1, 2, 7), rig, strict=True):
        theirs = cameras[number]
        vector = cv2.Rodrigues(theirs.rotation)[0]
        pixels = cv2.projectPoints(POINTS, vector, theirs.translation, theirs.matrix, theirs.distortions)[0]
        assert theirs.size == camera.size
        assert np.abs(pixels.reshape(-1, 2) - camera.project(POINTS)).max() < 1e-9
    cameras.to_toml(tmp_path / "again" / "camera_array.toml")
    assert_same_pixels(read_rig(tmp_path / "again"), rig)
    cameras.to_aniposelib_toml(tmp_path / "anipose" / "Calib.toml")
    assert_same_pixels(read_rig(tmp_path / "anipose"), rig)


def test_aniposelib_reads_what_is_written_and_is_read(tmp_path):
    library = pytest.importorskip("aniposelib.cameras")
    rig = made_rig()
    path = write_rig(rig, tmp_path, to="anipose")[0]
    group = library.CameraGroup.load(str(path))
    assert group.get_names() == list(rig.names)
    for theirs, camera in zip(group.cameras, rig, strict=True):
        assert np.abs(theirs.project(POINTS).reshape(-1, 2) - camera.project(POINTS)).max() < 1e-6
    group.dump(str(tmp_path / "Calib.toml"))
    assert_same_pixels(read_rig(tmp_path / "Calib.toml"), rig)


def test_pose2sim_computes_the_same_projections(tmp_path):
    common = pytest.importorskip("Pose2Sim.common")
    rig = made_rig(lens=())
    path = write_rig(rig, tmp_path, to="pose2sim")[0]
    for matrix, camera in zip(common.computeP(path), rig, strict=True):
        pixels = np.column_stack([POINTS, np.ones(len(POINTS))]) @ matrix.T
        assert np.abs(pixels[:, :2] / pixels[:, 2:] - camera.project(POINTS)).max() < 1e-9


def test_a_rotation_by_nearly_half_a_turn_is_kept(tmp_path):
    turn = np.diag([1.0, -1.0, -1.0])
    camera = made_rig(("cam_1",))["cam_1"]
    turned = Camera(
        name="cam_1", size=camera.size, matrix=camera.matrix, distortion=camera.distortion,
        camera_from_world=RigidTransform(turn, np.array([0.0, 0.0, 3.0])),
    )  # fmt: skip
    for to in FORMATS:
        files = write_rig(Rig((turned,)), tmp_path / to, to=to)
        assert_same_pixels(read_rig(files[0]), Rig((turned,)), tolerance=1e-6)
