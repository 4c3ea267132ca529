"""Pictures by frame number: exact in any order, bounded in memory, and empty where a video is damaged."""

import time
from collections.abc import Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.clips import SIZE, number_of, numbered_picture, write_video

from marey.arrays import Image
from marey.errors import FileProblem
from marey.io.video.video import Clip, open_clip
from marey.view.viewer.pictures import CameraPictures, CodedPicture, jpeg_of_width


def shown(coded: bytes) -> int:
    return number_of(cv2.imdecode(np.frombuffer(coded, np.uint8), cv2.IMREAD_COLOR))


def until(condition) -> None:
    end = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.005)


class Damaged(Clip):
    """A clip of ten numbered images, of which one cannot be decoded; or that cannot be opened."""

    path, size, count, rate, paths = Path("damaged.mp4"), SIZE, 10, 25.0, ()

    def __init__(self, bad: int, *, opens: bool = True):
        self.bad, self.opens = bad, opens

    def images(self, frames: Iterable[int]) -> Iterator[Image]:
        if not self.opens:
            raise FileProblem(self.path, "does not exist")
        for frame in frames:
            if frame == self.bad:
                raise FileProblem(self.path, "is damaged")
            yield numbered_picture(frame)


def test_pictures_are_exact_in_any_order(tmp_path):
    pictures = CameraPictures(open_clip(write_video(tmp_path / "a.mp4", 60)))
    try:
        for frame in (50, 3, 59, 0, 31, 30):
            assert shown(pictures.picture(frame).large) == frame
        until(lambda: pictures.kept == 60)
    finally:
        pictures.close()


def test_beyond_the_ends_there_is_no_picture(tmp_path):
    pictures = CameraPictures(open_clip(write_video(tmp_path / "a.mp4", 5)))
    try:
        assert pictures.picture(-1) == pictures.picture(5) == CodedPicture()
    finally:
        pictures.close()


def test_memory_is_bounded_and_what_is_ahead_stays(tmp_path):
    one = len(jpeg_of_width(numbered_picture(3), 64, 85))
    pictures = CameraPictures(open_clip(write_video(tmp_path / "a.mp4", 200)), memory=20 * one)
    try:
        for frame in (0, 150, 20, 151):
            assert shown(pictures.picture(frame).large) == frame
        until(lambda: pictures.kept > 3)
        assert pictures.kept <= 20
    finally:
        pictures.close()


def test_a_requested_picture_is_returned_although_the_memory_is_full(tmp_path):
    pictures = CameraPictures(open_clip(write_video(tmp_path / "a.mp4", 30)), memory=1)
    try:
        until(lambda: pictures.kept == 1)
        # The last request of another thread is for a frame that is far from this one.
        for frame in (29, 0, 15):
            pictures.want(29 - frame)
            assert shown(pictures.picture(frame).large) == frame
    finally:
        pictures.close()


@pytest.mark.parametrize(("bad", "opens"), [(4, True), (0, True), (0, False)])
def test_a_damaged_picture_is_empty_and_the_others_are_shown(bad, opens):
    pictures = CameraPictures(Damaged(bad, opens=opens))
    try:
        assert pictures.picture(bad) == CodedPicture()
        assert bool(pictures.picture(7)) == opens
        until(lambda: pictures.kept == 10)
    finally:
        pictures.close()


def test_a_wide_picture_is_reduced_by_a_whole_number():
    coded = jpeg_of_width(np.zeros((50, 130, 3), np.uint8), 64, 80)
    assert cv2.imdecode(np.frombuffer(coded, np.uint8), cv2.IMREAD_COLOR).shape == (16, 43, 3)
