"""The texts that name a person, and what is wrong with those that do not."""

import pytest
from tests import worlds

from marey.cameras.rig import Rig
from marey.errors import SettingProblem
from marey.io.trial.person_choice import (
    PersonBox,
    PersonClick,
    PersonNumber,
    PersonPlace,
    check_person,
    parse_person,
    text_of,
)

CHOICES = {
    "2": PersonNumber(2),
    "cam01:310,220.5@40": PersonClick("cam01", 310, 220.5, 40),
    "cam01:250,80,370,400@0": PersonBox("cam01", 250, 80, 370, 400, 0),
    "-0.4,1.2,0.9@40": PersonPlace(-0.4, 1.2, 0.9, 40),
    "0.4,1.2,0": PersonPlace(0.4, 1.2, 0.0),
}


@pytest.mark.parametrize("text", CHOICES)
def test_a_choice_is_read_and_written(text):
    assert parse_person(text) == CHOICES[text]
    assert text_of(CHOICES[text]) == text


def test_a_number_may_be_a_number_and_spaces_are_ignored():
    assert parse_person(3) == PersonNumber(3)
    assert parse_person(" cam 1 : 3, 4 @ 5 ") == PersonClick("cam 1", 3, 4, 5)


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ("0", "begin with 1"),
        ("-2", "begin with 1"),
        ("somebody", "it should be a number"),
        ("1,2", "it should be a number"),
        ("cam01:1,2,3@4", "it should be a number"),
        ("cam01:1,two@4", "it should be a number"),
        ("cam01:1,2", "lacks the frame"),
        ("cam01:1,2@last", "'last' after @ is not the number of a frame"),
        ("cam01:30,10,20,40@4", "X0 < X1"),
    ],
)
def test_a_malformed_choice_is_one_clear_line(text, wrong):
    with pytest.raises(SettingProblem, match=wrong) as problem:
        parse_person(text)
    assert "--person" in str(problem.value)
    assert "\n" not in str(problem.value)


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ("cam09:1,1@3", "no camera 'cam09'; there are cam01, cam02"),
        ("cam01:1,1@30", "no frame 30; the frames in use are 2 to 9"),
        ("0,0,0@1", "no frame 1"),
        ("cam01:200,1@3", "outside of the images of cam01, which are 200 x 240 pixels"),
        ("cam01:-9,-9,-2,-2@3", "outside of the images"),
    ],
)
def test_a_choice_that_does_not_exist_is_an_error(text, wrong):
    with pytest.raises(SettingProblem, match=wrong):
        check_person(parse_person(text), Rig(worlds.ring(2)), range(2, 10))


@pytest.mark.parametrize("text", ["7", "cam02:199,239@9", "1,2,3", "cam01:-5,-5,20,20@2"])
def test_a_choice_that_exists_passes(text):
    check_person(parse_person(text), Rig(worlds.ring(2)), range(2, 10))
