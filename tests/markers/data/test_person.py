"""Measurements of a person, and those that are assumed."""

import pytest

from marey.markers.data.person import (
    ASSUMED_WIDTHS,
    OTHER_SIDE_SD_M,
    AssumedMeasurement,
    PersonMeasurements,
    assumed_text,
)


def test_a_known_width_is_not_assumed():
    assert PersonMeasurements(lengths={"left_knee_width": 0.09}).width("left", "knee_width") == 0.09
    assert PersonMeasurements(diameter_m=0.0095).diameter() == 0.0095


def test_the_other_side_comes_before_other_people():
    found = PersonMeasurements(lengths={"left_knee_width": 0.09}).width("right", "knee_width")
    assert isinstance(found, AssumedMeasurement)
    assert (found.name, found.value_m, found.sd_m, found.of_others) == (
        "right_knee_width",
        0.09,
        OTHER_SIDE_SD_M,
        False,
    )
    assert assumed_text([found]) == "right knee width 90 mm, standard deviation 2.5 mm (that of the left side)"


@pytest.mark.parametrize("what", ASSUMED_WIDTHS)
def test_without_any_measurement_the_mean_of_other_people_is_assumed(what):
    found = PersonMeasurements().width("left", what)
    assert isinstance(found, AssumedMeasurement)
    assert (found.value_m, found.sd_m) == ASSUMED_WIDTHS[what]
    assert found.of_others


def test_a_value_replaces_one_measurement():
    person = PersonMeasurements(lengths={"left_knee_width": 0.09}, diameter_m=0.014)
    assert person.with_value("left_knee_width", 0.1).lengths == {"left_knee_width": 0.1}
    assert person.with_value("marker_diameter", 0.01).diameter_m == 0.01


def test_equal_assumptions_are_stated_together():
    found = [PersonMeasurements().width(side, "knee_width") for side in ("left", "right")]
    found.append(PersonMeasurements().diameter())
    assert assumed_text(one for one in found if isinstance(one, AssumedMeasurement)) == (
        "left knee width and right knee width 100 mm, standard deviation 9.0 mm (the mean of other people); marker "
        "diameter 14 mm, standard deviation 3.0 mm (the usual diameter)"
    )
