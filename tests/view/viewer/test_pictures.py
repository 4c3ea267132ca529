"""Pictures by frame number: exact in any order, bounded in memory, and empty where a video is damaged."""

import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.clips import SIZE, number_of, numbered_picture, write_video

from marey.arrays import Image
from marey.errors import FileProblem
from marey.io.video.seek_copy import SeekCopy
from marey.io.video.video import Clip, open_clip
from marey.view.viewer import pictures as module
from marey.view.viewer.pictures import CameraPictures, CodedPicture, CopyWriter, Requests, jpeg_of_width


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


class Counting(Clip):
    """A clip that counts its decoded images."""

    rate, paths = 25.0, ()

    def __init__(self, clip: Clip):
        self.clip, self.decoded = clip, 0
        self.path, self.size, self.count = clip.path, clip.size, clip.count

    def images(self, frames: Iterable[int]) -> Iterator[Image]:
        for image in self.clip.images(frames):
            self.decoded += 1
            yield image


def test_pictures_are_exact_in_any_order(tmp_path):
    pictures = CameraPictures(open_clip(write_video(tmp_path / "a.mp4", 60)))
    try:
        for frame in (50, 3, 59, 0, 31, 30):
            assert shown(pictures.picture(frame).large) == frame
        assert pictures.kept == 6
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
        for frame in range(60):
            pictures.picture(frame)
        assert 3 < pictures.kept <= 20
    finally:
        pictures.close()


def test_a_requested_picture_is_returned_although_the_memory_is_full(tmp_path):
    pictures = CameraPictures(open_clip(write_video(tmp_path / "a.mp4", 30)), memory=1)
    try:
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
    finally:
        pictures.close()


@pytest.fixture
def _hurried(monkeypatch):
    monkeypatch.setattr(module, "_QUIET_S", 0.02)


@contextmanager
def copying(clips: Sequence[Clip], folder: Path) -> Iterator[tuple[list[CameraPictures], list[SeekCopy]]]:
    """Cameras of a take whose copies are written."""
    requests, copies = Requests(), [SeekCopy(clip, folder / clip.path.stem, 1280) for clip in clips]
    cameras = [CameraPictures(clip, requests=requests, copy=copy) for clip, copy in zip(clips, copies, strict=True)]
    writer = CopyWriter(cameras, requests)
    try:
        yield cameras, copies
    finally:
        writer.close()
        for each in cameras:
            each.close()


@pytest.mark.usefixtures("_hurried")
def test_copies_are_written_after_the_first_request_and_used_then(tmp_path):
    clips = [Counting(open_clip(write_video(tmp_path / f"{name}.mp4", 300))) for name in "ab"]
    with copying(clips, tmp_path / "copies") as (cameras, copies):
        time.sleep(0.1)
        assert not (tmp_path / "copies").exists()
        assert shown(cameras[0].picture(41).large) == 41
        until(lambda: all(copy.missing(0) is None for copy in copies))
        for clip in clips:
            clip.decoded = 0
        for frame in (255, 3, 170, 0):
            assert [shown(camera.picture(frame).large) for camera in cameras] == [frame, frame]
        assert [clip.decoded for clip in clips] == [0, 0]


@pytest.mark.usefixtures("_hurried")
def test_what_is_written_at_the_end_is_whole_or_not_there(tmp_path):
    source = open_clip(write_video(tmp_path / "a.mp4", 600))
    with copying([source], tmp_path / "copies") as (cameras, (copy,)):
        cameras[0].picture(300)
        until(lambda: copy.holds(300))
        # The next piece is begun.
        until(lambda: len(list((tmp_path / "copies" / "a").iterdir())) == 2)
    kept = SeekCopy(source, tmp_path / "copies" / "a", 1280)
    pieces = [n for n in range(3) if kept.holds(256 * n)]
    assert 1 in pieces
    assert [number_of(np.asarray(kept.image(256 * n))) for n in pieces] == [0] * len(pieces)
    assert len(list((tmp_path / "copies" / "a").iterdir())) == len(pieces)


def test_nothing_is_written_while_there_are_requests(tmp_path):
    with copying([open_clip(write_video(tmp_path / "a.mp4", 40))], tmp_path / "copies") as (cameras, (copy,)):
        for frame in range(10):
            cameras[0].picture(frame)
            time.sleep(0.01)
        assert copy.written == 0


def test_a_wide_picture_is_reduced_by_a_whole_number():
    coded = jpeg_of_width(np.zeros((50, 130, 3), np.uint8), 64, 80)
    assert cv2.imdecode(np.frombuffer(coded, np.uint8), cv2.IMREAD_COLOR).shape == (16, 43, 3)
