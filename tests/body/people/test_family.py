"""The learned family: linear, symmetric, closed, and the same body at both levels."""

import itertools

import numpy as np
import pytest

from marey.body.articulation.skeleton import full_skeleton
from marey.body.people.family import LEVELS, distal_ends, load_family
from marey.errors import SettingProblem


@pytest.fixture(params=LEVELS)
def family(request):
    return load_family(request.param)


def edges(faces):
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def volume(vertices, faces):
    a, b, c = vertices[faces].transpose(1, 0, 2)
    return np.sum(np.cross(a, b) * c) / 6


def test_skin_and_joints_are_linear_in_the_numbers(family, rng):
    a, b = rng.normal(size=(2, family.numbers))
    for of in (family.vertices, family.joints):
        np.testing.assert_allclose(of(a) + of(b) - of(a * 0), of(a + b), atol=1e-12)
        np.testing.assert_allclose(of(a[:3]), of(np.r_[a[:3], np.zeros(family.numbers - 3)]), atol=1e-12)


def test_fewer_numbers_are_the_first_ones(family):
    few = load_family(family.level, 5)
    assert few.numbers == 5
    np.testing.assert_array_equal(few.vertices_modes, family.vertices_modes[:5])


def test_the_surface_is_closed_of_one_piece_and_turned_outwards(family):
    directed = edges(family.faces)
    assert len(np.unique(directed, axis=0)) == len(directed)
    assert {tuple(e) for e in directed} == {tuple(e[::-1]) for e in directed}
    assert np.array_equal(np.unique(family.faces), np.arange(len(family.vertices_mean)))
    # Euler's number of a sphere
    assert len(family.vertices_mean) - len(directed) // 2 + len(family.faces) == 2
    # a grown person displaces 45 to 110 litres
    assert 0.045 < volume(family.vertices_mean, family.faces) < 0.110


def test_weights_sum_to_one_and_belong_to_segments(family):
    np.testing.assert_allclose(family.vertex_weights.sum(1), 1, atol=1e-12)
    assert np.all(family.vertex_weights >= 0)
    assert np.all(np.diff(family.vertex_weights, axis=1) <= 0)
    assert set(np.unique(family.vertex_segments[:, 0])) == set(range(len(family.segment_names)))


def test_left_and_right_are_mirror_images(family):
    names = list(family.segment_names)
    swap = [names.index(n.replace("left", "#").replace("right", "left").replace("#", "right")) for n in names]
    np.testing.assert_array_equal(family.mirror[family.mirror], np.arange(len(family.mirror)))
    # the skin is stored in steps of 40 and 20 micrometres
    flip = np.array([-1, 1, 1])
    np.testing.assert_allclose(family.vertices_mean[family.mirror] * flip, family.vertices_mean, atol=5e-5)
    np.testing.assert_allclose(family.vertices_modes[:, family.mirror] * flip, family.vertices_modes, atol=3e-5)
    np.testing.assert_allclose(family.joints_mean[swap] * flip, family.joints_mean, atol=1e-6)
    np.testing.assert_allclose(family.joints_modes[:, swap] * flip, family.joints_modes, atol=1e-6)
    np.testing.assert_allclose(family.hinge_axes[swap] * [1, -1, -1], family.hinge_axes, atol=1e-6)


def long_axes(family):
    """The unit vector (S, 3) from each segment's joint centre to its distal end, in the mean body at rest."""
    axes = distal_ends(family) - family.joints_mean
    return axes / np.linalg.norm(axes, axis=1, keepdims=True)


def test_the_rest_posture_is_the_agreed_one(family):
    axes = dict(zip(family.segment_names, long_axes(family), strict=True))
    arm = np.array([0.67, -0.02, -0.74]) / np.linalg.norm([0.67, -0.02, -0.74])
    for part in ("upperarm", "forearm"):
        np.testing.assert_allclose(axes[f"left_{part}"], arm, atol=2e-3)
    for part in ("thigh", "shank"):
        np.testing.assert_allclose(axes[f"right_{part}"], [0, 0, -1], atol=2e-3)
    assert axes["left_foot"][1] < -0.8
    np.testing.assert_allclose(family.joints_mean[0], 0, atol=1e-9)
    # standing flat: both soles' lowest points are level to a millimetre by symmetry, and the head is on top
    assert np.argmax(family.vertices_mean[:, 2]) in np.flatnonzero(
        family.vertex_segments[:, 0] == family.segment("head")
    )


def test_a_positive_turn_of_a_hinge_flexes(family):
    axes, along = family.hinge_axes, long_axes(family)
    turned = np.cross(axes, along)  # where the distal end starts to go
    assert turned[family.segment("left_shank")][1] > 0.99
    assert turned[family.segment("right_forearm")][1] < -0.9
    assert turned[family.segment("left_foot")][2] > 0.8
    assert turned[family.segment("right_toes")][2] > 0.8
    assert turned[family.segment("left_hand")][0] < -0.5
    hinges = np.isfinite(axes[:, 0])
    np.testing.assert_allclose(np.linalg.norm(axes[hinges], axis=1), 1, atol=1e-6)


def test_both_levels_are_the_same_body(rng):
    fine, coarse = load_family("fine"), load_family("coarse")
    b = rng.normal(size=fine.numbers)
    np.testing.assert_array_equal(fine.joints(b), coarse.joints(b))
    count = len(coarse.vertices_mean)
    np.testing.assert_array_equal(fine.vertex_segments[:count], coarse.vertex_segments)
    # the coarse vertices bulge beyond the fine ones by the sagitta of their longer edges: 60 mm over 60 mm radius
    apart = np.linalg.norm(fine.vertices(b)[:count] - coarse.vertices(b), axis=1)
    assert np.median(apart) < 0.06**2 / (8 * 0.06)
    ratio = volume(fine.vertices(b), fine.faces) / volume(coarse.vertices(b), coarse.faces)
    assert abs(ratio - 1) < 0.01


def test_every_distal_end_lies_away_from_its_joint(family):
    length = np.linalg.norm(distal_ends(family) - family.joints_mean, axis=1)
    assert np.all((length > 0.03) & (length < 0.5))


def test_wrong_settings_are_rejected():
    with pytest.raises(SettingProblem, match="level"):
        load_family("finest")
    with pytest.raises(SettingProblem, match="has 16 shape parameters; 99"):
        load_family("fine", 99)
    with pytest.raises(SettingProblem, match="tail"):
        load_family().segment("tail")


def test_the_segments_are_in_the_order_of_the_skeleton():
    family, arm = load_family("coarse", 1), np.array([0.67, -0.02, -0.74])
    skeleton = full_skeleton(arm=arm, elbow=np.array([-0.74, -0.05, -0.67]), palm=np.array([-0.7, 0.1, -0.7]))
    assert family.segment_names == skeleton.segment_names
    np.testing.assert_array_equal(family.parents, skeleton.parents)


def test_more_numbers_leave_the_joints_less_room():
    spreads = [load_family("coarse", k).joints_sd for k in (0, 4, 8, 16)]
    means = [np.mean(spread[1:]) for spread in spreads]
    assert all(a > b for a, b in itertools.pairwise(means))
    # docs/explanation/body.md: 4 mm of distance with 16 numbers, thus about 2 mm by axis
    assert 0.001 < means[-1] < 0.004
