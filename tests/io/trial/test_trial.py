from typing import get_args

import cv2
import numpy as np
import pytest
from tests.clips import make_trial, numbered_picture, write_video

from marey.body.articulation.presets import PRESETS
from marey.errors import FileProblem, SettingProblem
from marey.io.trial.masks import write_masks
from marey.io.trial.settings import Preset, read_settings
from marey.io.trial.trial import read_trial, z_up_from


def test_a_folder_with_videos_and_cameras_is_a_trial(tmp_path):
    trial = read_trial(make_trial(tmp_path))
    assert trial.rig.names == trial.take.names == ("cam01", "cam02")
    assert not trial.background
    assert not trial.masks
    assert not trial.evidence
    assert trial.network is None
    assert not trial.up_given
    assert trial.start is None
    assert trial.keypoints is None
    assert {path.name for path in trial.input_files} == {"cameras.toml", "cam01.mp4", "cam02.mp4"}


def test_the_settings_of_trial_toml_are_read(tmp_path):
    toml = """
    stature_m = 1.8
    mass_kg = 75
    preset = "upper"
    cameras = ["cam02"]
    frames = [2, 9]
    rate = 50.0
    [start]
    file = "clicks.json"
    [background]
    folder = "empty"
    [world]
    up = "-y"
    """
    folder = make_trial(tmp_path, toml=toml)
    (folder / "clicks.json").write_text("{}")
    (folder / "empty").mkdir()
    cv2.imwrite(str(folder / "empty" / "cam02.png"), numbered_picture(1))
    trial = read_trial(folder)
    assert trial.rig.names == ("cam02",)
    assert (trial.take.first, trial.take.end, trial.take.count, trial.take.rate) == (2, 9, 12, 50.0)
    assert (trial.settings.stature_m, trial.settings.preset) == (1.8, "upper")
    assert trial.start == folder / "clicks.json"
    assert trial.background["cam02"].size == (64, 48)
    assert trial.up_given
    assert trial.settings.start is not None


def test_the_folder_of_key_points_is_relative_to_the_trial_and_its_files_are_inputs(tmp_path):
    folder = make_trial(tmp_path, toml='[keypoints]\nfolder = "pose"\n')
    for camera in ("cam01", "cam02"):
        (folder / "pose" / f"{camera}_json").mkdir(parents=True)
        (folder / "pose" / f"{camera}_json" / f"{camera}_000000.json").write_text("{}")
    (folder / "pose" / "readme.txt").write_text("x")
    trial = read_trial(folder)
    assert trial.keypoints == folder / "pose"
    added = {path.name for path in trial.input_files} - {"cameras.toml", "cam01.mp4", "cam02.mp4", "trial.toml"}
    assert added == {"cam01_000000.json", "cam02_000000.json"}
    other = tmp_path / "elsewhere"
    other.mkdir()
    assert read_trial(folder, keypoints={"folder": str(other)}).keypoints == other


@pytest.mark.parametrize(
    ("toml", "message"),
    [
        (
            '[keypoints]\nfolder = "pose"\n',
            r"pose: does not exist\. Correct keypoints \(--keypoints, or \[keypoints\] folder in",
        ),
        ('[keypoints]\nfolder = "cameras.toml"\n', r"cameras\.toml: is not a folder\. Correct keypoints"),
        ("[keypoints]\nfolder = 3\n", "folder"),
        ('[keypoints]\nfile = "pose"\n', "folder"),
        ('keypoints = "pose"\n', "keypoints"),
    ],
)
def test_a_wrong_folder_of_key_points_is_one_line(tmp_path, toml, message):
    with pytest.raises(FileProblem, match=message) as caught:
        read_trial(make_trial(tmp_path, toml=toml))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("up", ["z", "-z", "y", "-y", "x", "-x"])
def test_the_given_axis_becomes_z_and_the_cameras_are_rotated(tmp_path, up, rng):
    folder = make_trial(tmp_path, toml=f'world.up = "{up}"')
    axis = np.eye(3)["xyz".index(up[-1])] * (-1 if up[0] == "-" else 1)
    turn = z_up_from(up)
    assert np.allclose(turn.apply(axis), [0, 0, 1])
    assert np.linalg.det(turn.rotation) == pytest.approx(1)
    plain = read_trial(make_plain(folder))
    turned = read_trial(folder)
    points = rng.normal(size=(20, 3)) * 0.3
    for before, after in zip(plain.rig, turned.rig, strict=True):
        assert np.allclose(before.project(points), after.project(turned.world_from_file.apply(points)), equal_nan=True)


def make_plain(folder):
    plain = folder.parent / "plain"
    plain.mkdir()
    for path in folder.iterdir():
        if path.name != "trial.toml":
            (plain / path.name).write_bytes(path.read_bytes())
    return plain


def test_an_unknown_key_is_answered_with_the_known_ones(tmp_path):
    folder = make_trial(tmp_path, toml="stature = 1.8\nshoes = true\n[start]\nfile = 'a'\nfiles = 'a'\n")
    with pytest.raises(FileProblem) as caught:
        read_trial(folder)
    message = str(caught.value)
    assert "has the unknown key 'stature'" in message
    assert "has the unknown key 'shoes'" in message
    assert "has the unknown key 'start.files'" in message
    assert "The known keys are stature_m, leg_length_m, asis_distance_m, mass_kg, preset, cameras" in message


@pytest.mark.parametrize(
    ("toml", "message"),
    [
        ("stature_m = 180", r"has stature_m = 180, which is invalid \(it should be less than 2.8\)"),
        ("rate = true", r"has rate = True, which is invalid \(it should be a number\)"),
        ("stature_m = '1.7'", "has stature_m = '1.7', which is invalid"),
        ("preset = 'whole'", "has preset = 'whole', which is invalid"),
        ("world.up = 'up'", "has world.up = 'up', which is invalid"),
        ("frames = [3]", "has frames"),
        ("rate = 0", "has rate = 0, which"),
        ("start = 'a.json'", r"has start = 'a.json', which should be a table \[start\]"),
        ("stature_m = ", "is not TOML"),
        ("cameras = ['cam09']", "has no camera 'cam09'"),
        ("start.file = 'none.json'", r"none.json: does not exist. Correct \[start\] file"),
        ("background.folder = 'none'", r"none: does not exist. Correct \[background\] folder"),
    ],
)
def test_a_wrong_value_is_reported_with_its_key(tmp_path, toml, message):
    with pytest.raises(FileProblem, match=message):
        read_trial(make_trial(tmp_path, toml=toml))


def test_arguments_replace_settings_of_the_file(tmp_path):
    folder = make_trial(tmp_path, toml="stature_m = 1.8\nrate = 30\n")
    settings = read_settings(folder, stature_m=1.7, preset=None, frames=(1, None))
    assert (settings.stature_m, settings.rate, settings.frames, settings.preset) == (1.7, 30, (1, None), None)
    with pytest.raises(SettingProblem, match=r"The settings are invalid: stature \(--stature\) is 180"):
        read_settings(folder, stature_m=180)
    assert read_trial(folder, cameras=["cam01"]).rig.names == ("cam01",)


def test_the_background_must_fit_the_camera(tmp_path):
    folder = make_trial(tmp_path)
    (folder / "background").mkdir()
    cv2.imwrite(str(folder / "background" / "cam01.png"), numbered_picture(1, (32, 24)))
    with pytest.raises(FileProblem, match=r"cam01.png: is 32 x 24, but camera 'cam01' was calibrated at 64 x 48"):
        read_trial(folder)
    write_video(folder / "background" / "cam01.mp4", 3)
    with pytest.raises(FileProblem, match="several images of 'cam01'"):
        read_trial(folder)
    (folder / "background" / "cam01.png").unlink()
    trial = read_trial(folder)
    assert list(trial.background) == ["cam01"]
    assert trial.background["cam01"].count == 3


def test_an_empty_background_folder_is_rejected(tmp_path):
    folder = make_trial(tmp_path)
    (folder / "background").mkdir()
    with pytest.raises(FileProblem, match=r"has no image of cam01, cam02. Name them cam01.png"):
        read_trial(folder)


@pytest.mark.parametrize("folder_name", ["background", "masks"])
def test_a_file_of_an_unknown_camera_beside_cameras_without_any_is_named(tmp_path, folder_name):
    folder = make_trial(tmp_path, count=12)
    if folder_name == "masks":
        (folder / "trial.toml").write_text('[masks]\nuse = "evidence"\n')
    (folder / folder_name).mkdir()
    for name in ("cam01", "cam2"):
        write_video(folder / folder_name / f"{name}.mp4", 12)
    with pytest.raises(FileProblem, match=rf"{folder_name}: has cam2.mp4, which belongs to no camera, .* of cam02\."):
        read_trial(folder)
    # Of selected cameras, the folder may have more.
    assert read_trial(folder, cameras=["cam01"])
    (folder / folder_name / "cam2.mp4").rename(folder / folder_name / "cam02.mp4")
    assert read_trial(folder)


def test_known_silhouettes_are_of_all_cameras_or_none(tmp_path):
    folder = make_trial(tmp_path, count=12)
    masks = np.zeros((12, 48, 64), bool)
    masks[3] = True
    write_masks(folder / "masks" / "cam01.npz", masks, shape=masks.shape)
    with pytest.raises(FileProblem, match="has no silhouettes of cam02"):
        read_trial(folder)
    write_masks(folder / "masks" / "cam02.npz", masks[:5], shape=(5, 48, 64))
    with pytest.raises(FileProblem, match="has 5 frames of 64 x 48, but the video has 12 of 64 x 48"):
        read_trial(folder)
    write_masks(folder / "masks" / "cam02.npz", masks, shape=masks.shape)
    trial = read_trial(folder)
    assert [mask.any() for mask in trial.masks["cam02"].masks([2, 3])] == [False, True]
    assert folder / "masks" / "cam01.npz" in trial.input_files


def test_silhouettes_of_some_cameras_are_evidence(tmp_path):
    folder = make_trial(tmp_path, count=12, toml='[masks]\nuse = "evidence"\n')
    with pytest.raises(FileProblem, match=r"has no silhouettes of cam01, cam02, but \[masks\] use = 'evidence'"):
        read_trial(folder)
    images = folder / "masks" / "cam02"
    images.mkdir(parents=True)
    for number in range(12):
        cv2.imwrite(str(images / f"{number:03}.png"), np.full((48, 64), 20 * number, np.uint8))
    trial = read_trial(folder)
    assert not trial.masks
    assert list(trial.evidence) == ["cam02"]
    assert [int(level.max()) for level in trial.evidence["cam02"].levels([3, 9])] == [60, 180]
    assert images / "011.png" in trial.input_files
    assert "with silhouettes" in repr(trial)
    (folder / "trial.toml").unlink()
    with pytest.raises(FileProblem, match=r"no silhouettes of cam01. Add them, .*\[masks\] use = \"evidence\""):
        read_trial(folder)


def test_silhouettes_of_all_cameras_are_evidence_only_if_it_is_said(tmp_path):
    folder = make_trial(tmp_path, count=12)
    for name in ("cam01", "cam02"):
        write_masks(folder / "masks" / f"{name}.npz", np.ones((12, 48, 64), bool), shape=(12, 48, 64))
    assert set(read_trial(folder).masks) == {"cam01", "cam02"}
    (folder / "trial.toml").write_text('[masks]\nuse = "evidence"\n')
    trial = read_trial(folder)
    assert not trial.masks
    assert set(trial.evidence) == {"cam01", "cam02"}


def test_a_camera_has_silhouettes_in_one_file_only(tmp_path):
    folder = make_trial(tmp_path, count=12)
    write_masks(folder / "masks" / "cam01.npz", np.ones((12, 48, 64), bool), shape=(12, 48, 64))
    (folder / "masks" / "cam01").mkdir()
    with pytest.raises(FileProblem, match=r"has several silhouettes of 'cam01': cam01.npz, cam01. Keep one"):
        read_trial(folder)


def test_a_network_given_as_an_option_keeps_the_use_of_the_silhouettes(tmp_path):
    (tmp_path / "trial.toml").write_text('[masks]\nuse = "evidence"\nnetwork = "a.onnx"\n')
    masks = read_settings(tmp_path, masks={"network": "b.onnx"}).masks
    assert masks is not None
    assert (masks.use, masks.network) == ("evidence", "b.onnx")


def test_a_network_that_does_not_exist_is_rejected(tmp_path):
    folder = make_trial(tmp_path, toml='[masks]\nnetwork = "net.onnx"\n')
    with pytest.raises(FileProblem, match=r"net.onnx: does not exist. Correct the network \(--person-net"):
        read_trial(folder)


def test_a_missing_folder_is_rejected(tmp_path):
    with pytest.raises(FileProblem, match="does not exist"):
        read_trial(tmp_path / "nowhere")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["reach", "walk", "jacks", "stealth", "arm3", "balancing", "tpose", "seated"])
def test_the_shared_takes_open(shared, name):
    trial = read_trial(shared / "data" / "people" / name)
    assert len(trial.background) == len(trial.rig)
    # The last image of a long video takes a second: those of the shortest take are enough.
    shown = trial.take.count - 1 if name == "reach" else 0
    for image, camera in zip(trial.take.images(shown), trial.rig, strict=True):
        assert image.shape == (camera.height, camera.width, 3)
    if name == "seated":
        assert (trial.take.count, trial.take.rate) == (426, 25.0)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["walk", "stealth"])
def test_true_joints_project_into_the_true_silhouettes(shared, name):
    folder = shared / "data" / "people" / name
    trial = read_trial(folder)
    with np.load(folder / "truth" / "truth.npz") as truth, np.load(folder / "truth" / "masks.npz") as file:
        joints, shape = truth["joints"], file["shape"]
        masks = np.unpackbits(file["bits"], count=shape.prod()).reshape(shape)
    for camera, silhouettes in zip(trial.rig, masks, strict=True):
        pixels = camera.project(joints)
        frame, joint = np.nonzero(camera.sees(pixels))
        x, y = np.rint(pixels[frame, joint]).astype(int).T
        assert silhouettes[frame, y, x].mean() > 0.99


def test_a_trial_may_name_every_preset_that_there_is():
    assert get_args(Preset) == tuple(PRESETS)
