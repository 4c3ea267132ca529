"""Angles of another program in a C3D."""

import ezc3d
import numpy as np
import pytest
from tests.marker_set_trials import lower_body, person, standing, write_measured

from marey.io.markers.c3d import open_c3d
from marey.io.markers.given_angles import angles_in, read_given_angles, write_given_angles
from marey.io.markers.trial_file import read_marker_file

VALUES = np.array([[10.0, -2.0, 3.0], [0.0, 0.0, 0.0], [20.0, 0.0, 5.0]])


@pytest.fixture
def trial(tmp_path):
    empty = np.full((3, 3), np.nan)
    angles = {"LKneeAngles": VALUES, "RKneeAngles": empty}
    return write_measured(tmp_path / "a.c3d", lower_body(person(standing(3))), angles=angles)


def test_angles_are_read_in_radians_and_zeros_are_gaps(trial):
    file = read_marker_file(trial)
    assert file.angles is not None
    assert file.angles.labels == ("LKneeAngles",)
    expected = np.radians(VALUES)
    expected[1] = np.nan
    np.testing.assert_allclose(file.angles.values[:, 0], expected, atol=1e-6)
    assert "LKneeAngles" not in file.trajectories.labels


def test_radians_are_not_converted(trial):
    c3d = ezc3d.c3d(str(trial))
    c3d.add_parameter("POINT", "ANGLE_UNITS", ["rad"])
    c3d.write(str(trial))
    found = angles_in(open_c3d(trial))
    assert found is not None
    np.testing.assert_allclose(found.values[0, 0], VALUES[0], atol=1e-5)


def test_a_file_without_angles_has_none(tmp_path):
    assert read_marker_file(write_measured(tmp_path / "b.c3d", lower_body(person(standing(3))))).angles is None


def test_the_table_is_read_as_it_was_written(trial, tmp_path):
    given = read_marker_file(trial).angles
    assert given is not None
    write_given_angles(tmp_path / "given_angles.csv", np.arange(3) / 100, given)
    again = read_given_angles(tmp_path / "given_angles.csv")
    assert again.labels == given.labels
    np.testing.assert_allclose(again.values, given.values, atol=1e-6)


def test_angles_of_plug_in_gait_need_no_list(trial):
    c3d = ezc3d.c3d(str(trial))
    c3d["parameters"]["POINT"]["ANGLES"]["value"] = []
    c3d.write(str(trial))
    found = angles_in(open_c3d(trial))
    assert found is not None
    assert found.labels == ("LKneeAngles",)
