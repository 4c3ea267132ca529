"""The times of all pictures, as Caliscope stores them."""

import numpy as np
import pytest
from tests.clips import calibration_text, number_of, write_video

from marey.errors import FileProblem
from marey.io.trial.timestamps import find_timestamps, line_clocks, read_timestamps
from marey.io.trial.trial import read_trial


def write_times(path, times, *, header="cam_id,frame_time"):
    rows = [(name, float(time)) for name, own in times.items() for time in own]
    rows.sort(key=lambda row: row[1])
    path.write_text("\n".join([header, *(f"{name},{time!r}" for name, time in rows)]) + "\n")


def trial(tmp_path, times, *, counts=(12, 12)):
    (tmp_path / "cameras.toml").write_text(calibration_text(("cam_0", "cam_1")))
    for name, count in zip(("cam_0", "cam_1"), counts, strict=True):
        write_video(tmp_path / f"{name}.mp4", count)
    write_times(tmp_path / "timestamps.csv", times)
    return tmp_path


def test_pictures_are_paired_by_their_times(tmp_path):
    """The second camera begins 2.3 frames later; its nearest picture of frame f is f - 2, 0.3 frames late."""
    own = 100 + np.arange(12) / 25
    opened = read_trial(trial(tmp_path, {"0": own, "1": own + 2.3 / 25}))
    take = opened.take
    assert (take.first, take.end, take.count) == (2, 12, 12)
    assert np.isclose(take.rate, 25)
    assert take.late is not None
    assert np.allclose(take.late[1, 2:], 0.3)
    assert [[number_of(image) for image in images] for _, images in take.at([2, 7])] == [[2, 0], [7, 5]]
    assert opened.clocks is not None
    assert np.allclose(opened.clocks.offset_s, [0, 2.3 / 25])
    assert tmp_path / "timestamps.csv" in opened.input_files


def test_dropped_pictures_do_not_shift_the_others(tmp_path):
    own = np.arange(12) / 25
    kept = np.delete(own, [4, 5])
    take = read_trial(trial(tmp_path, {"0": own, "1": kept}, counts=(12, 10))).take
    assert take.common is not None
    assert take.common.pictures[1].tolist() == [0, 1, 2, 3, 3, 4, 4, 5, 6, 7, 8, 9]
    late = take.common.late[1]
    assert np.allclose(late[[4, 5]], [-1, 1])
    assert np.allclose(np.delete(late, [4, 5]), 0)


def test_lines_through_the_times_are_clocks():
    own = np.arange(200) / 30
    clocks = line_clocks({"a": 5 + own, "b": 5.02 + own * (1 + 4e-5)}, [30.0, 30.0])
    assert np.allclose(clocks.offset_s, [0, 0.02])
    assert np.allclose(clocks.drift, [0, 4e-5])
    other = line_clocks({"a": 5 + own, "b": 5.02 + own}, [30.0, 60.0])
    assert np.allclose(other.instants(1, np.array([1.0])), 0.02 + 60 / 30)


@pytest.mark.parametrize("header", ["cam_id,frame_time", "port,frame_time", '"camera","time_s"'])
def test_columns_have_the_names_of_all_versions(tmp_path, header):
    path = tmp_path / "frame_time_history.csv"
    write_times(path, {"0": [0.0, 1.0], "cam_1": [0.5, 1.5]}, header=header)
    assert find_timestamps(tmp_path) == path
    times = read_timestamps(path, ["cam_0", "cam_1"])
    assert {name: own.tolist() for name, own in times.items()} == {"cam_0": [0.0, 1.0], "cam_1": [0.5, 1.5]}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("cam_id,frame_time\n0,0\n0,x\n", "no camera and time in line 3"),
        ("cam_id,frame_time\n0,0\n0\n", "no camera and time in line 3"),
        ("cam_id,frame_time\n0,0\n0,1\n", "has 0 times of 'cam_1'"),
        ("cam_id,frame_time\n0,0\n0,nan\n1,0\n1,1\n", "has 2 times of 'cam_0' that are numbers"),
        ("cam_id,frame_time\n0,1\n0,1\n1,0\n1,1\n", "two pictures of 'cam_0' at one time"),
        ("cam_id,frame_time\n0,0\n0,1\n0,2\n0,1e30\n1,0\n1,1\n", "with long pauses between them"),
        ("cam_id,frame_time\n0,0\n0,1\n1,0\n1,1\n", "has 12 pictures, but 2 times of 'cam_0'"),
    ],
)
def test_wrong_times_are_named(tmp_path, text, message):
    folder = trial(tmp_path, {})
    (folder / "timestamps.csv").write_text(text)
    with pytest.raises(FileProblem, match=message):
        read_trial(folder)
    assert read_trial(folder, sync="off").take.common is None


def test_another_csv_is_not_a_file_of_times(tmp_path):
    folder = trial(tmp_path, {})
    (folder / "timestamps.csv").write_text("event,when\nheel strike,0.3\n")
    assert read_trial(folder).take.common is None
