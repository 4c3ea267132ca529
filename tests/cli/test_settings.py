from pathlib import Path

import pytest

from marey.cli.settings import CaptureSettings, from_trial, parse_frames
from marey.errors import SettingProblem


def test_an_option_wins_over_the_trials_own_file_and_none_leaves_it():
    given = from_trial({"stature_m": 1.7, "preset": "upper", "cameras": ["a", "b"], "unknown": 1, "rate": None})
    settings = given.with_options(preset="full", stature_m=None)
    assert (settings.preset, settings.stature_m, settings.cameras) == ("full", 1.7, ("a", "b"))


def test_all_faults_are_told_at_once():
    with pytest.raises(SettingProblem, match=r"preset is 'tail'.*stature_m is 180.*frames are 5 to 5"):
        CaptureSettings(preset="tail", stature_m=180.0, frames=(5, 5))


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 0.0, -1.0])
def test_impossible_numbers_are_refused(value):
    for name in ("stature_m", "mass_kg", "rate"):
        with pytest.raises(SettingProblem, match=name):
            CaptureSettings(**{name: value})


def test_frames_may_leave_the_first_away():
    assert parse_frames(":12") == (0, 12)
    for text in ("12:", "a:b", "1:2:3", "-3:4", ""):
        with pytest.raises(SettingProblem, match="--frames"):
            parse_frames(text)


def test_settings_become_text_for_the_record():
    text = CaptureSettings(start=Path("clicks.json"), frames=(1, 2)).as_text()
    assert text["start"] == "clicks.json"
    assert text["frames"] == (1, 2)
