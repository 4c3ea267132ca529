"""`marey calibrate` with options of the other kind of calibration."""

from pathlib import Path

import pytest

from marey.cli.cameras import calibrate
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
