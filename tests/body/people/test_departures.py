"""Modes beyond the family: what each does, and to nothing else."""

import numpy as np
import pytest

from marey.body.articulation.surface import ShapeSpace
from marey.body.people.departures import CLOTHED_SEGMENTS, departure_modes, extended_space
from marey.body.people.family import LEVELS, distal_ends, load_family


@pytest.fixture(params=LEVELS)
def family(request):
    return load_family(request.param, 4)


@pytest.fixture
def modes(family):
    return departure_modes(family)


def mode(modes, name):
    index = modes.names.index(name)
    return modes.vertices[index], modes.joints[index]


def test_there_is_a_name_a_spread_and_a_shape_for_each(family, modes):
    assert len(set(modes.names)) == len(modes) == len(modes.sd)
    assert modes.vertices.shape == (len(modes), *family.vertices_mean.shape)
    assert modes.joints.shape == (len(modes), *family.joints_mean.shape)
    assert np.all(modes.sd > 0)


def test_every_mode_is_alike_on_both_sides(family, modes):
    names = list(family.segment_names)
    swap = [names.index(n.replace("left", "#").replace("right", "left").replace("#", "right")) for n in names]
    flip = np.array([-1, 1, 1])
    # skin weights are stored in 255ths and the skin in steps of 40 micrometres; ties between weights may round apart
    np.testing.assert_allclose(modes.vertices[:, family.mirror] * flip, modes.vertices, atol=6e-3)
    np.testing.assert_allclose(modes.joints[:, swap] * flip, modes.joints, atol=1e-6)


@pytest.mark.parametrize("plain", ["upperarm", "forearm", "thigh", "shank", "abdomen"])
def test_a_length_mode_lengthens_its_segment_and_no_other(family, modes, plain):
    _, joints = mode(modes, f"{plain}_length")
    name = plain if plain in family.segment_names else f"left_{plain}"
    before = np.linalg.norm(distal_ends(family) - family.joints_mean, axis=1)
    child = {"upperarm": "left_forearm", "forearm": "left_hand", "thigh": "left_shank", "shank": "left_foot"}
    follower = family.segment(child.get(plain, "thorax"))
    moved = family.joints_mean + 0.1 * joints
    length = np.linalg.norm(moved[follower] - moved[family.segment(name)])
    np.testing.assert_allclose(length, 1.1 * before[family.segment(name)], rtol=1e-9)
    for index, parent in enumerate(family.parents):
        if parent >= 0 and family.segment_names[parent].removeprefix("left_").removeprefix("right_") != plain:
            np.testing.assert_allclose(
                moved[index] - moved[parent], family.joints_mean[index] - family.joints_mean[parent], atol=1e-12
            )


def test_a_length_mode_carries_the_skin_beyond_it(family, modes):
    vertices, joints = mode(modes, "thigh_length")
    alone = (family.vertex_segments[:, 0] == family.segment("left_foot")) & (family.vertex_weights[:, 0] == 1)
    shift = joints[family.segment("left_foot")]
    np.testing.assert_allclose(vertices[alone], np.broadcast_to(shift, vertices[alone].shape), atol=1e-12)
    head = (family.vertex_segments[:, 0] == family.segment("head")) & (family.vertex_weights[:, 0] == 1)
    np.testing.assert_array_equal(vertices[head], 0)


def test_a_girth_mode_moves_skin_across_the_axis_and_no_joint(family, modes):
    vertices, joints = mode(modes, "shank_girth")
    np.testing.assert_array_equal(joints, 0)
    np.testing.assert_allclose(vertices[:, 2], 0, atol=1e-3)
    shank = (family.vertex_segments[:, 0] == family.segment("left_shank")) & (family.vertex_weights[:, 0] > 0.9)
    # calf: 45 to 75 mm thick, so a body twice as thick moves the skin by that much
    assert 0.04 < np.linalg.norm(vertices[shank], axis=1).mean() < 0.075


def test_clothes_lie_outside_and_leave_head_and_hands_free(family, modes):
    vertices, joints = mode(modes, "clothes")
    np.testing.assert_array_equal(joints, 0)

    def volume(points):
        a, b, c = points[family.faces].transpose(1, 0, 2)
        return np.sum(np.cross(a, b) * c) / 6

    assert volume(family.vertices_mean + 0.01 * vertices) > volume(family.vertices_mean) * 1.05
    bare = np.isin(family.vertex_segments[:, 0], [family.segment("head"), family.segment("left_hand")])
    whole = bare & (family.vertex_weights[:, 0] == 1)
    np.testing.assert_array_equal(vertices[whole], 0)
    assert "head" not in CLOTHED_SEGMENTS
    skin, _ = mode(modes, "skin")
    np.testing.assert_allclose(np.linalg.norm(skin, axis=1), 1, atol=1e-12)


def test_a_joint_mode_moves_the_joint_outwards_and_leaves_the_skin(family, modes):
    vertices, joints = mode(modes, "hip_lateral")
    np.testing.assert_array_equal(vertices, 0)
    assert joints[family.segment("left_thigh")][0] == 1
    assert joints[family.segment("right_thigh")][0] == -1
    assert np.count_nonzero(joints) == 2


def test_both_levels_agree_on_what_a_number_means():
    fine, coarse = (departure_modes(load_family(level, 1)) for level in LEVELS)
    assert fine.names == coarse.names
    for name in ("thigh_length", "pelvis_width", "shoulder_up"):
        np.testing.assert_allclose(mode(fine, name)[1], mode(coarse, name)[1], atol=1e-9)


def test_standardised_modes_have_unit_variance(modes):
    unit = modes.standardised()
    np.testing.assert_allclose(unit.vertices, modes.vertices * modes.sd[:, None, None])
    np.testing.assert_array_equal(unit.sd, 1)
    assert modes.keep("_girth").names == tuple(n for n in modes.names if n.endswith("_girth"))


def test_a_wider_space_has_the_family_first_and_the_departures_after_it(family, modes):
    space = ShapeSpace(
        names=tuple("abcd"),
        vertex_mean=family.vertices_mean,
        vertex_modes=family.vertices_modes,
        joint_mean=family.joints_mean,
        joint_modes=family.joints_modes,
        prior_mean=np.array([1.0, 0, 0, 0]),
        prior_covariance=2 * np.eye(4),
    )
    longer = modes.keep("thigh_length")
    wide = extended_space(space, longer)
    assert wide.names == ("a", "b", "c", "d", "thigh_length")
    numbers = np.array([0.5, 0, -1, 0, 2.0])
    expected = family.joints(numbers[:4]) + 2 * longer.sd[0] * longer.joints[0]
    np.testing.assert_allclose(wide.joints(numbers), expected, atol=1e-12)
    np.testing.assert_array_equal(np.diag(wide.prior_covariance), [2, 2, 2, 2, 1])
