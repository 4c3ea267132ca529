"""The same names for the same quantities of two motions."""

import numpy as np
import pytest

from marey.errors import FileProblem
from marey.motion.recording import Recording
from marey.pipelines.same_names import read_name_map, same_names


def test_two_names_for_one_quantity_stay_apart():
    time = np.arange(4.0)
    both = Recording(time=time, point_names=("RKJC", "RKnee"), points=np.zeros((4, 2, 3)))
    one = Recording(time=time, point_names=("right_knee",), points=np.zeros((4, 1, 3)))
    first, second = same_names(both, one, {})
    assert (first.point_names, second.point_names) == (("RKJC", "RKnee"), ("right_knee",))


def test_a_name_that_is_given_has_priority_and_inverts_the_sign():
    time = np.arange(4.0)
    first = Recording(time=time, angle_names=("left_knee_flexion",), angles=np.ones((4, 1)))
    second = Recording(time=time, angle_names=("Knie",), angles=np.ones((4, 1)))
    _, named = same_names(first, second, {"angles": {"left_knee_flexion": "-Knie"}})
    assert named.angle_names == ("left_knee_flexion",)
    np.testing.assert_array_equal(named.angles, -1)


def test_a_name_that_is_missing_is_an_error_of_its_file(tmp_path):
    path = tmp_path / "names.toml"
    path.write_text('[angles]\nleft_knee_flexion = "Knie"\n')
    chosen = read_name_map(path)
    both = Recording(time=np.arange(4.0), angle_names=("left_knee_flexion",), angles=np.ones((4, 1)))
    with pytest.raises(FileProblem, match="names the angles Knie, which are not in the motion"):
        same_names(both, both, chosen, path)


def test_a_table_of_another_kind_is_named(tmp_path):
    path = tmp_path / "names.toml"
    path.write_text('[joints]\na = "b"\n')
    with pytest.raises(FileProblem, match="unknown key 'joints'"):
        read_name_map(path)
