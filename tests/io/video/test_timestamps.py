from fractions import Fraction

import av
import numpy as np
import pytest
from tests.clips import make_trial, number_of, numbered_picture, write_video

from marey.errors import FileProblem
from marey.io.calibration.readers import read_rig
from marey.io.trial.trial import read_trial
from marey.io.video.take import open_take
from marey.io.video.video import open_clip


def write_variable(path, ticks, numbers):
    """Write a video whose pictures are shown at given ticks of 1/100 s."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        stream.codec_context.time_base = Fraction(1, 100)
        for tick, number in zip(ticks, numbers, strict=True):
            frame = av.VideoFrame.from_ndarray(numbered_picture(number), format="bgr24")
            frame.pts, frame.time_base = tick, Fraction(1, 100)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def write_table(folder, rows, heading="camera,time_s"):
    (folder / "timestamps.csv").write_text("\n".join([heading, *rows]) + "\n")


def test_cameras_of_different_rates_are_assumed_to_begin_together(tmp_path):
    folder = make_trial(tmp_path, count=12)
    write_video(folder / "cam02.mp4", 24, rate=50.0)
    take = open_take(folder, read_rig(folder))
    assert take.rate == 25
    assert (take.first, take.end, take.count) == (0, 12, 12)
    assert [[number_of(image) for image in images] for _, images in take.frames()][:4] == [
        [0, 0],
        [1, 2],
        [2, 4],
        [3, 6],
    ]
    np.testing.assert_allclose(take.late, 0, atol=1e-9)
    assert "different frame rates" in take.notes[0]
    assert read_trial(folder).clocks is None


def test_a_constant_rate_has_no_times_of_its_own(tmp_path):
    assert open_clip(write_video(tmp_path / "cam01.mp4", 12)).seconds is None


def test_dropped_pictures_are_found_by_the_times_of_the_container(tmp_path):
    folder = make_trial(tmp_path, count=12)
    kept = [0, 1, 2, 5, 6, 7, 8, 9, 10, 11]
    write_variable(folder / "cam02.mp4", [4 * number for number in kept], kept)
    clip = open_clip(folder / "cam02.mp4")
    np.testing.assert_allclose(clip.seconds, np.array(kept) / 25, atol=1e-9)
    take = open_take(folder, read_rig(folder))
    assert take.rate == pytest.approx(25)
    shown = [[number_of(image) for image in images] for _, images in take.frames()]
    assert [first for first, _ in shown] == list(range(12))
    assert [second for _, second in shown] == [0, 1, 2, 2, 5, 5, 6, 7, 8, 9, 10, 11]
    np.testing.assert_allclose(take.late[1], [0, 0, 0, -1, 1, 0, 0, 0, 0, 0, 0, 0], atol=1e-6)
    assert "varies" in take.notes[0]


def test_a_table_of_timestamps_states_the_instants_of_all_pictures(tmp_path):
    folder = make_trial(tmp_path, count=12)
    own = [f"cam01,{100 + k / 25}" for k in range(12)]
    other = [f"cam02,{100 + (k + 2.3) / 25}" for k in range(12)]
    write_table(folder, [*other[::-1], *own], "camera,time_s")
    with pytest.raises(FileProblem, match="not ascending"):
        open_take(folder, read_rig(folder))
    write_table(folder, [*other, *own])
    trial = read_trial(folder)
    np.testing.assert_allclose(trial.clocks.offset_s, [0, 2.3 / 25], atol=1e-9)
    first = trial.take.first
    assert first == 2
    assert [number_of(image) for image in trial.take.images(first)] == [2, 0]
    np.testing.assert_allclose(trial.take.late[1, first:], 0.3, atol=1e-9)
    assert folder / "timestamps.csv" in trial.input_files
    assert read_trial(folder, sync="off").take.late is None


def test_the_columns_of_caliscope_are_read(tmp_path):
    folder = make_trial(tmp_path, count=3)
    rows = [f"{k},{port},{k},{50 + k / 25 + 0.01 * port}" for k in (2, 0, 1) for port in (1, 2)]
    write_table(folder, rows, "sync_index,port,frame_index,frame_time")
    np.testing.assert_allclose(read_trial(folder).clocks.offset_s, [0, 0.01], atol=1e-9)
    (folder / "timestamps.csv").rename(folder / "frame_time_history.csv")
    np.testing.assert_allclose(read_trial(folder).clocks.offset_s, [0, 0.01], atol=1e-9)


def test_each_camera_may_have_its_own_file(tmp_path):
    folder = make_trial(tmp_path, count=3)
    (folder / "cam01_timestamps.csv").write_text("time\n0.0\n0.04\n0.08\n")
    with pytest.raises(FileProblem, match="no timestamps of 'cam02'"):
        open_take(folder, read_rig(folder))
    (folder / "cam02_timestamps.csv").write_text("0,0.012\n1,0.052\n2,0.092\n")
    np.testing.assert_allclose(read_trial(folder).clocks.offset_s, [0, 0.012], atol=1e-9)


@pytest.mark.parametrize(
    ("rows", "heading", "message"),
    [
        (["cam01,0", "cam01,x", "cam01,2"], "camera,time_s", "'x' where a number is expected"),
        (["cam01,0"], "camera,when", "has the columns camera, when"),
        ([], "", "has the columns of an empty file"),
        (["cam01,0", "cam01,1"], "camera,time_s", "no timestamps of 'cam02'"),
        (["cam01,0", "cam01,1", "cam02,1"], "camera,time_s", "2 timestamps of 'cam01', whose video has 3 pictures"),
        (["9" * 4400 + ",0"], "cam_id,frame_time", "no timestamps of 'cam01'"),
        (["cam01,0", "cam01,nan", "cam01,2", *["cam02,1"] * 3], "camera,time_s", "not ascending numbers"),
    ],
)
def test_wrong_tables_are_named(tmp_path, rows, heading, message):
    folder = make_trial(tmp_path, count=3)
    write_table(folder, rows, heading)
    with pytest.raises(FileProblem, match=message):
        open_take(folder, read_rig(folder))
