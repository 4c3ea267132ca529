"""The posed body against its definition, and its derivatives against differences."""

import numpy as np
import pytest
from tests import people
from tests.performer import root_rotation

from marey.body.articulation.pose import PosedBody, packed_poses, unpacked_poses
from marey.body.articulation.skeleton import root_angles


@pytest.fixture
def posed(rng):
    body = people.stick_person(rng)
    return PosedBody(body, people.any_pose(rng, body))


def test_at_rest_the_skin_is_that_of_the_shape(rng):
    body = people.stick_person(rng)
    rest = people.any_pose(rng, body, spread=0.0)
    posed = PosedBody(body, rest)
    moved = rest.translation - body.joint_centres[0]
    np.testing.assert_allclose(posed.vertices, body.vertices + moved, atol=1e-13)
    np.testing.assert_allclose(posed.segment_rotation, np.broadcast_to(np.eye(3), (21, 3, 3)), atol=0)


def test_a_segment_turns_by_its_parents_turn_times_its_own_coordinates(posed):
    from marey.geometry import rotations

    skeleton, angles = posed.body.skeleton, posed.pose.angles
    for k, parent in enumerate(skeleton.parents):
        expected = posed.pose.rotation if parent < 0 else posed.segment_rotation[parent]
        for i in np.flatnonzero(skeleton.coordinate_segment == k):
            np.testing.assert_allclose(posed.world_axes[i], expected @ skeleton.axes[i], atol=1e-13)
            expected = expected @ rotations.about(skeleton.axes[i], angles[i])
        np.testing.assert_allclose(posed.segment_rotation[k], expected, atol=1e-13)


def test_the_skin_is_the_blend_of_its_segments_motions(posed):
    body = posed.body
    for v in range(0, 200, 23):
        expected = sum(
            w * (posed.segment_rotation[k] @ (body.vertices[v] - body.joint_centres[k]) + posed.segment_origin[k])
            for k, w in zip(body.vertex_segments[v], body.vertex_weights[v], strict=True)
        )
        np.testing.assert_allclose(posed.vertices[v], expected, atol=1e-13)


def test_parts_add_up_to_the_point(posed, rng):
    where = people.any_points(rng, posed.body, 50)
    segment, part = posed.parts(where)
    total = np.zeros((50, 3))
    for n in range(segment.shape[1]):
        used = segment[:, n] >= 0
        rotation, origin = posed.segment_rotation[segment[used, n]], posed.segment_origin[segment[used, n]]
        total[used] += np.einsum("nab,nb->na", rotation, part[used, n, :3]) + part[used, n, 3:] * origin
    np.testing.assert_allclose(total, posed.points(where), atol=1e-13)


def test_the_derivative_of_points_by_pose_and_shape_is_right(posed, rng):
    where, step = people.any_points(rng, posed.body, 30), 1e-6
    jacobian = np.concatenate([posed.pose_jacobian(*posed.parts(where)), posed.shape_jacobian(where)], 2)
    for column in range(jacobian.shape[2]):
        change = np.zeros(jacobian.shape[2])
        change[column] = step
        difference = (posed.moved(change).points(where) - posed.moved(-change).points(where)) / (2 * step)
        np.testing.assert_allclose(jacobian[:, :, column], difference, atol=2e-8)


def test_constraints_on_points_change_as_the_points_move(posed, rng):
    where, rows = people.any_points(rng, posed.body, 30), rng.normal(size=(30, 2, 3))
    moved = np.concatenate([posed.pose_jacobian(*posed.parts(where)), posed.shape_jacobian(where)], 2)
    expected = np.einsum("nra,nad->nrd", rows, moved)
    np.testing.assert_allclose(posed.constraint_jacobian(where, rows, shape=True), expected, atol=1e-12)
    degrees = len(posed.body.skeleton)
    np.testing.assert_allclose(posed.constraint_jacobian(where, rows), expected[:, :, :degrees], atol=1e-12)


def test_the_derivative_of_joint_centres_by_pose_and_shape_is_right(posed):
    segments, step = posed.body.joint_segments, 1e-6
    by_pose = posed.pose_jacobian(*posed.joint_parts(segments))
    jacobian = np.concatenate([by_pose, posed.origin_shape_jacobian()[segments]], 2)
    for column in range(jacobian.shape[2]):
        change = np.zeros(jacobian.shape[2])
        change[column] = step
        ahead, behind = (posed.moved(sign * change).segment_origin[segments] for sign in (1, -1))
        np.testing.assert_allclose(jacobian[:, :, column], (ahead - behind) / (2 * step), atol=2e-8)


def test_a_pose_steps_to_another_and_half_way(rng):
    body = people.stick_person(rng)
    a, b = people.any_pose(rng, body), people.any_pose(rng, body)
    there = a.step(a.change_to(b))
    np.testing.assert_allclose(there.rotation, b.rotation, atol=1e-12)
    half = a.between(b, 0.5)
    np.testing.assert_allclose(a.change_to(half), half.change_to(b), atol=1e-12)


def test_mirrored_limbs_flex_alike():
    skeleton = people.skeleton()
    names = [c.name for c in skeleton.coordinates]
    for left, right in ((n, n.replace("left_", "right_")) for n in names if n.startswith("left_")):
        a, b = skeleton.axes[names.index(left)], skeleton.axes[names.index(right)]
        np.testing.assert_allclose(a * [1, -1, -1], b, atol=5e-15)


def test_no_pose_of_a_hanging_raised_or_forward_arm_locks_the_shoulder():
    skeleton = people.skeleton()
    first = skeleton.axes[[c.name for c in skeleton.coordinates].index("left_shoulder_sweep")]
    for arm in ((0, 0, -1), (0, 0, 1), (0, -1, 0), (1, 0, 0), people.ARM):
        assert abs(first @ np.array(arm) / np.linalg.norm(arm)) < np.cos(np.deg2rad(45))


def test_root_angles_are_those_that_make_its_rotation(rng):
    angles = rng.uniform(-1.4, 1.4, (20, 3)) * [2, 1, 2]
    np.testing.assert_allclose(root_angles(root_rotation(angles)), angles, atol=1e-12)


@pytest.mark.parametrize("length", [0.0, 1e-12, 1e-6, 0.3, 3.0, 7.0])
def test_a_turn_of_the_root_is_the_exponential_and_stays_a_rotation(rng, length):
    from marey.body.articulation.kinematics import turned
    from marey.geometry import rotations

    direction = rng.normal(size=3)
    turn = length * direction / np.linalg.norm(direction)
    before = rotations.exp(rng.normal(size=3)) + rng.normal(size=(3, 3)) * 1e-9
    after = turned(before, turn)
    np.testing.assert_allclose(after, rotations.exp(turn) @ rotations.nearest(before), atol=1e-8)
    if length:
        np.testing.assert_allclose(after.T @ after, np.eye(3), atol=5e-15)


def test_the_shares_of_a_face_are_those_of_its_corners(rng):
    body = people.stick_person(rng)
    count, segment, weight = body.face_shares
    for f, corners in enumerate(body.faces):
        expected = np.zeros((len(body.skeleton.segment_names), 3))
        for c, v in enumerate(corners):
            np.add.at(expected[:, c], body.vertex_segments[v], body.vertex_weights[v])
        assert list(segment[f, : count[f]]) == list(np.flatnonzero(expected.any(1)))
        np.testing.assert_allclose(weight[f, : count[f]], expected[segment[f, : count[f]]], rtol=1e-15)
    assert body.with_numbers(body.numbers).face_shares is body.face_shares


def test_packed_poses_are_restored_unchanged(rng):
    body = people.stick_person(rng)
    poses = [people.any_pose(rng, body) for _ in range(3)]
    packed = packed_poses(poses)
    assert {name: values.shape for name, values in packed.items()} == {
        "translation": (3, 3), "rotation": (3, 3, 3), "angles": (3, len(poses[0].angles)),
    }  # fmt: skip
    for before, after in zip(poses, unpacked_poses({**packed, "score": np.zeros(3)}), strict=True):
        for name in packed:
            np.testing.assert_array_equal(getattr(after, name), getattr(before, name))
