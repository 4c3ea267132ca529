"""The people of metaballs from whom a capture starts."""

import numpy as np
import pytest

from marey.body.metaballs.metaball_people import learned_metaballs, metaball_person
from marey.body.metaballs.metaball_person import DETAILS, metaball_body, reshaped
from marey.body.people.person import person_body


@pytest.fixture(scope="module", params=DETAILS)
def learned(request):
    return learned_metaballs(request.param)


@pytest.mark.slow
def test_the_surface_follows_the_learned_skin_to_first_order_of_the_numbers(learned, rng):
    """A step of the numbers moves the learned skin, and the metaballs' surface as far along its normals."""
    person, body = person_body("fine"), metaball_body(learned)
    steps = 0.3 * rng.normal(size=len(learned)) * np.sqrt(np.diag(learned.prior_covariance))
    moved = reshaped(body, steps)
    wanted = body.vertices + person.with_numbers(steps).vertices - person.vertices
    off = np.abs(learned.balls(steps).at_rest().distance(wanted))
    far = np.abs(learned.mean.at_rest().distance(wanted))
    assert np.sqrt(np.mean(off**2)) < 0.2 * np.sqrt(np.mean(far**2))
    assert np.sqrt(np.mean(off**2)) < 0.002
    joints = person.with_numbers(steps).joint_centres
    np.testing.assert_allclose(moved.joint_centres, joints, atol=1e-6)


def test_both_sides_of_the_learned_metaballs_stay_alike(learned, rng):
    steps = 0.5 * rng.normal(size=len(learned)) * np.sqrt(np.diag(learned.prior_covariance))
    posed = learned.balls(steps).at_rest()
    points = rng.uniform([-0.6, -0.2, -0.9], [0.6, 0.2, 0.8], (300, 3))
    np.testing.assert_allclose(posed.field(points), posed.field(points * [-1, 1, 1]), rtol=5e-3, atol=1e-6)


@pytest.mark.slow
def test_a_preset_keeps_of_the_metaball_person_what_it_keeps_of_any_body():
    limb, mesh = metaball_person("simple", "coarse", preset="right_arm"), person_body("coarse", preset="right_arm")
    assert limb.skeleton.coordinate_names == mesh.skeleton.coordinate_names
    assert limb.metaballs.mean.skeleton.coordinate_names == mesh.skeleton.coordinate_names
    np.testing.assert_array_equal(limb.followed, mesh.followed)
    np.testing.assert_array_equal(limb.followed_joints, mesh.followed_joints)
    shown = {limb.skeleton.segment_names[k] for k in limb.face_segment}
    assert {"right_hand", "right_forearm", "thorax"} <= shown
    assert not any(name.startswith("left") or "thigh" in name for name in shown)
    again = reshaped(limb, limb.numbers + 0.05)
    np.testing.assert_array_equal(again.outline_counts, limb.outline_counts)
    assert again.skeleton is limb.skeleton


@pytest.mark.slow
def test_a_known_stature_makes_the_metaball_person_that_tall():
    for stature in (1.6, 1.85):
        body = metaball_person("full", "coarse", stature_m=stature)
        assert np.ptp(body.vertices[:, 2]) == pytest.approx(stature, abs=0.03)


@pytest.mark.slow
def test_both_levels_of_the_metaball_person_have_the_same_joints(rng):
    fine, coarse = (metaball_person("simple", level) for level in ("fine", "coarse"))
    numbers = rng.normal(size=len(fine.space)) * 0.05
    np.testing.assert_array_equal(reshaped(fine, numbers).joint_centres, reshaped(coarse, numbers).joint_centres)


@pytest.mark.slow
def test_joints_of_metaball_people_are_at_least_as_uncertain_as_the_familys():
    """The least that both kinds of deviation add is what skin alone leaves open in the learned family."""
    body, family = metaball_person("full", "coarse"), person_body("coarse", numbers=16)
    assert np.all(body.joint_sd >= family.joint_sd)
    assert np.all(np.hypot(body.joint_sd, body.joint_offset_sd) < 0.04)


def test_the_leading_directions_are_ordered_by_variation(rng):
    """Most of the difference between people's skins lies in a few directions, whose steps are independent."""
    space = metaball_person("simple", "coarse").space
    steps = space.leading
    whitened = np.linalg.solve(steps.T, np.linalg.cholesky(space.prior_covariance))
    np.testing.assert_allclose(whitened @ whitened.T, np.eye(len(space)), atol=1e-8)
    moved = np.sum(np.square(np.tensordot(steps, space.vertex_modes, 1)), (1, 2))
    assert np.all(np.diff(moved) <= 1e-9)
    assert moved[:8].sum() > 0.9 * moved.sum()
    numbers = rng.normal(size=len(space))
    np.testing.assert_allclose(space.by_rank.vertices(numbers), space.vertices(steps.T @ numbers), atol=1e-12)
