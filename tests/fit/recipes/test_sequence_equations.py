"""Normal equations of a refinement."""

from dataclasses import replace

import numpy as np
from tests import worlds

from marey.body.people.person import person_body
from marey.fit.recipes.sequence_equations import STEP_SD_SHAPE, add_terms, shape_prior, step_variance


def test_steps_of_numbers_scale_with_their_own_standard_deviation():
    """Shares of a length and numbers of unit variance are held alike; what hardly varies is not held the more."""
    space = person_body("coarse").space
    np.testing.assert_allclose(step_variance(space), STEP_SD_SHAPE**2)
    mixed = replace(space, prior_covariance=np.diag(np.where(np.arange(len(space)) < 10, 1.0, 0.01)))
    np.testing.assert_allclose(step_variance(mixed) / np.diag(mixed.prior_covariance), STEP_SD_SHAPE**2)
    assert len(step_variance(space.keep(range(0)))) == 0


def test_further_observations_are_added_to_pose_shape_and_shared_unknowns(rng):
    body = worlds.person()
    degrees, numbers = len(body.skeleton), len(body.space)
    size = degrees + numbers + 2
    more, pull = rng.normal(size=(size, size)), rng.normal(size=size)
    whole, gradient = add_terms(np.ones((degrees + numbers,) * 2), np.ones(degrees + numbers), more.copy(), pull, body)
    np.testing.assert_allclose(whole[:degrees, :degrees], more[:degrees, :degrees] + 1)
    np.testing.assert_array_equal(whole[-2:], more[-2:])
    assert len(gradient) == size


def test_a_frame_that_does_not_update_the_shape_has_no_equation_of_it(rng):
    body = worlds.person()
    degrees, numbers = len(body.skeleton), len(body.space)
    more, pull = rng.normal(size=(degrees + numbers + 2,) * 2), rng.normal(size=degrees + numbers + 2)
    whole, gradient = add_terms(np.ones((degrees, degrees)), np.ones(degrees), more, pull, body)
    shape = slice(degrees, degrees + numbers)
    assert not whole[shape].any()
    assert not whole[:, shape].any()
    assert not gradient[shape].any()
    np.testing.assert_array_equal(whole[-2:, -2:], more[-2:, -2:])


def test_the_prior_of_the_shape_leaves_further_unknowns_free():
    body = person_body("coarse")
    information, gradient = shape_prior(body, worlds.pose(body), len(body.space) + 3)
    assert information.shape == (len(body.space) + 3,) * 2
    np.testing.assert_array_equal(information[-3:, -3:], np.eye(3))
    np.testing.assert_array_equal(gradient[-3:], 0)
    assert np.linalg.eigvalsh(information).min() > 0
