"""Measurements of a person in a C3D."""

import ezc3d
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
        "PROCESSING:LKneeWidth of 9.5 is impossible and is ignored.",
        "PROCESSING:MarkerDiameter of 140 is impossible and is ignored.",
    )


def test_the_measurements_are_in_millimetres_also_beside_points_in_metres(tmp_path):
    path = write_measured(tmp_path / "a.c3d", lower_body(person(standing(3))), {"LKneeWidth": 95.0, "RKneeWidth": 0.09})
    c3d = ezc3d.c3d(str(path))
    c3d["parameters"]["POINT"]["UNITS"]["value"] = ["m"]
    c3d["data"]["points"][:3] *= 1e-3
    c3d.write(str(path))
    found = read_marker_file(path).person
    assert found.length("left", "knee_width") == pytest.approx(0.095)
    assert found.length("right", "knee_width") == pytest.approx(0.09)


def test_other_groups_complete_processing(write):
    path = write({"LKneeWidth": 95.0})
    c3d = ezc3d.c3d(str(path))
    for group, name, value in (("ANALYSIS", "LeftKneeWidth", 90.0), ("ANALYSIS", "RightAnkleWidth", 66.0),
                               ("SUBJECTS", "R Knee_Width", 97.0), ("SUBJECT", "LAnkleWidth", 700.0)):  # fmt: skip
        c3d.add_parameter(group, name, [value])
    c3d.write(str(path))
    file = read_marker_file(path)
    assert file.person.lengths == {
        "left_knee_width": pytest.approx(0.095), "right_ankle_width": pytest.approx(0.066),
        "right_knee_width": pytest.approx(0.097),
    }  # fmt: skip
    assert file.person_notes == ("SUBJECT:LAnkleWidth of 700 is impossible and is ignored.",)


def test_rotations_of_the_axes_are_not_used_and_named(write):
    file = read_marker_file(write({"LThighRotation": 12.0, "RThighRotation": 0.0}))
    assert file.person_notes == (
        "PROCESSING:LThighRotation of 12 degrees is not used: the plane is that of the markers.",
    )


def test_prefixes_of_subjects_have_their_names(write):
    path = write()
    c3d = ezc3d.c3d(str(path))
    c3d.add_parameter("SUBJECTS", "NAMES", ["Ann", "Bo"])
    c3d.add_parameter("SUBJECTS", "LABEL_PREFIXES", ["Ann:", "B_", "C:"])
    c3d.write(str(path))
    assert read_marker_file(path).subjects == {"Ann:": "Ann", "B_": "Bo", "C:": "C"}


def test_empty_prefixes_are_none(write):
    path = write()
    c3d = ezc3d.c3d(str(path))
    c3d.add_parameter("SUBJECTS", "LABEL_PREFIXES", [""])
    c3d.write(str(path))
    assert read_marker_file(path).subjects == {}
