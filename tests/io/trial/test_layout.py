"""Folders as other programs make them are trials."""

import pickle

import cv2
import numpy as np
import pytest
from tests.clips import SIZE, calibration_text, numbered_picture, turn_by_metadata, write_video
from tests.rig_files import made_rig, opencap_table

from marey.cameras.camera import Camera
from marey.errors import FileProblem
from marey.io.calibration.opencap import FILE_NAME
from marey.io.calibration.writers import write_rig
from marey.io.trial.layout import find_layout
from marey.io.trial.trial import read_free_trial, read_trial
from marey.pipelines.convert_cameras import read_scaled

NAMES = ("cam01", "cam02")


def write_videos(folder, names=NAMES, suffix=".mp4", count=4):
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        write_video(folder / f"{name}{suffix}", count)


def pose2sim(folder, *, names=NAMES, videos=NAMES):
    (folder / "calibration").mkdir(parents=True)
    (folder / "calibration" / "Calib_scene.toml").write_text(calibration_text(names))
    (folder / "Config.toml").write_text("[project]\nmulti_person = false\n")
    write_videos(folder / "videos", videos)
    return folder


def test_a_project_of_pose2sim_is_a_trial(tmp_path):
    folder = pose2sim(tmp_path / "project", videos=("CAM01", "CAM02"))
    trial = read_trial(folder)
    assert trial.calibration == folder / "calibration" / "Calib_scene.toml"
    assert [clip.path.name for clip in trial.take.clips] == ["CAM01.mp4", "CAM02.mp4"]
    assert trial.keypoints is None
    assert trial.folder == folder
    assert find_layout(folder).program == "Pose2Sim"


def test_a_trial_of_a_pose2sim_batch_has_its_calibration_above(tmp_path):
    root = pose2sim(tmp_path / "batch")
    for name in ("Trial_1", "Trial_2"):
        write_videos(root / name / "videos", count=6)
        (root / name / "Config.toml").write_text("")
    for video in (root / "videos").iterdir():
        video.unlink()
    trial = read_trial(root / "Trial_2")
    assert trial.calibration.parent == root / "calibration"
    assert trial.take.count == 6
    with pytest.raises(FileProblem, match=r"the recordings Trial_1, Trial_2. Give one of them, for example .*Trial_1"):
        read_trial(root)


def test_the_joints_that_pose2sim_detected_are_used(tmp_path):
    folder = pose2sim(tmp_path / "project", names=("21001", "21002"))
    for name in NAMES:
        (folder / "pose" / f"{name}_json").mkdir(parents=True)
        (folder / "pose" / f"{name}_json" / f"{name}_000000.json").write_text('{"people": []}')
    trial = read_free_trial(folder)
    assert trial.keypoints == folder / "pose"
    assert trial.file_names == {"21001": ("21001", "cam01"), "21002": ("21002", "cam02")}
    assert "check it: 21001 cam01.mp4, 21002 cam02.mp4" in trial.take.notes[0]


def test_background_and_masks_may_have_the_name_of_the_video(tmp_path):
    folder = pose2sim(tmp_path / "project", names=("21001", "21002"))
    write_videos(folder / "background", ("CAM01", "21002"), count=1)
    trial = read_trial(folder)
    assert {name: clip.path.stem for name, clip in trial.background.items()} == {"21001": "CAM01", "21002": "21002"}


def caliscope_text(names=("cam_0", "cam_1"), size=SIZE):
    tables = calibration_text(names, size)
    for name in names:
        number = name[-1]
        tables = tables.replace(f'[{name}]\nname = "{name}"', f"[cameras.{number}]\ncam_id = {number}")
    return tables


def caliscope(folder, recordings=("walk",), videos=("cam_0", "cam_1")):
    folder.mkdir()
    (folder / "camera_array.toml").write_text(caliscope_text())
    for recording in recordings:
        write_videos(folder / "recordings" / recording, videos)
    return folder


@pytest.mark.parametrize("videos", [("cam_0", "cam_1"), ("port_0", "port_1")])
def test_a_recording_of_caliscope_is_a_trial(tmp_path, videos):
    folder = caliscope(tmp_path / "project", videos=videos)
    (folder / "recordings" / "walk" / "timestamps.csv").write_text(
        "cam_id,frame_time\n" + "".join(f"{camera},{0.04 * number}\n" for number in range(4) for camera in (0, 1))
    )
    for given in (folder, folder / "recordings" / "walk"):
        trial = read_trial(given)
        assert trial.folder == folder / "recordings" / "walk"
        assert trial.calibration == folder / "camera_array.toml"
        assert trial.take.names == ("cam_0", "cam_1")


def test_an_older_project_of_caliscope_has_its_cameras_in_config_toml(tmp_path):
    folder = caliscope(tmp_path / "project", videos=("port_0", "port_1"))
    (folder / "camera_array.toml").unlink()
    text = calibration_text(("cam_0", "cam_1"))
    for number in (0, 1):
        text = text.replace(f'name = "cam_{number}"', f"port = {number}\nignore = false")
    (folder / "config.toml").write_text(text + "\n[charuco]\ncolumns = 4\n")
    trial = read_trial(folder)
    assert trial.calibration == folder / "config.toml"
    assert trial.take.names == ("cam_0", "cam_1")


def test_the_recordings_of_a_caliscope_project_are_named(tmp_path):
    folder = caliscope(tmp_path / "project", recordings=("walk", "run"))
    with pytest.raises(FileProblem, match=r"has the recordings run, walk. Give one of them"):
        read_trial(folder)
    assert read_trial(folder / "recordings" / "run").take.count == 4
    empty = caliscope(tmp_path / "empty", recordings=())
    (empty / "recordings").mkdir()
    with pytest.raises(FileProblem, match="has no recording"):
        read_trial(empty)


def test_the_calibration_of_caliscope_belongs_to_the_stored_images(tmp_path):
    folder = caliscope(tmp_path / "project")
    turn_by_metadata(folder / "recordings" / "walk" / "cam_1.mp4", 2)
    trial = read_trial(folder)
    assert "not rotated as their containers state" in trial.take.notes[0]


def test_a_recording_of_freemocap_is_in_metres(tmp_path):
    folder = tmp_path / "recording"
    write_videos(folder / "synchronized_videos")
    text = calibration_text(NAMES).replace("[ 0.1, 0.2, 3.0]", "[ 100.0, 200.0, 3000.0]")
    path = folder / "recording_camera_calibration.toml"
    path.write_text(text + "[metadata]\ncharuco_square_size = 39\ngroundplane_calibration = false\n")
    trial = read_trial(folder)
    assert np.allclose(trial.rig["cam01"].camera_from_world.translation, [0.1, 0.2, 3.0])
    assert find_layout(folder).program == "FreeMoCap"
    path.write_text(text + "[metadata]\ncharuco_square_size = 1\n")
    with pytest.raises(FileProblem, match="squares of size 1, so its unit of length is not known"):
        read_trial(folder)


BOARD_FROM_WORLD = {
    "backWall": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "backWall_largeCB": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "ground": np.eye(3),
    "ground_jumps": np.diag([1.0, -1, -1]),
}


def opencap(folder, *, recordings=("walk",), placement="backWall", metadata=""):
    turn = BOARD_FROM_WORLD[placement]
    for camera in made_rig(("Cam0", "Cam1"), lens=()):
        small = Camera(
            name=camera.name, size=SIZE, matrix=np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]),
            distortion=np.zeros(0), camera_from_world=camera.camera_from_world,
        )  # fmt: skip
        place = folder / "Videos" / camera.name
        for recording in ("calibration", *recordings):
            write_videos(place / "InputMedia" / recording, ("7f3a-uuid",), suffix=".mov")
        (place / FILE_NAME).write_bytes(pickle.dumps(opencap_table(small, turn)))
    text = f"checkerBoard:\n  placement: {placement}\n  squareSideLength_mm: 35.0\nheight_m: 1.78\nmass_kg: 70.5\n"
    (folder / "sessionMetadata.yaml").write_text(text + metadata)
    return folder


@pytest.mark.parametrize("placement", list(BOARD_FROM_WORLD))
def test_a_session_of_opencap_is_a_trial_with_z_up(tmp_path, placement):
    folder = opencap(tmp_path / "session", placement=placement)
    trial = read_trial(folder)
    assert trial.rig.names == ("Cam0", "Cam1")
    assert (trial.settings.stature_m, trial.settings.mass_kg) == (1.78, 70.5)
    truth = made_rig(("Cam0", "Cam1"))
    assert np.allclose([camera.centre[2] for camera in trial.rig], [camera.centre[2] for camera in truth])
    assert not trial.up_given
    for given in (folder, folder / "Videos"):
        converted = read_scaled(given, 1.0)
        assert np.allclose(converted.centres, trial.rig.centres)


def test_all_files_of_a_calibration_are_inputs(tmp_path):
    session = read_trial(opencap(tmp_path / "session"))
    assert sum(path.name == FILE_NAME for path in session.input_files) == 2
    folder = tmp_path / "sequence"
    write_rig(read_trial(pose2sim(tmp_path / "project")).rig, folder, to="easymocap")
    write_videos(folder / "videos")
    trial = read_trial(folder)
    assert trial.take.names == NAMES
    assert {"intri.yml", "extri.yml"} <= {path.name for path in trial.input_files}


def test_stills_beside_their_calibration_have_priority_over_a_folder_of_videos(tmp_path):
    (tmp_path / "cameras.toml").write_text(calibration_text(NAMES))
    for name in NAMES:
        cv2.imwrite(str(tmp_path / f"{name}_1.png"), numbered_picture(1))
    write_videos(tmp_path / "videos", ("overlay",))
    assert read_trial(tmp_path).take.count == 1


def test_a_recording_of_a_session_is_named_after_it(tmp_path):
    folder = opencap(tmp_path / "session", recordings=("neutral", "walk"))
    with pytest.raises(FileProblem, match=r"has the recordings neutral, walk. Give one of them, for example .*neutral"):
        read_trial(folder)
    trial = read_trial(folder / "walk")
    assert all("walk" in str(clip.path) for clip in trial.take.clips)
    assert trial.folder == folder / "walk"
    assert not (folder / "walk").exists()
    with pytest.raises(FileProblem, match=r"not a recording of the OpenCap session. The recordings are neutral, walk"):
        read_trial(folder / "run")
    (folder / "walk").mkdir()
    (folder / "walk" / "trial.toml").write_text("stature_m = 1.9\n")
    assert read_trial(folder / "walk").settings.stature_m == 1.9


def test_the_video_that_opencap_synchronised_is_used(tmp_path):
    folder = opencap(tmp_path / "session")
    for name in ("Cam0", "Cam1"):
        write_videos(folder / "Videos" / name / "InputMedia" / "walk", ("walk_sync",), count=9)
    assert read_trial(folder).take.count == 9
    write_videos(folder / "Videos" / "Cam0" / "InputMedia" / "walk", ("other_sync",))
    with pytest.raises(FileProblem, match=r"has several videos: 7f3a-uuid.mov, other_sync.mp4, walk_sync.mp4"):
        read_trial(folder)


def test_wrong_metadata_of_a_session_are_named(tmp_path):
    folder = opencap(tmp_path / "session", metadata="height_m: 3\n")
    with pytest.raises(FileProblem, match="repeats the key 'height_m'"):
        read_trial(folder)
    (folder / "sessionMetadata.yaml").write_text("height_m: 178\n")
    with pytest.raises(FileProblem, match=r"has a person whose stature \(--stature\) is 178.0"):
        read_trial(folder)


def test_trial_toml_names_the_calibration_and_the_videos(tmp_path):
    folder = tmp_path / "trial"
    write_videos(folder, ("GX010042", "GX010017"), suffix=".MP4")
    (tmp_path / "session").mkdir()
    (tmp_path / "session" / "cameras.toml").write_text(calibration_text(NAMES))
    settings = 'calibration = "../session"\n[videos]\ncam01 = "GX010042.MP4"\ncam02 = "GX010017.MP4"\n'
    (folder / "trial.toml").write_text(settings)
    trial = read_trial(folder)
    assert [clip.path.name for clip in trial.take.clips] == ["GX010042.MP4", "GX010017.MP4"]
    assert trial.calibration == tmp_path / "trial" / "../session" / "cameras.toml"
    (folder / "trial.toml").write_text(settings + 'cam03 = "x.mp4"\n')
    with pytest.raises(FileProblem, match=r"a video of 'cam03' under \[videos\], which the calibration does not have"):
        read_trial(folder)
    (folder / "trial.toml").write_text(settings.replace("../session", "nowhere"))
    with pytest.raises(FileProblem, match=r"nowhere: does not exist. Correct calibration in trial.toml"):
        read_trial(folder)
    (folder / "trial.toml").write_text("calibration = 3\n[videos]\ncam01 = 4\n")
    with pytest.raises(FileProblem, match=r"has calibration = 3.*has videos.cam01 = 4"):
        read_trial(folder)


@pytest.mark.parametrize(
    "key", ["calibration = {}", "[videos]\ncam01 = {}", "[background]\nfolder = {}", "[start]\nfile = {}"]
)
@pytest.mark.parametrize("value", ['"' + "x" * 300 + '"', '"a\\u0000b"', '""', "3"])
def test_a_path_that_cannot_be_one_is_named(tmp_path, key, value):
    pose2sim(tmp_path / "project")
    (tmp_path / "project" / "trial.toml").write_text(key.format(value))
    with pytest.raises(FileProblem, match=r"trial.toml: has .* which is invalid"):
        read_trial(tmp_path / "project")


def test_a_folder_without_anything_is_an_error(tmp_path):
    with pytest.raises(FileProblem, match="has no calibration of the cameras"):
        read_trial(tmp_path)
    with pytest.raises(FileProblem, match="does not exist"):
        read_trial(tmp_path / "nowhere")
    (tmp_path / "file").write_text("")
    with pytest.raises(FileProblem, match="is not a folder"):
        read_trial(tmp_path / "file")
