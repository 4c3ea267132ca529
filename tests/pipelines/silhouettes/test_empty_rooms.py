"""Backgrounds from images of the empty room, in the sizes of the images in which they are used."""

import shutil

import cv2
import numpy as np
from tests.clips import make_trial

from marey.images.silhouettes.background import shrunk
from marey.io.trial.trial import read_trial
from marey.pipelines.progress import RecordingProgress
from marey.pipelines.silhouettes.empty_rooms import cameras_without_image, empty_rooms, model_backgrounds


def test_the_empty_room_is_that_of_the_cameras_with_images_of_it_in_the_size_of_their_images(tmp_path, rng):
    folder = make_trial(tmp_path, count=6)
    room = rng.integers(0, 255, (6, 8, 3)).repeat(8, 0).repeat(8, 1).astype(np.uint8)
    (folder / "background").mkdir()
    cv2.imwrite(str(folder / "background" / "cam02.png"), room)
    opened = read_trial(folder)
    assert cameras_without_image(opened) == ["cam01"]
    [(number, found)] = empty_rooms(opened, [camera.scaled(0.5) for camera in opened.rig]).items()
    assert number == 1
    whole, _ = model_backgrounds(opened, RecordingProgress())
    wanted = shrunk(whole[1], (32, 24))
    np.testing.assert_array_equal(found.mean, wanted.mean)
    np.testing.assert_array_equal(found.confidence, wanted.confidence)
    shutil.rmtree(folder / "background")
    assert empty_rooms(read_trial(folder), list(opened.rig)) == {}
