import threading
import time

import cv2
import pytest
from tests.clips import calibration_text, make_trial, number_of, numbered_picture, write_video

from marey.errors import FileProblem
from marey.io.calibration.readers import read_rig
from marey.io.video.take import Take, open_take


def test_the_cameras_are_read_frame_by_frame(tmp_path):
    folder = make_trial(tmp_path, count=40)
    take = open_take(folder, read_rig(folder))
    assert (take.count, take.first, take.end, take.rate, take.names) == (40, 0, 40, 25.0, ("cam01", "cam02"))
    seen = [(frame, [number_of(image) for image in images]) for frame, images in take.frames()]
    assert seen == [(frame, [frame, frame]) for frame in range(40)]


def test_a_range_and_a_few_frames_are_exact(tmp_path):
    folder = make_trial(tmp_path, count=40)
    take = open_take(folder, read_rig(folder), frames=(10, 20))
    assert [(frame, number_of(images[1])) for frame, images in take.frames()] == [(i, i) for i in range(10, 20)]
    assert [number_of(images[0]) for _, images in take.at([5, 39, 2])] == [5, 39, 2]
    assert [number_of(image) for image in take.images(7)] == [7, 7]
    assert open_take(folder, read_rig(folder), frames=(10, None)).end == 40


def test_some_cameras_are_decoded_alone_in_the_given_order(tmp_path):
    class Counting:
        def __init__(self, first):
            self.first, self.read = first, 0

        def images(self, frames):
            for frame in frames:
                self.read += 1
                yield self.first + frame

    clips = (Counting(0), Counting(100), Counting(200))
    take = Take(names=("a", "b", "c"), clips=clips, rate=25.0, count=8, first=0, end=8)
    assert list(take.at([1, 4], [2, 0])) == [(1, (201, 1)), (4, (204, 4))]
    assert [clip.read for clip in clips] == [2, 0, 2]
    assert list(take.at([5])) == [(5, (5, 105, 205))]


def test_leaving_a_take_early_leaves_no_thread_behind(tmp_path):
    folder = make_trial(tmp_path, count=60)
    take = open_take(folder, read_rig(folder))
    before = threading.active_count()
    for frame, _ in take.frames():
        if frame == 2:
            break
    time.sleep(0.1)
    assert threading.active_count() == before


def test_a_damaged_still_is_reported_when_it_is_read(tmp_path):
    folder = make_trial(tmp_path, count=1)
    for name in ("cam01", "cam02"):
        (folder / f"{name}.mp4").unlink()
        for number in (2, 10, 1):
            cv2.imwrite(str(folder / f"{name}_{number}.png"), numbered_picture(number))
    take = open_take(folder, read_rig(folder), rate=50)
    assert [number_of(images[0]) for _, images in take.frames()] == [1, 2, 10]
    (folder / "cam02_10.png").write_bytes(b"")
    with pytest.raises(FileProblem, match=r"cam02_10.png"):
        list(take.frames())


def test_pictures_of_one_instant_lie_in_images(tmp_path):
    folder = make_trial(tmp_path, count=1)
    (folder / "images").mkdir()
    for name in ("cam01", "cam02"):
        (folder / f"{name}.mp4").unlink()
        cv2.imwrite(str(folder / "images" / f"{name}.png"), numbered_picture(77))
    take = open_take(folder, read_rig(folder))
    assert (take.count, take.rate) == (1, 1.0)
    assert [number_of(image) for image in take.images(0)] == [77, 77]


def test_a_missing_video_and_a_video_without_camera_are_named(tmp_path):
    folder = make_trial(tmp_path)
    (folder / "cam02.mp4").rename(folder / "kitchen.mp4")
    with pytest.raises(FileProblem, match=r"has no video of 'cam02'.*without a camera, kitchen.mp4"):
        open_take(folder, read_rig(folder))


def test_a_video_without_a_camera_is_an_error_unless_cameras_were_chosen(tmp_path):
    folder = make_trial(tmp_path)
    rig = read_rig(folder).subset(["cam01"])
    with pytest.raises(FileProblem, match=r"not in the calibration: cam02.mp4"):
        open_take(folder, rig)
    assert open_take(folder, rig, others=True).names == ("cam01",)


def test_a_shorter_clip_is_an_error_unless_what_all_have_is_kept(tmp_path):
    folder = make_trial(tmp_path, count=30)
    write_video(folder / "cam02.mp4", 20)
    rig = read_rig(folder)
    with pytest.raises(FileProblem, match=r"cam02.mp4: has 20 frames and is shorter.*frames = \[0, 20\]"):
        open_take(folder, rig)
    assert open_take(folder, rig, frames=(0, 20)).end == 20
    with pytest.raises(FileProblem, match="shorter"):
        open_take(folder, rig, frames=(0, 25))


def test_a_few_frames_at_the_end_may_be_missing_and_are_noted(tmp_path):
    folder = make_trial(tmp_path, count=30)
    write_video(folder / "cam02.mp4", 28)
    take = open_take(folder, read_rig(folder))
    assert take.count == 28
    assert "28 to 30 frames" in take.notes[0]


def test_frames_outside_the_clip_are_rejected(tmp_path):
    folder = make_trial(tmp_path, count=10)
    for frames in ((0, 11), (5, 5), (8, 4)):
        with pytest.raises(FileProblem, match="has 10 frames, so the frames from"):
            open_take(folder, read_rig(folder), frames=frames)


def test_another_size_than_the_calibrations_is_an_error(tmp_path):
    folder = make_trial(tmp_path)
    write_video(folder / "cam02.mp4", 12, size=(80, 48))
    with pytest.raises(FileProblem, match=r"cam02.mp4: is 80 x 48, but camera 'cam02' was calibrated at 64 x 48"):
        open_take(folder, read_rig(folder))
    write_video(folder / "cam02.mp4", 12, size=(48, 64))
    with pytest.raises(FileProblem, match="rotated by 90 degrees"):
        open_take(folder, read_rig(folder))


def test_rates_must_agree_unless_the_right_one_is_given(tmp_path):
    folder = make_trial(tmp_path)
    write_video(folder / "cam02.mp4", 12, rate=50.0)
    rig = read_rig(folder)
    with pytest.raises(FileProblem, match="different rates"):
        open_take(folder, rig)
    take = open_take(folder, rig, rate=25.0)
    assert take.rate == 25.0
    assert "containers have 50" in take.notes[0]


def test_two_videos_of_one_camera_are_rejected(tmp_path):
    folder = make_trial(tmp_path)
    write_video(folder / "cam01.avi", 12)
    with pytest.raises(FileProblem, match=r"several videos of 'cam01': cam01.avi, cam01.mp4"):
        open_take(folder, read_rig(folder))


def test_a_missing_still_is_detected(tmp_path):
    folder = make_trial(tmp_path, count=1)
    (folder / "cameras.toml").write_text(calibration_text(("left", "right")))
    for path in folder.glob("*.mp4"):
        path.unlink()
    for name, numbers in (("left", (1, 2, 3)), ("right", (1, 3))):
        for number in numbers:
            cv2.imwrite(str(folder / f"{name}_{number}.jpg"), numbered_picture(number))
    with pytest.raises(FileProblem, match=r"right_1.jpg: belongs to a camera with 2 stills, but left_1.jpg to one wit"):
        open_take(folder, read_rig(folder))
