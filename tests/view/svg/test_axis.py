import re

import pytest

from marey.view.svg.axis import SvgAxis


@pytest.mark.parametrize(("low", "high"), [(0.0, 7.3), (-12.0, 40.0), (0.001, 0.0042), (1e5, 3e5)])
def test_lines_are_at_round_numbers_and_the_labels_state_where_they_are(low, high):
    axis = SvgAxis(low=low, high=high, left=100.0, right=300.0)
    parts = axis.grid(5, 50)
    places = [float(x) for part in parts for x in re.findall(r'<line class="grid" x1="([\d.]+)"', part)]
    numbers = [float(text.replace("−", "-")) for part in parts for text in re.findall(r">([^<>]+)</text>", part)]
    assert 2 <= len(places) == len(numbers) <= 10
    assert all(low <= number <= high for number in numbers)
    for place, number in zip(places, numbers, strict=True):
        assert place == pytest.approx(axis.place(number), abs=0.05 + 200 * 5e-4)


def test_numbers_beyond_an_end_are_drawn_at_the_end():
    axis = SvgAxis(low=0.0, high=10.0, left=100.0, right=300.0)
    assert [axis.place(value) for value in (-5.0, 0.0, 2.5, 10.0, 99.0)] == [100.0, 100.0, 150.0, 300.0, 300.0]
