"""Measurements of a person in a C3D."""

import pytest
from tests.marker_set_trials import lower_body, person, standing, write_measured

from marey.io.markers.trial_file import read_marker_file


@pytest.fixture
def write(tmp_path):
    return lambda measured=None: write_measured(tmp_path / "a.c3d", lower_body(person(standing(3))), measured)


def test_the_measurements_of_processing_are_read_in_metres(write):
    found = read_marker_file(write()).person
    assert found.length("left", "knee_width") == pytest.approx(0.1)
    assert found.length("right", "leg_length") == pytest.approx(0.86)
    assert found.diameter_m == pytest.approx(0.014)


def test_zero_is_an_unknown_measurement(write):
    file = read_marker_file(write({"LKneeWidth": 0.0, "RKneeWidth": 95.0, "Height": 1700.0}))
    assert (file.person.lengths, file.person.diameter_m) == ({"right_knee_width": pytest.approx(0.095)}, None)
    assert file.person_notes == ()


def test_an_impossible_measurement_is_ignored_and_named(write):
    file = read_marker_file(write({"LKneeWidth": 9.5, "MarkerDiameter": 140.0}))
    assert (file.person.lengths, file.person.diameter_m) == ({}, None)
    assert file.person_notes == (
        "PROCESSING:LKneeWidth of 9.5 mm is impossible and is ignored.",
        "PROCESSING:MarkerDiameter of 140 mm is impossible and is ignored.",
    )
