import numpy as np
import pytest
from tests.surfaces import no_points, some_points

from marey.errors import SettingProblem
from marey.surface.points.measured import MeasuredPoints, joined


def test_points_are_found_by_their_frame(rng):
    points = some_points(rng, [2, 2, 5, 7, 7, 7])
    assert points.frames.tolist() == [2, 5, 7]
    assert points.of_frame(7).frame.tolist() == [7, 7, 7]
    np.testing.assert_array_equal(points.of_frame(5).points, points.points[2:3])
    assert len(points.of_frame(6)) == 0


def test_parts_join_to_the_whole(rng):
    points = some_points(rng, [0, 1, 1, 4])
    again = joined([points.of_frame(frame) for frame in range(5)])
    for name, array in points.arrays().items():
        np.testing.assert_array_equal(array, again.arrays()[name])


def test_the_template_is_the_camera_with_correlation_one(rng):
    points = some_points(rng, [0, 0, 0])
    assert points.template.tolist() == [1, 1, 1]
    assert points.views.tolist() == [2, 3, 3]


def test_arrays_that_do_not_belong_together_are_named(rng):
    points = some_points(rng, [0, 1, 1])
    with pytest.raises(SettingProblem, match=r"residual_px has the shape \(2,\) instead of \(3,\)"):
        MeasuredPoints(**{**points.arrays(), "residual_px": points.residual_px[:2]})
    with pytest.raises(SettingProblem, match="values of frame decrease"):
        MeasuredPoints(**{**points.arrays(), "frame": [0, 2, 1]})
    with pytest.raises(SettingProblem, match="same cameras"):
        joined([points, no_points(["a", "b", "c"])])


def test_a_surface_without_points_is_one(rng):
    nothing = no_points(["left", "right"])
    assert len(nothing) == 0
    assert nothing.points.shape == (0, 3)
    assert len(joined([nothing, nothing])) == 0
