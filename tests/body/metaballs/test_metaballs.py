"""Metaballs against the paper's formulas, and their derivatives against differences."""

from dataclasses import replace

import numpy as np
import pytest
from tests import people

from marey.body.articulation.skeleton import LIMBS
from marey.body.metaballs.metaball_field import LEAST_SLOPE
from marey.body.metaballs.metaballs import THRESHOLD, Metaballs, PosedMetaballs
from marey.geometry import rotations

STEP = 1e-6


def any_metaballs(rng, *, on=None, count=2):
    """Return balls on some segments of a person, all when None."""
    body = people.stick_person(rng)
    names = on or body.skeleton.segment_names
    segment = np.repeat([body.skeleton.segment(name) for name in names], count)
    m = len(segment)
    return Metaballs(
        skeleton=body.skeleton,
        joint_centres=body.joint_centres,
        segment=segment,
        centre=rng.normal(size=(m, 3)) * 0.06,
        rotation=rotations.exp(rng.normal(size=(m, 3))),
        radii=rng.uniform(0.06, 0.15, (m, 3)),
        weight=rng.uniform(0.8, 1.5, m),
    )


@pytest.fixture
def posed(rng):
    return PosedMetaballs(any_metaballs(rng), people.any_pose(rng, people.stick_person(rng)))


@pytest.fixture
def points(rng, posed):
    """Points near the surface, some inside, each close to one ball."""
    which = rng.integers(0, len(posed.balls), 60)
    return posed.place[which] + rng.normal(size=(60, 3)) * 0.06


def plain_field(posed, point):
    """[Plaenkers1999] eq. (5)-(7), over the trunk's balls and those of the limb that adds most."""
    balls, sums = posed.balls, np.zeros(len(LIMBS))
    for m in range(len(balls)):
        k = balls.segment[m]
        in_segment = posed.segment_rotation[k].T @ (point - posed.segment_origin[k])
        x, y, z = balls.rotation[m].T @ (in_segment - balls.centre[m])
        lx, ly, lz = balls.radii[m]
        d = (x / lx) ** 2 + (y / ly) ** 2 + (z / lz) ** 2
        sums[balls.limb[m]] += balls.weight[m] * np.exp(-2 * d)
    return sums[0] + max(sums[1:])


def test_the_field_is_that_of_the_paper(posed, points):
    expected = [plain_field(posed, point) for point in points]
    np.testing.assert_allclose(posed.field(points), expected, rtol=1e-12)
    np.testing.assert_allclose(posed.potentials(points).residual, np.array(expected) - THRESHOLD, atol=1e-13)


def test_shares_are_what_each_ball_adds(posed, points):
    shares = posed.shares(points)
    np.testing.assert_allclose(shares.sum(1), 1.0, rtol=1e-12)
    heavier = replace(posed.balls, weight=np.where(np.arange(len(posed.balls)) == 3, 2.0, 1.0) * posed.balls.weight)
    influenced = shares[:, 3] > 1e-3
    ratio = PosedMetaballs(heavier, posed.pose).field(points) / posed.field(points)
    same_limb = np.abs(ratio - 1 - shares[:, 3]) < 1e-9
    assert influenced.any()
    assert same_limb[influenced].all()


def single_ball(rng, **changes):
    balls = any_metaballs(rng, on=["left_forearm"], count=1)
    return replace(balls, **({"weight": np.ones(1)} | changes)).at_rest()


def test_a_single_ball_reaches_where_its_own_field_is_one_half(rng):
    posed = single_ball(rng)
    reach = np.sqrt(np.log(2) / 2)
    ends = posed.place + reach * posed.balls.radii[0][:, None] * posed.axes[0]
    np.testing.assert_allclose(posed.field(ends), 0.5, rtol=1e-12)
    np.testing.assert_allclose(posed.distance(ends), 0.0, atol=1e-15)


def test_the_distance_is_metric_near_a_sphere(rng):
    radius = 0.1
    posed = single_ball(rng, radii=np.full((1, 3), radius))
    reach = np.sqrt(np.log(2) / 2) * radius
    outward = rng.normal(size=(20, 3))
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    for off in (-1e-3, 1e-3):
        read = posed.distance(posed.place + (reach + off) * outward)
        # Second order of the quadratic ln F, off^2 / (2 reach), and the bound of the slope.
        slope = 4 * reach / radius**2
        np.testing.assert_allclose(read, off, atol=off**2 / reach + abs(off) * (LEAST_SLOPE / slope) ** 2)


def test_a_heavier_ball_of_the_same_size_has_a_sharper_edge(rng):
    soft = single_ball(rng)
    weight = 4.0
    smaller = soft.balls.radii * np.sqrt(np.log(2) / np.log(2 * weight))
    sharp = replace(soft.balls, weight=np.array([weight]), radii=smaller).at_rest()
    edge = soft.place + np.sqrt(np.log(2) / 2) * soft.balls.radii[0, :1] * soft.axes[0, :1]
    np.testing.assert_allclose(sharp.field(edge), 0.5, rtol=1e-12)
    steepness = [np.linalg.norm(p.potentials(edge).by_point) for p in (soft, sharp)]
    assert steepness[1] > 1.5 * steepness[0]


def test_a_point_moves_onto_the_surface_along_the_gradient_of_its_distance(posed, points):
    """By steps of at most 1 cm, which are those of Newton's method near the surface."""
    points = points[np.abs(posed.distance(points)) < 0.02]
    expected = points.copy()
    for _ in range(12):
        of = posed.distances(expected)
        steep = np.linalg.norm(of.by_point, axis=1, keepdims=True)
        expected -= np.clip(of.residual[:, None] / steep, -0.01, 0.01) * of.by_point / steep
    found = posed.onto_surface(points)
    assert np.median(np.abs(posed.distance(found))) < 1e-9
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_far_points_still_pull_towards_the_body(posed):
    far = np.array([[40.0, -30.0, 25.0]])
    of = posed.distances(far)
    assert np.isfinite(of.residual).all()
    nearer = far - 0.1 * of.by_point / np.linalg.norm(of.by_point)
    assert posed.distance(nearer) < of.residual


def test_one_leg_does_not_merge_with_the_other(rng):
    body = people.stick_person(rng)
    legs = [body.skeleton.segment(f"{side}_thigh") for side in ("left", "right")]
    apart = np.array([0.12, 0.0, 0.0])
    balls = Metaballs(
        skeleton=body.skeleton, joint_centres=body.joint_centres, segment=np.array(legs), weight=np.ones(2),
        centre=np.stack([-body.joint_centres[legs[0]], apart - body.joint_centres[legs[1]]]),
        rotation=np.stack([np.eye(3)] * 2), radii=np.full((2, 3), 0.1),
    )  # fmt: skip
    gap = 0.45 * apart
    alone = np.exp(-2 * np.sum((gap / 0.1) ** 2))
    assert alone + np.exp(-2 * np.sum(((gap - apart) / 0.1) ** 2)) > THRESHOLD + 0.1
    np.testing.assert_allclose(balls.at_rest().field(gap[None]), alone, rtol=1e-12)


@pytest.mark.parametrize("limb", [3, 4])
def test_a_point_of_a_limb_depends_on_that_limb_and_the_trunk(rng, posed, points, limb):
    kept = np.flatnonzero(np.isin(posed.balls.limb, [0, limb]))
    balls = posed.balls
    only = replace(
        balls, segment=balls.segment[kept], centre=balls.centre[kept], rotation=balls.rotation[kept],
        radii=balls.radii[kept], weight=balls.weight[kept],
    )  # fmt: skip
    expected = PosedMetaballs(only, posed.pose).distance(points)
    np.testing.assert_allclose(posed.distance(points, limb), expected, rtol=1e-9, atol=1e-13)


def differences(posed, points, change, residual):
    """Return the central difference of a residual by a change (posed, points, step) -> (posed, points)."""
    up, down = (getattr(p, residual)(x).residual for p, x in (change(posed, points, s) for s in (STEP, -STEP)))
    return (up - down) / (2 * STEP)


def with_balls(posed, **changed):
    return PosedMetaballs(replace(posed.balls, **changed), posed.pose)


RESIDUALS = pytest.mark.parametrize("residual", ["distances", "potentials"])


@RESIDUALS
def test_the_residual_changes_with_the_point_according_to_its_derivative(posed, points, residual):
    of = getattr(posed, residual)(points)
    for a in range(3):
        found = differences(posed, points, lambda p, x, s, a=a: (p, x + s * np.eye(3)[a]), residual)
        np.testing.assert_allclose(of.by_point[:, a], found, atol=1e-6)


@RESIDUALS
@pytest.mark.parametrize("what", ["centre", "radii"])
def test_the_residual_changes_with_the_balls_according_to_its_derivative(posed, points, residual, what):
    derivative = getattr(getattr(posed, residual)(points), f"by_{what}")
    for m in range(0, len(posed.balls), 3):
        for a in range(3):

            def change(p, x, s, m=m, a=a):
                values = np.array(getattr(p.balls, what))
                values[m, a] += s
                return with_balls(p, **{what: values}), x

            found = differences(posed, points, change, residual)
            np.testing.assert_allclose(derivative[:, m, a], found, atol=1e-6)


@RESIDUALS
def test_the_residual_changes_with_the_weights_according_to_its_derivative(posed, points, residual):
    derivative = getattr(posed, residual)(points).by_weight
    for m in range(len(posed.balls)):
        one = np.arange(len(posed.balls)) == m

        def change(p, x, s, one=one):
            return with_balls(p, weight=p.balls.weight + s * one), x

        np.testing.assert_allclose(derivative[:, m], differences(posed, points, change, residual), atol=1e-7)


@RESIDUALS
@pytest.mark.parametrize(("first", "end"), [(0, 3), (3, 6), (6, None)], ids=["translation", "turn", "joints"])
def test_the_residual_changes_with_the_pose_according_to_its_derivative(posed, points, residual, first, end):
    of = getattr(posed, residual)(points)
    jacobian = posed.by_pose(points, of)
    assert np.ptp(jacobian[:, first:end]) > 0.1
    for column in range(jacobian.shape[1])[first:end]:
        one = np.arange(jacobian.shape[1]) == column

        def change(p, x, s, one=one):
            return PosedMetaballs(p.balls, p.pose.step(s * one)), x

        np.testing.assert_allclose(jacobian[:, column], differences(posed, points, change, residual), atol=1e-6)


@RESIDUALS
def test_the_residual_changes_with_the_bones_according_to_its_derivative(rng, posed, points, residual):
    modes = rng.normal(size=(4, len(posed.balls.joint_centres), 3)) * 0.1
    modes[:, 0] = 0.0
    found = posed.by_joints(getattr(posed, residual)(points), modes)
    for i in range(4):

        def change(p, x, s, i=i):
            return with_balls(p, joint_centres=p.balls.joint_centres + s * modes[i]), x

        np.testing.assert_allclose(found[:, i], differences(posed, points, change, residual), atol=1e-6)


def test_moving_body_and_points_together_changes_nothing(rng, posed, points):
    turn, shift = rotations.exp(np.array([0.3, -1.0, 0.5])), np.array([2.0, -1.0, 0.5])
    pose = replace(posed.pose, translation=turn @ posed.pose.translation + shift, rotation=turn @ posed.pose.rotation)
    moved = PosedMetaballs(posed.balls, pose)
    np.testing.assert_allclose(moved.distance(points @ turn.T + shift), posed.distance(points), atol=1e-12)


@pytest.mark.parametrize("what", ["radii", "weight"])
def test_a_ball_without_size_or_weight_is_rejected(rng, what):
    balls = any_metaballs(rng)
    with pytest.raises(ValueError, match="positive"):
        replace(balls, **{what: np.zeros_like(getattr(balls, what))})
