import numpy as np
import pytest

from marey.errors import MareyError
from marey.markers.data.trajectories import trajectories


def test_chosen_markers_come_in_the_given_order():
    points = np.random.default_rng(0).normal(size=(4, 3, 3))
    markers = trajectories(("a", "b", "c"), points, 100.0, start_s=2.0)
    chosen = markers.select(["c", "a"])
    assert chosen.labels == ("c", "a")
    np.testing.assert_array_equal(chosen.points, points[:, [2, 0]])
    np.testing.assert_allclose(chosen.time, 2 + np.arange(4) / 100)


def test_a_missing_label_names_those_that_are_there():
    markers = trajectories(("a", "b"), np.zeros((1, 2, 3)), 100.0)
    with pytest.raises(MareyError, match=r"no marker c.*a, b"):
        markers.select(["c"])


def test_labels_that_are_alike_are_rejected():
    with pytest.raises(MareyError, match="label a"):
        trajectories(("a", "a"), np.zeros((1, 2, 3)), 100.0)
