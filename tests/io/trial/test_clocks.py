import json

import numpy as np
import pytest
from tests.clips import make_trial, write_video

from marey.cameras.clocks import Clocks
from marey.errors import FileProblem, SettingProblem
from marey.io.trial.clocks import read_clocks, write_clocks
from marey.io.trial.trial import read_free_trial, read_trial

NAMES = ("cam01", "cam02", "cam03")


def write(folder, content):
    path = folder / "sync.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def test_what_is_written_is_read(tmp_path):
    clocks = Clocks(
        names=NAMES, offset_s=[0, 0.0123456, -2], drift=[0, 6e-5, -3e-4], offset_sd_s=[0, 1e-3, 2e-3],
        drift_sd=[0, 1e-5, 2e-4],
    )  # fmt: skip
    path = tmp_path / "sync.json"
    write_clocks(path, clocks, undetermined={})
    again = read_clocks(path, NAMES)
    for field in ("offset_s", "drift", "offset_sd_s", "drift_sd"):
        np.testing.assert_allclose(getattr(again, field), getattr(clocks, field), atol=1e-7)
    assert again.names == NAMES


def test_the_first_camera_and_all_numbers_but_the_offset_may_be_missing(tmp_path):
    path = write(tmp_path, {"cameras": {"cam02": {"offset_s": 0.5}, "cam03": {"offset_s": 1}}})
    clocks = read_clocks(path, NAMES)
    np.testing.assert_array_equal(clocks.offset_s, [0, 0.5, 1])
    np.testing.assert_array_equal(clocks.drift, 0)
    some = read_clocks(path, ("cam02", "cam03"), known=NAMES)
    np.testing.assert_array_equal(some.offset_s, [0, 0.5])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "is not JSON"),
        ([1], "has no table called cameras"),
        ({"cameras": [1]}, "has no table called cameras"),
        ({"cameras": {"cam9": {"offset_s": 0}}}, "has the unknown camera 'cam9'"),
        ({"cameras": {"cam02": 3}}, "has the camera 'cam02' with 3, which should be a table"),
        ({"cameras": {"cam02": {}}}, "has the camera 'cam02' without offset_s"),
        ({"cameras": {"cam02": {"offset_s": "1"}}}, "has offset_s = '1' of 'cam02', which should be a number"),
        ({"cameras": {"cam02": {"offset_s": True}}}, "has offset_s = True of 'cam02'"),
        ({"cameras": {"cam02": {"offset_s": None}}}, "has offset_s = None of 'cam02'"),
        ('{"cameras": {"cam02": {"offset_s": NaN}}}', "has offset_s = nan of 'cam02'"),
        ({"cameras": {"cam02": {"offset_s": 0, "drift_ppm": 5e5}}}, "drift_ppm = 500000 of 'cam02'"),
        ({"cameras": {"cam02": {"offset_s": 0, "offset_sd_s": -1}}}, "should not be negative"),
        ({"cameras": {"cam02": {"offset_s": 0}}}, "has no clock of 'cam03'. Select the other cameras"),
        (
            {"cameras": {"cam02": {"offset_s": 0}}, "undetermined": {"cam03": "nothing moves"}},
            "has no clock of 'cam03', because nothing moves",
        ),
    ],
)
def test_what_is_wrong_is_named_in_one_line(tmp_path, content, message):
    with pytest.raises(FileProblem) as caught:
        read_clocks(write(tmp_path, content), NAMES)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def offset_trial(parent, *, frames=0.2):
    """A trial of 25 Hz whose second camera was started later."""
    folder = make_trial(parent, count=12)
    write(folder, {"cameras": {"cam02": {"offset_s": frames}}})
    return folder


def test_a_trial_uses_its_clocks_unless_they_are_switched_off(tmp_path):
    folder = offset_trial(tmp_path)
    trial = read_trial(folder)
    assert trial.clocks is not None
    assert (trial.take.first, trial.take.end, trial.take.count) == (5, 12, 12)
    assert folder / "sync.json" in trial.input_files
    assert "frames 0 to 4, which are ignored" in trial.take.notes[0]
    for other in (read_trial(folder, sync="off"), read_free_trial(folder)):
        assert other.clocks is None
        assert other.take.late is None
        assert folder / "sync.json" not in other.input_files
        assert (other.take.first, other.take.end) == (0, 12)
    with pytest.raises(SettingProblem, match=r"sync \(--sync\) is 'no'"):
        read_trial(folder, sync="no")


def test_clocks_without_a_common_frame_are_refused(tmp_path):
    with pytest.raises(FileProblem, match="has no frame of which all cameras have a picture"):
        read_trial(offset_trial(tmp_path, frames=3.0))


def test_a_free_trial_may_have_videos_of_any_length_and_rate(tmp_path):
    folder = make_trial(tmp_path, count=12)
    write_video(folder / "cam02.mp4", 40, rate=50.0)
    with pytest.raises(FileProblem):
        read_trial(folder)
    trial = read_free_trial(folder)
    assert [clip.count for clip in trial.take.clips] == [12, 40]
    assert trial.take.rate == 25
