"""`marey calibrate` with options of the other kind of calibration."""

from pathlib import Path

import pytest

from marey.cli.calibrate import calibrate
from marey.errors import FileProblem, SettingProblem


def test_options_of_a_board_are_refused_for_a_person(tmp_path):
    with pytest.raises(SettingProblem, match="--board, --distance cannot be used with --from-person"):
        calibrate(tmp_path, from_person=True, board=Path("board.json"), distance=["a:b=1"])


def test_options_of_a_trial_are_refused_for_a_board(tmp_path):
    with pytest.raises(SettingProblem, match="--stature cannot be used without --from-person"):
        calibrate(tmp_path, stature=1.8)


def test_a_person_needs_a_trial(tmp_path):
    with pytest.raises(FileProblem, match="does not exist"):
        calibrate(tmp_path / "nothing", from_person=True)


def test_options_of_other_calibrations_are_refused_for_key_points(tmp_path):
    with pytest.raises(SettingProblem, match="--board, --from-person cannot be used with --from-keypoints"):
        calibrate(tmp_path, from_keypoints=tmp_path, from_person=True, board=Path("board.json"))


def test_focal_lengths_are_only_for_key_points(tmp_path):
    with pytest.raises(SettingProblem, match="--focal cannot be used without --from-keypoints"):
        calibrate(tmp_path, focal="900")


@pytest.mark.parametrize(
    "text", ["wide", "-900", "0", "cam01=", "900,cam01=800", "cam01=900,cam01=800", "inf", "1e300", ""]
)
def test_wrong_focal_lengths_are_refused(tmp_path, text):
    with pytest.raises(SettingProblem, match="it should be like 900 or cam01=900,cam02=950"):
        calibrate(tmp_path, from_keypoints=tmp_path, focal=text)


def test_the_scale_is_kept_only_where_the_world_alone_is_found(tmp_path):
    with pytest.raises(SettingProblem, match="--keep-scale cannot be used without --world-only"):
        calibrate(tmp_path, from_person=True, keep_scale=True)


def test_the_world_needs_a_person(tmp_path):
    with pytest.raises(SettingProblem, match="--world-only cannot be used without --from-keypoints or --from-person"):
        calibrate(tmp_path, world_only=True)
