"""Copies of videos with near key pictures: the same pictures in any order, kept for later, and never half written."""

from dataclasses import replace
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from tests.clips import SIZE, number_of, numbered_picture

from marey.errors import FileProblem
from marey.io.video import seek_copy as module
from marey.io.video.seek_copy import KEY_FRAMES, FrameReader, SeekCopy, copies_folder, seek_copy
from marey.io.video.video import Video, open_clip, open_video
from marey.io.video.video_writer import VideoWriter

COUNT, PIECE = 50, 20


@pytest.fixture(autouse=True)
def _small_videos(monkeypatch):
    monkeypatch.setattr(module, "PIECE_FRAMES", PIECE)
    monkeypatch.setattr(module, "QUICK_PIXELS", 12 * SIZE[0] * SIZE[1])


def write_video(path: Path, count: int) -> Path:
    """Write numbered images, of which only the first one is a key picture."""
    with VideoWriter(path, SIZE, rate=25.0, coding={"g": "250", "sc_threshold": "0"}) as video:
        for number in range(count):
            video.add(numbered_picture(number))
    return path


@pytest.fixture
def video(tmp_path) -> Video:
    found = open_clip(write_video(tmp_path / "cam01.mp4", COUNT))
    assert isinstance(found, Video)
    assert found.key_frames == COUNT
    return found


def copy_of(video: Video, folder: Path, width: int = 1280) -> SeekCopy:
    assert copies_folder(folder)
    made = seek_copy(video, folder, "cam01", width)
    assert made is not None
    return made


def write_all(copy: SeekCopy, near: int = 0) -> list[int]:
    order = []
    while (piece := copy.missing(near)) is not None:
        order.append(piece)
        for _ in copy.write(piece):
            pass
    return order


def test_the_pictures_are_those_of_the_video_in_any_order(video, tmp_path):
    copy = copy_of(video, tmp_path / "copies")
    assert write_all(copy) == [0, 1, 2]
    for frame in (49, 0, 21, 20, 19, 40, 7, 39):
        assert number_of(copy.image(frame)) == frame


def test_key_pictures_are_near(video, tmp_path):
    write_all(copy_of(video, tmp_path / "copies"))
    pieces = sorted(tmp_path.glob("copies/*/*.piece"))
    assert [open_video(piece).count for piece in pieces] == [20, 20, 10]
    for piece in pieces:
        with av.open(str(piece)) as container:
            keys = [n for n, packet in enumerate(p for p in container.demux() if p.size) if packet.is_keyframe]
        assert max(np.diff(keys)) <= KEY_FRAMES


def test_the_piece_that_is_looked_at_is_written_first_and_usable_at_once(video, tmp_path):
    copy = copy_of(video, tmp_path / "copies")
    for _ in copy.write(copy.missing(45)):
        pass
    assert [copy.holds(frame) for frame in (0, 39, 40, 49)] == [False, False, True, True]
    assert number_of(copy.image(44)) == 44
    assert write_all(copy, near=25) == [1, 0]


def test_a_copy_is_used_again_and_one_of_another_version_is_removed(video, tmp_path):
    write_all(copy_of(video, tmp_path / "copies"))
    assert copy_of(video, tmp_path / "copies").missing(0) is None
    other = open_video(write_video(tmp_path / "cam01.mp4", COUNT - 5))
    again = copy_of(other, tmp_path / "copies")
    assert again.missing(0) == 0
    assert not list(tmp_path.glob("copies/*/*.piece"))


def test_a_piece_that_is_not_completed_leaves_nothing(video, tmp_path):
    copy = copy_of(video, tmp_path / "copies")
    writing = copy.write(1)
    next(writing)
    writing.close()
    assert not copy.holds(25)
    assert copy.missing(25) == 1
    assert not [path for path in tmp_path.glob("copies/*/*")]


def test_a_damaged_piece_is_removed_and_its_frames_come_from_elsewhere(video, tmp_path):
    write_all(copy_of(video, tmp_path / "copies"))
    piece = next(iter(tmp_path.glob("copies/*/0001.piece")))
    piece.write_bytes(piece.read_bytes()[:2000])
    copy = copy_of(video, tmp_path / "copies")
    assert copy.holds(25)
    assert copy.image(25) is None
    assert not copy.holds(25)
    assert not piece.exists()
    assert number_of(copy.image(45)) == 45


def test_a_wide_video_is_reduced_by_a_whole_number(video, tmp_path):
    copy = copy_of(video, tmp_path / "copies", width=video.size[0] // 2)
    write_all(copy)
    assert copy.image(3).shape == (video.size[1] // 2, video.size[0] // 2, 3)


def test_a_damaged_video_has_the_other_pieces_only(video, tmp_path):
    class Damaged:
        """The video, of which a frame cannot be decoded."""

        path, size, count = video.path, video.size, video.count

        def images(self, frames):
            for frame in frames:
                if frame == 23:
                    raise FileProblem(video.path, "is damaged")
                yield numbered_picture(frame)

    copy = SeekCopy(Damaged(), tmp_path / "copies", 1280)  # type: ignore[arg-type]
    assert write_all(copy) == [0, 1, 2]
    assert [copy.holds(frame) for frame in (0, 23, 45)] == [True, False, True]


def test_on_a_full_disk_nothing_more_is_written(video, tmp_path, monkeypatch):
    copy = copy_of(video, tmp_path / "copies")

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(module, "VideoWriter", full)
    assert write_all(copy) == [0]
    assert copy.missing(0) is None
    assert not copy.holds(0)


def test_videos_with_near_key_pictures_and_stills_are_not_copied(video, tmp_path):
    assert seek_copy(replace(video, key_frames=12), tmp_path, "cam01", 1280) is None
    assert seek_copy(replace(video, key_frames=13), tmp_path, "cam01", 1280) is not None
    assert cv2.imwrite(str(tmp_path / "a.png"), numbered_picture(1))
    assert seek_copy(open_clip(tmp_path / "a.png"), tmp_path, "cam01", 1280) is None


def test_a_folder_of_the_user_is_left_alone(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    assert not copies_folder(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]
    assert not copies_folder(tmp_path / "notes.txt")


def test_a_reader_goes_on_after_a_damaged_image(video):
    reader = FrameReader(video)
    with pytest.raises(IndexError):
        reader.image(COUNT)
    assert [number_of(reader.image(frame)) for frame in (7, 8, 3)] == [7, 8, 3]
