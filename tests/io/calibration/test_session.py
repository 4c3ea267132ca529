"""Folders of a calibration session: cameras, and which pictures are synchronous."""

from pathlib import Path

import numpy as np
import pytest

from marey.errors import FileProblem
from marey.io.calibration.session import open_session
from marey.io.video.pictures import write_picture


def write(path: Path, size: tuple[int, int] = (8, 6)) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_picture(path, np.zeros((size[1], size[0], 3), np.uint8))


def test_pictures_are_grouped_by_camera_and_number(tmp_path: Path):
    for name in ("left_01.jpg", "left_03.jpg", "right_01.png", "cam01_07.jpg", "cam02_3.jpg"):
        write(tmp_path / name)
    session = open_session(tmp_path)
    assert session.names == ("cam01", "cam02", "left", "right")
    assert [each.instants for each in session.clips] == [(7,), (3,), (1, 3), (1,)]
    assert session.instants == (1, 3, 7)
    assert session.picture_name(3) == "picture 3"
    assert session.rate is None


def test_pictures_in_folders_are_grouped_by_folder(tmp_path: Path):
    for camera in ("a", "b"):
        for number in (2, 10):
            write(tmp_path / camera / f"img_{number}.png")
    session = open_session(tmp_path)
    assert session.names == ("a", "b")
    assert session.clips[0].instants == (2, 10)
    assert [path.name for path in session.clips[0].clip.paths] == ["img_2.png", "img_10.png"]


def test_a_folder_without_pictures_is_refused(tmp_path: Path):
    with pytest.raises(FileProblem, match="neither videos nor numbered pictures"):
        open_session(tmp_path)
    with pytest.raises(FileProblem, match="is not a folder"):
        open_session(tmp_path / "absent")
