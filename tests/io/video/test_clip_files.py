"""Names of videos and of cameras: which belong together."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.clips import calibration_text, number_of, numbered_picture, turn_by_metadata, write_video

from marey.errors import FileProblem
from marey.io.calibration.readers import read_rig
from marey.io.video.clip_files import VideoPlaces, find_clips, name_key, pair_videos, stills_of
from marey.io.video.take import open_free_take, open_take


def pairs(names, files, **more):
    places = VideoPlaces(folder=Path(), **more)
    return {name: path.name for name, path in pair_videos(names, [Path(file) for file in files], places).items()}


@pytest.mark.parametrize(
    ("names", "files"),
    [
        (["cam01", "cam02"], ["cam01.mp4", "cam02.mp4"]),
        (["cam01", "cam02"], ["CAM01.MP4", "Cam02.MOV"]),
        (["cam01", "cam02"], ["Cam_1.avi", "cam-2.mkv"]),
        (["cam_1", "cam_10"], ["cam1.mp4", "cam10.mp4"]),
        (["cam_0", "cam_1"], ["port_0.mp4", "port_1.mp4"]),
        (["Camera 1", "Camera 2"], ["cam1.mp4", "cam02.mp4"]),
        (["links", "rechts"], ["LINKS.mp4", "Rechts.mp4"]),
    ],
)
def test_names_agree_without_regard_to_case_separators_and_zeros(names, files):
    assert list(pairs(names, files).values()) == files


def test_an_exact_name_has_priority():
    assert pairs(["cam1", "cam01"], ["cam01.mp4", "cam1.mp4"]) == {"cam1": "cam1.mp4", "cam01": "cam01.mp4"}
    assert pairs(["cam1", "cam01"], ["CAM_1.mp4"]) == {}
    assert pairs(["left"], ["left.mp4", "LEFT.mp4"]) == {"left": "left.mp4"}


def test_names_that_differ_are_not_paired():
    assert pairs(["cam01", "cam02"], ["GX010042.MP4", "GX010043.MP4"]) == {}
    assert pairs(["cam01"], ["cam011.mp4", "cam01_background.mp4", "xcam01.mp4"]) == {}


def test_two_videos_of_one_camera_are_an_error():
    with pytest.raises(FileProblem, match=r"has several videos of 'cam01': CAM01.MP4, Cam01.mov"):
        pairs(["cam01"], ["CAM01.MP4", "Cam01.mov"])


def test_videos_are_paired_by_order_only_where_that_is_the_rule():
    names, files = ["21001", "21002", "21003"], ["cam10.mp4", "cam9.mp4", "21002.mp4"]
    assert pairs(names, files) == {"21002": "21002.mp4"}
    assert pairs(names, files, in_order=True) == {"21001": "cam9.mp4", "21002": "21002.mp4", "21003": "cam10.mp4"}
    assert pairs(names, files[:2], in_order=True) == {}


@pytest.mark.parametrize(("a", "b"), [("Cam1", "cam_001"), ("port_2", "CAM2"), ("A-b 3", "a_b_03")])
def test_a_key_of_a_name_has_words_and_numbers(a, b):
    assert name_key(a) == name_key(b)
    assert name_key(a) != name_key(b + "x")


def trial(tmp_path, files, names=("cam01", "cam02")):
    (tmp_path / "cameras.toml").write_text(calibration_text(names))
    for number, file in enumerate(files):
        write_video(tmp_path / file, 3 + number)
    return tmp_path, read_rig(tmp_path)


def test_a_take_with_capital_letters_is_opened(tmp_path):
    folder, rig = trial(tmp_path, ["CAM01.MP4", "Cam_2.avi"])
    take = open_take(folder, rig)
    assert [clip.path.name for clip in take.clips] == ["CAM01.MP4", "Cam_2.avi"]


def test_named_videos_need_no_names(tmp_path):
    folder, rig = trial(tmp_path, ["GX010042.MP4", "GX010017.MP4"])
    with pytest.raises(FileProblem, match=r"has no video of 'cam01', 'cam02'.*GX010017.MP4.*`marey init`"):
        open_take(folder, rig)
    named = {"cam01": folder / "GX010042.MP4", "cam02": folder / "GX010017.MP4"}
    take = open_take(folder, rig, places=VideoPlaces(folder=folder, named=named))
    assert [clip.count for clip in take.clips] == [3, 4]
    with pytest.raises(FileProblem, match=r"GX1.MP4: does not exist, but is the video of 'cam01'"):
        find_clips(folder, rig.names, places=VideoPlaces(folder=folder, named={"cam01": folder / "GX1.MP4"}))
    same = dict.fromkeys(rig.names, folder / "GX010042.MP4")
    with pytest.raises(FileProblem, match="is the video of 'cam01', 'cam02'"):
        find_clips(folder, rig.names, places=VideoPlaces(folder=folder, named=same))


def test_pairs_by_order_are_reported(tmp_path):
    folder, rig = trial(tmp_path, ["a1.mp4", "a2.mp4"])
    take = open_free_take(folder, rig, places=VideoPlaces(folder=folder, in_order=True))
    assert take.notes == (
        "Videos were paired with cameras by their order, as in Pose2Sim; check it: cam01 a1.mp4, cam02 a2.mp4.",
    )


def test_stills_are_found_without_regard_to_case(tmp_path):
    for name in ("CAM01_2.JPG", "cam01_10.jpg"):
        cv2.imwrite(str(tmp_path / name), numbered_picture(1))
    assert [path.name for path in stills_of(tmp_path, "cam01")] == ["CAM01_2.JPG", "cam01_10.jpg"]
    assert stills_of(tmp_path / "nowhere", "cam01") == ()


@pytest.mark.parametrize(("quarters", "shown"), [(1, (48, 64)), (2, (64, 48)), (3, (48, 64))])
def test_a_video_is_rotated_as_its_container_states_if_the_calibration_is(tmp_path, quarters, shown):
    (tmp_path / "cameras.toml").write_text(calibration_text(("cam01",), size=shown))
    turn_by_metadata(write_video(tmp_path / "cam01.mp4", 3), quarters)
    take = open_take(tmp_path, read_rig(tmp_path))
    assert take.clips[0].size == shown
    assert take.notes == ()
    image = take.images(1)[0]
    assert number_of(np.rot90(image, quarters)) == 1


@pytest.mark.parametrize("quarters", [1, 3])
def test_a_calibration_of_the_stored_images_gets_them_unrotated(tmp_path, quarters):
    (tmp_path / "cameras.toml").write_text(calibration_text(("cam01",)))
    turn_by_metadata(write_video(tmp_path / "cam01.mp4", 90), quarters)
    take = open_take(tmp_path, read_rig(tmp_path))
    assert take.clips[0].size == (64, 48)
    assert [number_of(images[0]) for _, images in take.at([0, 80, 3])] == [0, 80, 3]
    note = "The videos of 'cam01' are not rotated as their containers state: the calibration is not either."
    assert take.notes == (note,)


def test_caliscope_never_rotates(tmp_path):
    (tmp_path / "cameras.toml").write_text(calibration_text(("cam01",)))
    turn_by_metadata(write_video(tmp_path / "cam01.mp4", 3), 2)
    take = open_take(tmp_path, read_rig(tmp_path), places=VideoPlaces(folder=tmp_path, stored=True))
    assert number_of(take.images(1)[0]) == 1
    assert len(take.notes) == 1


def test_a_size_that_fits_neither_way_is_explained(tmp_path):
    (tmp_path / "cameras.toml").write_text(calibration_text(("cam01",), size=(100, 60)))
    turn_by_metadata(write_video(tmp_path / "cam01.mp4", 3), 1)
    message = r"48 x 64 \(after the rotation that its container states\), but camera 'cam01' was calibrated at 100 x 60"
    with pytest.raises(FileProblem, match=message):
        open_take(tmp_path, read_rig(tmp_path))
    (tmp_path / "cameras.toml").write_text(calibration_text(("cam01",), size=(128, 96)))
    write_video(tmp_path / "cam01.mp4", 3)
    with pytest.raises(FileProblem, match="was resized: calibrate at its size, or use one of 128 x 96"):
        open_take(tmp_path, read_rig(tmp_path))
