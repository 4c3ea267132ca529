"""Points of a take: patches, and the model's standard deviation."""

import numpy as np
import pytest
from tests.fit import metaball_worlds as world

from marey.body.articulation.pose import PosedBody
from marey.fit.points.surface_points import FramePoints, PersonPoints, patch_counts, thinned_evenly


def test_points_of_one_patch_count_together():
    points = np.array([[0.001, 0.0, 0.0], [0.004, 0.002, 0.0], [0.5, 0.0, 0.0]])
    np.testing.assert_array_equal(patch_counts(points, 0.01), [2, 2, 1])
    assert len(patch_counts(np.zeros((0, 3)), 0.01)) == 0


def test_too_many_points_are_thinned_evenly():
    points = FramePoints(np.arange(300.0).reshape(100, 3), np.zeros((100, 3, 3)))
    few = thinned_evenly(points, 10)
    assert len(few) == 10
    np.testing.assert_array_equal(few.points[[0, -1], 0], [0, 297])
    assert thinned_evenly(points, 1000) is points


@pytest.fixture(scope="module")
def scene():
    rng = np.random.default_rng(8)
    space = world.arm_space()
    body = world.person(space, np.zeros(len(space)))
    pose = world.arm_poses(rng, 1)[0]
    return body, pose, world.measured(body, pose, 4000, 0.001, rng)


@pytest.mark.parametrize("scale", [np.inf, 0.02])
def test_the_models_standard_deviation_is_recovered(scene, scale):
    """Points a millimetre off by measurement, three by the model."""
    body, pose, points = scene
    rng = np.random.default_rng(2)
    rough = FramePoints(points.points + rng.normal(size=points.points.shape) * 0.003, points.covariance)
    person = PersonPoints(by_frame={4: rough}, model_sd_m=0.005, scale_m=scale)
    found = person.reestimated({4: PosedBody(body, pose), 5: PosedBody(body, pose)})
    # The distance is of first order: three millimetres on a wrist 30 mm wide have an error of some hundredths.
    assert found.model_sd_m == pytest.approx(0.003, rel=0.08)
    assert found.scale_m <= scale


def test_a_frame_without_points_contributes_nothing(scene):
    body, pose, points = scene
    person = PersonPoints(by_frame={4: points})
    assert person.observed(5, PosedBody(body, pose)) is None
    hessian, gradient = person.terms(5, PosedBody(body, pose))
    assert not hessian.any()
    assert not gradient.any()
    assert PersonPoints(by_frame={}).reestimated({5: PosedBody(body, pose)}).model_sd_m == person.model_sd_m


def test_points_need_a_body_of_metaballs(scene):
    from dataclasses import replace

    body, pose, points = scene
    with pytest.raises(ValueError, match="metaballs"):
        PersonPoints(by_frame={4: points}).observed(4, PosedBody(replace(body, metaballs=None), pose))


def test_a_wide_scale_has_an_equal_standard_deviation(scene):
    body, pose, points = scene
    wide = PersonPoints(by_frame={4: points}, model_sd_m=0.001, scale_m=0.05)
    assert wide.has_wide_scale
    assert wide.with_sd_of_scale().model_sd_m == 0.05
    assert wide.with_sd_of_scale().observed(4, PosedBody(body, pose)).spread.min() >= 0.05
    narrow = wide.with_narrower_scale(0.0)
    assert narrow.scale_m == pytest.approx(0.004)
    for each in (narrow, PersonPoints(by_frame={4: points})):
        assert not each.has_wide_scale
        assert each.with_sd_of_scale() is each
