import pytest

from marey.cli.options import parse_frames, parse_names, parse_values, wants_everybody
from marey.errors import SettingProblem


def test_frames_may_leave_the_first_away():
    assert parse_frames(":12") == (0, 12)
    for text in ("12:", "a:b", "1:2:3", "-3:4", "", "5:5"):
        with pytest.raises(SettingProblem, match="--frames"):
            parse_frames(text)


def test_names_are_set_apart_by_commas():
    assert parse_names("cam01, cam02,") == ("cam01", "cam02")
    with pytest.raises(SettingProblem, match="--cameras"):
        parse_names(" , ")


def test_people_may_be_all_and_nothing_else():
    assert wants_everybody("all", None)
    assert not wants_everybody(None, "2")
    with pytest.raises(SettingProblem, match="--people is '2'; it should be all"):
        wants_everybody("2", None)
    with pytest.raises(SettingProblem, match="leave out one of them"):
        wants_everybody("all", "2")


def test_values_are_names_with_numbers():
    assert parse_values(None, option="--measurements", example="a=1") == {}
    assert parse_values("knee = 99, ankle=65.5,", option="--measurements", example="a=1") == {
        "knee": 99.0,
        "ankle": 65.5,
    }


@pytest.mark.parametrize(
    ("text", "wrong"),
    [("", "should be names"), ("knee", "contains 'knee'"), ("knee=wide", "'knee=wide'"), ("a=1,a=2", "a twice")],
)
def test_wrong_values_are_named(text, wrong):
    with pytest.raises(SettingProblem, match=f"--measurements .*{wrong}"):
        parse_values(text, option="--measurements", example="a=1")
