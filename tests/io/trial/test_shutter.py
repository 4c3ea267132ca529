import numpy as np
import pytest
from tests.pipelines.capture.reach import copy_trial

from marey.errors import FileProblem
from marey.io.trial.trial import read_trial


def opened(folder, text, **changes):
    trial = copy_trial(folder)
    (trial / "trial.toml").write_text(text)
    return read_trial(trial, **changes)


def test_without_a_readout_all_rows_are_of_one_instant(tmp_path):
    assert opened(tmp_path / "reach", "readout_s = 0\n").shutter is None


def test_one_readout_holds_for_all_cameras(tmp_path):
    shutter = opened(tmp_path / "reach", 'readout_s = 0.02\nreadout_from = "left"\n').shutter
    np.testing.assert_array_equal(shutter.readout_s, np.full(4, 0.02))
    assert shutter.sides == ("left",) * 4


def test_readouts_by_camera_keep_to_the_cameras_that_are_used(tmp_path):
    text = 'readout_s = {cam02 = 0.02, cam03 = 0.01}\nreadout_from = {cam03 = "bottom"}\n'
    shutter = opened(tmp_path / "reach", text, cameras=("cam03", "cam01")).shutter
    np.testing.assert_array_equal(shutter.readout_s, [0.0, 0.01])
    assert shutter.sides == ("top", "bottom")


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ("readout_s = {cam07 = 0.02}\n", "has readout_s of the unknown camera 'cam07'"),
        ('readout_from = {kamera = "top"}\n', "has readout_from of the unknown camera 'kamera'"),
        ("readout_s = {cam02 = 0.05}\n", "has a readout_s of 'cam02' above the time of one picture"),
        ("readout_s = -0.01\n", "has readout_s = -0.01"),
        ("readout_s = 20\n", "has readout_s = 20"),
        ('readout_from = "above"\n', "has readout_from = 'above'"),
    ],
)
def test_wrong_readouts_are_one_line(tmp_path, text, wrong):
    with pytest.raises(FileProblem) as caught:
        opened(tmp_path / "reach", text)
    assert wrong in str(caught.value)
    assert "\n" not in str(caught.value)
