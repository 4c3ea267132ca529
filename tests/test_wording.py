"""Names in messages."""

import pytest

from marey.wording import count_of, listed


@pytest.mark.parametrize(
    ("count", "most", "text"),
    [(0, None, "none"), (1, None, "a"), (3, None, "a, b, c"), (3, 3, "a, b, c"), (4, 3, "a, b, c and 1 more")],
)
def test_names_are_joined_and_those_beyond_the_limit_counted(count, most, text):
    assert listed("abcd"[:count], most=most) == text


def test_the_text_for_no_names_can_be_chosen():
    assert listed({}, none="nothing") == "nothing"


def test_a_noun_is_in_the_plural_unless_there_is_one():
    assert [count_of(number, "trial") for number in (0, 1, 2)] == ["0 trials", "1 trial", "2 trials"]
