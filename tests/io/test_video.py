import subprocess
import sys

import cv2
import numpy as np
import pytest
from tests.clips import number_of, numbered_picture, write_video

from marey.errors import FileProblem
from marey.io.video import open_clip, open_stills


@pytest.mark.parametrize("name", ["clip.mp4", "clip.avi"])
def test_every_frame_is_found_by_its_number_in_any_order(tmp_path, name):
    clip = open_clip(write_video(tmp_path / name, 150))
    assert (clip.count, clip.size, clip.rate) == (150, (64, 48), 25.0)
    assert [number_of(image) for image in clip.images(range(150))] == list(range(150))
    order = [149, 0, 80, 81, 3, 3, 120]
    assert [number_of(image) for image in clip.images(order)] == order
    assert number_of(clip.image(100)) == 100


def test_a_frame_that_is_not_there_is_not_given(tmp_path):
    clip = open_clip(write_video(tmp_path / "clip.mp4", 5))
    for frame in (-1, 5):
        with pytest.raises(IndexError, match="frames 0 to 4"):
            clip.image(frame)


def test_a_container_that_counts_empty_packets_is_counted_by_its_pictures(shared):
    clip = open_clip(shared / "data/people/seated/cam1.avi")
    assert clip.count == 426
    assert sum(1 for _ in clip.images(range(clip.count))) == 426


def test_a_clip_that_breaks_off_is_an_error_before_the_work_begins(tmp_path):
    path = write_video(tmp_path / "clip.avi", 60)
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(FileProblem, match=r"clip.avi: breaks off: its header promises 60 frames, \d+ can be read"):
        open_clip(path)


@pytest.mark.parametrize("content", [b"", b"no video at all" * 100])
def test_what_is_no_video_cannot_be_opened(tmp_path, content):
    path = tmp_path / "cam01.mp4"
    path.write_bytes(content)
    with pytest.raises(FileProblem, match=r"cam01.mp4: cannot be opened as a video"):
        open_clip(path)


def test_the_decoder_writes_no_lines_of_its_own(tmp_path):
    path = tmp_path / "cam01.mp4"
    path.write_bytes(b"no video at all" * 100)
    script = (
        "import pathlib, sys\nfrom marey.errors import FileProblem\nfrom marey.io.video import open_clip\n"
        "try:\n    open_clip(pathlib.Path(sys.argv[1]))\nexcept FileProblem:\n    print('told')"
    )
    run = subprocess.run([sys.executable, "-c", script, str(path)], capture_output=True, text=True, check=True)
    assert (run.stdout, run.stderr) == ("told\n", "")


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FileProblem, match=r"cam01.mp4: does not exist"):
        open_clip(tmp_path / "cam01.mp4")


def test_a_frame_never_stands_in_another_ones_place_however_the_file_is_damaged(tmp_path):
    path = write_video(tmp_path / "clip.mp4", 100)
    sound = path.read_bytes()
    media = sound.find(b"mdat")
    rng = np.random.default_rng(1)
    told = 0
    for where in np.linspace(media + 100, sound.find(b"moov") - 400, 12).astype(int):
        path.write_bytes(sound[:where] + rng.bytes(300) + sound[where + 300 :])
        shown, problem = read_what_there_is(path)
        told += problem is not None
        # A decoder may paint over the damage; what is legible must be legible in its own place.
        assert problem is None or "decoded" in problem or "breaks off" in problem
        assert sum(number != i for i, number in enumerate(shown)) <= 15
    assert told > 0


def read_what_there_is(path):
    shown = []
    try:
        clip = open_clip(path)
        for image in clip.images(range(clip.count)):
            shown.append(number_of(image))
    except FileProblem as problem:
        return shown, str(problem)
    return shown, None


def test_stills_are_one_clip_of_one_size(tmp_path):
    paths = tuple(tmp_path / f"left_{number}.png" for number in range(3))
    for number, path in enumerate(paths):
        cv2.imwrite(str(path), numbered_picture(number))
    clip = open_stills(paths)
    assert (clip.count, clip.size, clip.rate, clip.path) == (3, (64, 48), None, paths[0])
    assert [number_of(image) for image in clip.images([2, 0, 1])] == [2, 0, 1]
    cv2.imwrite(str(paths[2]), numbered_picture(2, (32, 24)))
    with pytest.raises(FileProblem, match=r"left_2.png: has the size 32 x 24"):
        clip.image(2)
    paths[1].write_bytes(b"\xff\xd8\xff broken")
    with pytest.raises(FileProblem, match=r"left_1.png: is no picture"):
        clip.image(1)
