import numpy as np
import pytest
from tests.clips import make_trial, number_of, write_video
from tests.made_walk import clocks

from marey.io.calibration.readers import read_rig
from marey.io.video.common_frames import common_frames
from marey.io.video.take import open_take


@pytest.mark.parametrize("offset", [0.0, 0.37, -2.6, 5.25, 13.0])
def test_the_picture_of_a_frame_is_at_most_half_a_frame_late(offset):
    true = clocks([0, offset], [0, 3e-4])
    found = common_frames(true, [100, 100], [30.0, 30.0])
    first, end = found.complete
    np.testing.assert_array_equal(found.pictures[0], np.arange(100))
    np.testing.assert_array_equal(found.late[0], 0)
    assert np.abs(found.late[:, first:end]).max() <= 0.5 + 1e-9
    instants = true.instants(1, found.pictures[1] / 30) * 30
    np.testing.assert_allclose(found.late[1], instants - np.arange(100), atol=1e-9)
    assert end - first == pytest.approx(100 - abs(offset), abs=1)
    assert np.all(np.diff(found.pictures[1]) >= 0)


def test_frames_have_the_lowest_rate():
    found = common_frames(clocks([0, 1, 0.4]), [120, 61, 60], [60.0, 30.0, 30.0])
    assert found.rate == 30
    assert found.pictures.shape == (3, 60)
    np.testing.assert_array_equal(found.pictures[0], np.arange(0, 120, 2))
    np.testing.assert_array_equal(found.pictures[1, 1:], np.arange(59))


def test_clocks_that_do_not_overlap_have_no_complete_frame():
    assert common_frames(clocks([0, 200]), [100, 100], [30.0, 30.0]).complete == (0, 0)


def test_a_take_reads_the_pictures_of_its_clocks(tmp_path):
    folder = make_trial(tmp_path, count=12)
    write_video(folder / "cam02.mp4", 20)
    # Four frames of 25 Hz are 4.8 of the made clocks' 30 Hz.
    take = open_take(folder, read_rig(folder), clocks=clocks([0, -4.8]))
    assert (take.count, take.first, take.end, take.rate) == (12, 0, 12, 25.0)
    seen = [[number_of(image) for image in images] for _, images in take.frames()]
    assert seen == [[frame, frame + 4] for frame in range(12)]
    assert take.late is not None
    np.testing.assert_allclose(take.late, 0, atol=1e-9)
    assert [number_of(image) for image in take.images(3)] == [3, 7]
    assert {path.name for clip in take.clips for path in clip.paths} == {"cam01.mp4", "cam02.mp4"}
