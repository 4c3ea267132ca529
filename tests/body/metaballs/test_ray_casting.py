"""Rays that leave metaballs."""

import numpy as np
import pytest

from marey.body.articulation.skeleton import LIMBS
from marey.body.metaballs.metaball_person import generic_metaballs
from marey.body.metaballs.ray_casting import exits

LEG = LIMBS.index("left_leg")


@pytest.fixture(scope="module")
def posed():
    return generic_metaballs("simple").at_rest()


@pytest.fixture
def knee(posed):
    return posed.segment_origin[posed.balls.skeleton.segment("left_shank")]


def test_an_exit_lies_on_the_surface_and_what_is_before_it_inside(posed, knee, rng):
    ways = rng.normal(size=(50, 3)) * [1, 1, 0.1]
    out = exits(posed, knee, ways, LEG, reach=0.3)
    np.testing.assert_allclose(posed.field(out, LEG), 0.5, atol=1e-6)
    for share in (0.3, 0.9, 0.999):
        assert posed.field(knee + share * (out - knee), LEG).min() > 0.5
    assert posed.field(knee + 1.001 * (out - knee), LEG).max() < 0.5


def test_a_ray_ends_where_it_first_leaves(posed, knee):
    across = exits(posed, knee, np.array([-1.0, 0, 0]), reach=0.5)
    assert knee[0] > across[0] > 0, "the other leg lies behind the gap"


def test_a_ray_that_never_leaves_or_is_never_inside_has_no_exit(posed, knee):
    assert np.isnan(exits(posed, knee, np.array([0, 0, 1.0]), reach=0.05)).all()
    assert np.isnan(exits(posed, knee + [0.3, 0, 0], np.array([1.0, 0, 0]), reach=0.5)).all()


def test_a_single_limb_gives_the_field_of_all_where_it_is_strongest(posed, knee, rng):
    ways = rng.normal(size=(20, 3)) * [0.2, 1, 0]
    own, every = (exits(posed, knee, ways, limb, reach=0.3) for limb in (LEG, -1))
    np.testing.assert_allclose(own, every, atol=1e-8)


def test_the_result_has_the_shape_of_the_input(posed, knee):
    ways = np.ones((4, 5, 3)) * [1, 0, 0]
    assert exits(posed, knee[None, None], ways, LEG, reach=0.3).shape == (4, 5, 3)
