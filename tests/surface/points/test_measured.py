import numpy as np
import pytest
from scipy.spatial import cKDTree
from tests import scenes
from tests.surfaces import no_points, some_points

from marey.errors import SettingProblem
from marey.surface.points.measured import MeasuredPoints, joined, without_repeats


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


def twice(rng, *, spacing_m=0.002, apart_m=0.0):
    """A plane before two cameras, measured by a template of each: on two grids, the second `apart_m` behind the first.

    Returns:
        The cameras, and the points, of which the second template's have the smaller variance on the right.
    """
    rig = scenes.rig(-10, 10)
    parts = []
    for view in range(2):
        x, z = np.meshgrid(np.arange(-0.05, 0.05, spacing_m), np.arange(-0.05, 0.05, spacing_m))
        points = np.stack([x.ravel(), np.full(x.size, view * apart_m), z.ravel()], axis=-1)
        points[:, [0, 2]] += view * 0.3 * spacing_m
        count = len(points)
        variance = np.where(points[:, 0] > 0, [1.0, 0.5][view], 1.0 + view) * 1e-8
        correlation = np.full((count, 2), 0.9)
        correlation[:, view] = 1.0
        parts.append(
            MeasuredPoints(
                frame=np.zeros(count), points=points, covariance=variance[:, None, None] * np.eye(3),
                camera_names=rig.names, pixels=np.stack([c.project(points) for c in rig], axis=1),
                correlation=correlation, residual_px=np.zeros(count), colour=np.zeros((count, 3)),
            )
        )  # fmt: skip
    spacing = float(np.median(np.diff(np.unique(parts[0].pixels[:50, 0, 0]))))
    return rig, joined(parts), spacing


def test_a_place_that_two_templates_measured_appears_once_with_the_smaller_variance(rng):
    rig, points, spacing = twice(rng)
    once = without_repeats(points, rig.cameras, spacing=spacing)
    assert len(once) == pytest.approx(len(points) / 2, rel=0.05)
    left, right = (once.template[side] for side in (once.points[:, 0] < -0.003, once.points[:, 0] > 0.003))
    assert (left == 0).mean() > 0.95
    assert (right == 1).mean() > 0.95
    # No holes: every place of either template has a point beside it.
    away = cKDTree(once.points).query(points.points)[0]
    assert away.max() < 1.1 * 0.002


def test_points_of_another_depth_are_another_surface(rng):
    rig, points, spacing = twice(rng, apart_m=0.05)
    assert len(without_repeats(points, rig.cameras, spacing=spacing)) == len(points)


def test_points_of_one_template_all_stay(rng):
    rig, points, spacing = twice(rng)
    own = points[points.template == 1]
    assert len(without_repeats(own, rig.cameras, spacing=10 * spacing)) == len(own)
    assert len(without_repeats(own[:0], rig.cameras, spacing=spacing)) == 0
