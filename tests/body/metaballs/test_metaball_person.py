"""The generic metaballs and the skin over them."""

import numpy as np
import pytest
from scipy.linalg import block_diag
from tests import people

from marey.body.articulation.pose import PosedBody
from marey.body.metaballs.metaball_person import (
    DETAILS,
    KEPT_RADIUS,
    generic_metaballs,
    metaball_body,
    metaball_space,
    reshaped,
    single_radii,
)
from marey.body.metaballs.metaballs import PosedMetaballs
from marey.body.people.family import load_family
from marey.body.people.person import family_body
from marey.errors import SettingProblem


@pytest.fixture(scope="module", params=DETAILS)
def space(request):
    return metaball_space(request.param)


@pytest.fixture(scope="module")
def body(space):
    return metaball_body(space)


def face_centres(body):
    a, b, c = (body.vertices[body.faces[:, corner]] for corner in range(3))
    return (a + b + c) / 3, np.linalg.norm(np.cross(b - a, c - a), axis=1)


def volume(body):
    a, b, c = (body.vertices[body.faces[:, corner]] for corner in range(3))
    return np.einsum("ta,ta->t", a, np.cross(b, c)).sum() / 6


def test_the_generic_metaballs_follow_the_mean_skin(space):
    family = family_body("fine")
    points, area = face_centres(family)
    off = space.mean.at_rest().distance(points, family.face_limb)
    assert np.sqrt(np.average(off**2, weights=area)) < 0.004


def test_a_shortened_step_leaves_every_ball_a_tenth_of_its_size(space, rng):
    start, step = 0.05 * rng.normal(size=len(space)), np.zeros(len(space))
    before = space.balls(start).radii
    for size in (0.01, 1.0, 100.0):
        step[:26] = size * rng.normal(size=26)
        share = space.possible_share(start, step)
        after = space.balls(start + share * step).radii
        if size == 0.01:
            assert share == 1.0
        elif share < 1.0:
            assert np.min(after / before) == pytest.approx(KEPT_RADIUS)
    assert share < 1.0


def test_no_metaball_protrudes_from_the_body(space):
    """Each ball's centre lies inside the mean skin; a hand's, a mitten, may lie between thumb and fingers."""
    family, place = family_body("fine"), space.mean.at_rest().place
    centres, _ = face_centres(family)
    a, b, c = (family.vertices[family.faces[:, corner]] for corner in range(3))
    outward = np.cross(b - a, c - a)
    nearest = np.argmin(np.linalg.norm(place[:, None] - centres, axis=2), 1)
    outward = outward[nearest] / np.linalg.norm(outward[nearest], axis=1)[:, None]
    outside = np.einsum("ba,ba->b", place - centres[nearest], outward)
    hands = np.isin(space.mean.segment, [space.mean.skeleton.segment(f"{side}_hand") for side in ("left", "right")])
    assert outside[~hands].max() < 0.0
    assert outside[hands].max() < 0.015


def test_both_sides_of_the_generic_person_are_alike(space, rng):
    points = rng.uniform([-0.6, -0.2, -0.9], [0.6, 0.2, 0.8], (500, 3))
    posed = space.mean.at_rest()
    np.testing.assert_allclose(posed.field(points), posed.field(points * [-1, 1, 1]), rtol=1e-5, atol=1e-9)


def test_the_simplified_limbs_have_three_balls_a_segment():
    balls = generic_metaballs("simple")
    for name in ("left_upperarm", "left_forearm", "right_thigh", "right_shank"):
        assert np.sum(balls.segment == balls.skeleton.segment(name)) == 3


def test_the_skin_lies_on_the_metaballs(space, body):
    assert np.abs(space.mean.at_rest().distance(body.vertices, -1)).max() < 2e-3
    assert np.median(np.abs(space.mean.at_rest().distance(body.vertices, -1))) < 1e-6


def test_the_skin_encloses_what_the_mean_body_does(body):
    assert volume(body) == pytest.approx(volume(family_body("fine")), rel=0.03)


def test_shares_of_the_skin_add_up(body):
    np.testing.assert_allclose(body.vertex_weights.sum(1), 1.0, rtol=1e-12)
    assert body.vertex_weights.min() >= 0.0


def test_the_skin_stays_on_the_metaballs_to_first_order_of_the_numbers(space, body, rng):
    direction = rng.normal(size=len(space))
    direction /= np.linalg.norm(direction)
    good = np.abs(space.mean.at_rest().distance(body.vertices)) < 1e-6
    off = []
    for step in (0.02, 0.01):
        moved = space.balls(step * direction).at_rest().distance(body.with_numbers(step * direction).vertices)
        off.append(np.median(np.abs(moved[good])))
    assert off[0] < 5e-4
    assert off[0] / off[1] == pytest.approx(4.0, rel=0.3)


def test_bones_have_the_lengths_given_by_the_shape_parameters(space):
    numbers = np.zeros(len(space))
    numbers[space.names.index("thigh_length")] = 0.1
    old, new = space.mean, space.balls(numbers)
    hip, knee, ankle = (old.skeleton.segment(f"left_{name}") for name in ("thigh", "shank", "foot"))
    for balls, factor in ((old, 1.0), (new, 1.1)):
        length = np.linalg.norm(balls.joint_centres[knee] - balls.joint_centres[hip])
        assert length == pytest.approx(factor * np.linalg.norm(old.joint_centres[knee] - old.joint_centres[hip]))
    moved = new.joint_centres - old.joint_centres
    np.testing.assert_allclose(moved[ankle], moved[knee], atol=1e-15)


def test_the_distance_changes_with_the_numbers_according_to_its_derivative(space, rng):
    bones = PosedBody(family_body("coarse"), people.any_pose(rng, family_body("coarse")))
    points = bones.vertices[::40] + rng.normal(size=bones.vertices[::40].shape) * 0.01
    at, step = rng.normal(size=len(space)) * 0.03, 1e-6
    posed = PosedMetaballs(space.balls(at), bones.pose)
    found = space.by_numbers(posed, posed.distances(points))
    for i in range(len(space)):
        change = step * (np.arange(len(space)) == i)
        up, down = (PosedMetaballs(space.balls(at + s * change), bones.pose).distance(points) for s in (1, -1))
        np.testing.assert_allclose(found[:, i], (up - down) / (2 * step), atol=2e-7)


def test_a_body_recomputed_for_other_numbers_lies_on_their_metaballs(space, body, rng):
    numbers = rng.normal(size=len(space)) * 0.03
    anew = metaball_body(space, numbers, body.with_numbers(numbers))
    assert np.median(np.abs(space.balls(numbers).at_rest().distance(anew.vertices))) < 1e-6
    np.testing.assert_allclose(anew.joint_centres, space.balls(numbers).joint_centres, atol=1e-12)


def fitted(space, posed, numbers, points, sd, scale):
    """Fit pose and numbers to points as [Plaenkers1999] section 4 does, by Levenberg-Marquardt.

    Points farther off than a scale count less: hands and toes are as thin as the start is wrong, and points of one side
    may be taken for the other's.
    """
    start, damping = posed.pose, 1.0
    # Angles that the points hardly determine stay within half a radian of the start.
    held = np.concatenate([np.zeros(6), np.full(len(start.angles), 4.0)])
    expected = np.linalg.inv(space.prior_covariance)
    prior = block_diag(np.diag(held), expected)

    def cost(posed, numbers):
        away = np.concatenate([start.change_to(posed.pose), numbers])
        square = posed.distance(points) ** 2
        return np.sum(square / (1.0 + square / scale**2)) / sd**2 + away @ prior @ away

    for _ in range(20):
        of = posed.distances(points)
        root = 1.0 / (1.0 + (of.residual / scale) ** 2) / sd
        jacobian = np.concatenate([posed.by_pose(points, of), space.by_numbers(posed, of)], 1) * root[:, None]
        normal = jacobian.T @ jacobian + prior
        away = np.concatenate([start.change_to(posed.pose), numbers])
        gradient = jacobian.T @ (of.residual * root) + prior @ away
        step = -np.linalg.solve(normal + damping * np.diag(np.diag(normal)) * 0.01, gradient)
        trial_numbers = numbers + step[len(held) :]
        trial = PosedMetaballs(space.balls(trial_numbers), posed.pose.step(step[: len(held)]))
        better = cost(trial, trial_numbers) < cost(posed, numbers)
        if better:
            posed, numbers = trial, trial_numbers
        damping *= 0.2 if better else 5.0
    return posed, numbers, np.linalg.inv(normal)


@pytest.mark.slow
def test_pose_and_sizes_are_recovered_from_points_on_the_surface(space, rng):
    sd, family = 0.001, family_body("fine")
    # Sizes drawn from the prior, at 25 % of their distance from the mean.
    true_numbers = 0.25 * np.linalg.cholesky(space.prior_covariance) @ rng.normal(size=len(space))
    true = PosedMetaballs(space.balls(true_numbers), people.any_pose(rng, family, spread=0.1))
    skin = PosedBody(metaball_body(space, true_numbers), true.pose).vertices
    surface = true.onto_surface(skin)
    surface = surface[np.abs(true.distance(surface)) < 1e-6]
    points = surface + rng.normal(size=surface.shape) * sd
    pose = true.pose.step(np.append(rng.normal(size=3) * 0.01, rng.normal(size=len(true.pose.angles) + 3) * 0.02))
    # First the points have a standard deviation of a centimetre, so that the prior has a similar weight.
    near, numbers, _ = fitted(space, PosedMetaballs(space.mean, pose), np.zeros(len(space)), points, 10 * sd, 20 * sd)
    found, numbers, covariance = fitted(space, near, numbers, points, sd, 5 * sd)
    # Hands and toes are as thin as the start is wrong, and may stay where points of one side are taken for the other's.
    thick = [i for i, name in enumerate(space.names) if not name.startswith(("hand", "foot", "toes"))]
    sds = np.sqrt(np.diag(covariance)[-len(space) :])
    assert np.all(np.abs(numbers - true_numbers)[thick] < 4.5 * sds[thick])
    assert sds[space.names.index("thigh_length")] < 0.01
    knee = space.mean.skeleton.segment("left_shank")
    assert np.linalg.norm(found.segment_origin[knee] - true.segment_origin[knee]) < 0.005
    # 0.67 sd is the noise's own; the rest is hands and toes.
    assert np.median(np.abs(found.distance(points))) < 0.8 * sd


def test_the_prior_includes_the_family(space):
    """The family's spread of stature is found again in the numbers."""
    family, names = load_family("coarse"), space.names
    along = np.zeros(len(space))
    mean = space.mean
    lengths = {"thigh": ("thigh", "shank"), "shank": ("shank", "foot")}
    for name, (top, bottom) in lengths.items():
        k = [mean.skeleton.segment(f"left_{end}") for end in (top, bottom)]
        along[names.index(f"{name}_length")] = np.linalg.norm(mean.joint_centres[k[1]] - mean.joint_centres[k[0]])
    hip, ankle = (family.segment(f"left_{name}") for name in ("thigh", "foot"))
    theirs = np.linalg.norm((family.joints_modes[:, hip] - family.joints_modes[:, ankle])[:, 2])
    assert np.sqrt(along @ space.prior_covariance @ along) == pytest.approx(theirs, rel=0.3)


def test_unknown_detail_is_an_error_that_lists_the_known():
    with pytest.raises(SettingProblem, match="simple or full"):
        metaball_space("rough")


@pytest.mark.slow
def test_the_skin_is_recomputed_for_other_numbers(space, body, rng):
    numbers = rng.multivariate_normal(np.zeros(len(space)), space.prior_covariance)
    balls = space.balls(numbers).at_rest()
    off = [np.abs(balls.distance(made.vertices)) for made in (body.with_numbers(numbers), reshaped(body, numbers))]
    assert np.quantile(off[0], 0.95) > 2e-4
    assert np.quantile(off[1], 0.95) < 1e-6
    np.testing.assert_array_equal(reshaped(body, numbers).numbers, numbers)


def test_a_body_without_metaballs_takes_other_numbers(rng):
    family = family_body("coarse")
    numbers = rng.normal(size=len(family.space))
    np.testing.assert_array_equal(reshaped(family, numbers).vertices, family.with_numbers(numbers).vertices)


@pytest.fixture(scope="module")
def sharpened():
    return single_radii(metaball_space("simple"), ["upperarm", "forearm"])


def sharp_numbers(space, rng, sd=0.3):
    numbers = np.zeros(len(space))
    sharp = [i for i, name in enumerate(space.names) if name.endswith("sharpness")]
    numbers[sharp] = rng.normal(size=len(sharp)) * sd
    return numbers


def test_a_sharper_ball_has_a_greater_weight_and_smaller_radii(sharpened):
    at = sharpened.names.index("forearm_ball_2_sharpness")
    numbers = np.zeros(len(sharpened))
    numbers[at] = 0.3
    balls, mean = sharpened.balls(numbers), sharpened.mean
    own = np.flatnonzero(sharpened.sharpness_modes[at])
    assert len(own) == 2
    assert np.all(balls.weight[own] > 1.2)
    np.testing.assert_allclose(balls.radii[own], mean.radii[own] * np.exp(-0.15), rtol=1e-12)
    np.testing.assert_array_equal(np.delete(balls.weight, own), np.delete(mean.weight, own))


def test_sharpness_alone_hardly_moves_the_skin(sharpened):
    """The gauge: a weight that grew by as much with the radii kept would move the skin by many times more."""
    body, posed = family_body("fine"), sharpened.mean.at_rest()
    points = posed.onto_surface(body.vertices)
    of = posed.distances(points)
    by_number, kept = sharpened.by_numbers(posed, of), []
    for i, name in enumerate(sharpened.names):
        if name.endswith("sharpness"):
            plain = of.by_weight @ (sharpened.sharpness_modes[i] * sharpened.fall)
            kept.append(abs(by_number[:, i].sum() / plain.sum()))
    assert np.median(kept) < 0.1


def test_the_distance_changes_with_sharpness_according_to_its_derivative(sharpened, rng):
    bones = PosedBody(family_body("coarse"), people.any_pose(rng, family_body("coarse")))
    points = bones.vertices[::40] + rng.normal(size=bones.vertices[::40].shape) * 0.01
    at, step = sharp_numbers(sharpened, rng) + rng.normal(size=len(sharpened)) * 0.03, 1e-6
    posed = PosedMetaballs(sharpened.balls(at), bones.pose)
    found = sharpened.by_numbers(posed, posed.distances(points))
    for i, name in enumerate(sharpened.names):
        if "_ball_1_" in name:
            change = step * (np.arange(len(sharpened)) == i)
            up, down = (PosedMetaballs(sharpened.balls(at + s * change), bones.pose).distance(points) for s in (1, -1))
            np.testing.assert_allclose(found[:, i], (up - down) / (2 * step), atol=2e-7)


def test_the_skin_follows_sharpness_to_first_order(sharpened, rng):
    numbers = sharp_numbers(sharpened, rng)
    body, off = metaball_body(sharpened, numbers), []
    direction = sharp_numbers(sharpened, rng, sd=1.0)
    on = np.abs(sharpened.balls(numbers).at_rest().distance(body.vertices)) < 1e-6
    near = on & np.any(np.abs(np.tensordot(direction, body.space.vertex_modes, 1)) > 1e-3, axis=1)
    for step in (0.02, 0.01):
        there = numbers + step * direction
        moved = sharpened.balls(there).at_rest().distance(body.with_numbers(there).vertices)
        off.append(np.median(np.abs(moved[near])))
    assert off[0] / off[1] == pytest.approx(4.0, rel=0.3)


def test_weights_may_be_kept():
    space = single_radii(metaball_space("simple"), ["forearm"], sharpness_sd=None)
    assert not any(name.endswith("sharpness") for name in space.names)
