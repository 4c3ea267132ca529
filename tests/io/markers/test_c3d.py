"""Points that are added to a C3D."""

import ezc3d
import numpy as np
import pytest
from tests.trials import write_trial

from marey.io.markers.c3d import add_points
from marey.io.markers.trial_file import read_marker_file


@pytest.mark.parametrize("count", [3, 254, 300])
def test_added_points_follow_those_of_the_file_also_beyond_the_255th(tmp_path, count):
    rng = np.random.default_rng(2)
    points = {f"m{n}": rng.normal(size=(5, 3)) for n in range(count)}
    path = write_trial(tmp_path / "a.c3d", points)
    added = {"left_HJC": rng.normal(size=(5, 3)), "m1": rng.normal(size=(5, 3)), "left_KJC": rng.normal(size=(5, 3))}
    added["left_KJC"][2] = np.nan
    c3d = ezc3d.c3d(str(path))
    add_points(c3d, {label: 1e3 * places for label, places in added.items()})
    c3d.write(str(path))
    found = read_marker_file(path).trajectories
    assert found.labels == (*points, "left_HJC", "left_KJC")
    for label, places in {**points, **added}.items():
        np.testing.assert_allclose(found.select([label]).points[:, 0], places, atol=1e-6)


def test_trajectories_without_a_label_keep_their_numbers(tmp_path):
    path = write_trial(tmp_path / "a.c3d", {name: np.ones((4, 3)) for name in "abc"})
    c3d = ezc3d.c3d(str(path))
    c3d["parameters"]["POINT"]["LABELS"]["value"] = ["a"]
    add_points(c3d, {"new": np.full((4, 3), 5.0)})
    c3d.write(str(path))
    assert read_marker_file(path).trajectories.labels == ("a", "*1", "*2", "new")
