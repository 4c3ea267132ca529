"""A scan in any posture becomes a body whose joint angles count from the common rest posture."""

import numpy as np
import pytest

from marey.body.articulation.kinematics import blend_skin
from marey.body.articulation.skeleton import full_skeleton
from marey.body.articulation.surface import Body, ShapeSpace
from marey.body.people.family import load_family
from marey.body.people.scan import scanned_body
from marey.errors import MareyError
from marey.geometry import rotations


def person(numbers: np.ndarray) -> Body:
    family = load_family("coarse")
    count = len(numbers)
    joints = family.joints_mean
    arm = joints[family.segment("left_hand")] - joints[family.segment("left_upperarm")]
    arm = arm / np.linalg.norm(arm)
    wrist = family.hinge_axes[family.segment("left_hand")]
    skeleton = full_skeleton(
        arm=arm, elbow=family.hinge_axes[family.segment("left_forearm")], palm=np.cross(wrist, arm)
    )
    assert skeleton.segment_names == family.segment_names
    space = ShapeSpace(
        names=tuple(f"family_{i}" for i in range(count)), vertex_mean=family.vertices_mean,
        vertex_modes=family.vertices_modes[:count], joint_mean=joints, joint_modes=family.joints_modes[:count],
        prior_mean=np.zeros(count), prior_covariance=np.eye(count),
    )  # fmt: skip
    return Body(
        skeleton=skeleton, space=space, numbers=numbers, faces=family.faces, vertex_segments=family.vertex_segments,
        vertex_weights=family.vertex_weights,
    )  # fmt: skip


@pytest.fixture(scope="module")
def template() -> Body:
    return person(np.zeros(4))


@pytest.fixture(scope="module")
def drawn() -> Body:
    return person(np.array([1.5, -1.0, 0.5, 1.0]))


def t_pose(body: Body, heading: float) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Raise the arms to the sides, spread the legs, turn the whole: skin and joint centres by segment."""
    names, parents = body.skeleton.segment_names, body.skeleton.parents
    turns = np.tile(np.eye(3), (len(names), 1, 1))
    origin = np.array(body.joint_centres)
    rest = body.joint_centres
    for k, name in enumerate(names):
        side, _, kind = name.rpartition("_")
        if parents[k] >= 0:
            turns[k] = turns[parents[k]]
            origin[k] = origin[parents[k]] + turns[parents[k]] @ (rest[k] - rest[parents[k]])
        sign = 1 if side == "left" else -1
        if kind == "upperarm":
            along = rest[names.index(f"{side}_forearm")] - rest[k]
            turns[k] = rotations.shortest(along, np.array([sign, 0.0, 0.0]))
        if kind == "thigh":
            turns[k] = rotations.about(np.array([0.0, -1.0, 0.0]), np.array(sign * 0.2))
        if kind == "foot":
            turns[k] = np.eye(3)
    skin = blend_skin(body.vertices, body.vertex_segments, body.vertex_weights, rest, turns, origin)
    turn = rotations.about(np.array([0.0, 0.0, 1.0]), np.array(heading))
    offset = np.array([3.0, -2.0, 1.0])
    return skin @ turn.T + offset, {n: turn @ o + offset for n, o in zip(names, origin, strict=True)}


def shares(body: Body) -> dict[str, np.ndarray]:
    return {
        name: np.where(body.vertex_segments == k, body.vertex_weights, 0).sum(1)
        for k, name in enumerate(body.skeleton.segment_names)
    }


@pytest.mark.parametrize("heading", [0.0, 2.0, -1.3])
def test_a_scan_in_a_t_pose_is_moved_to_the_rest_posture(template: Body, drawn: Body, heading: float):
    skin, joints = t_pose(drawn, heading)
    body = scanned_body(template, vertices=skin, faces=drawn.faces, joint_centres=joints, weights=shares(drawn))
    # The person's own limbs are not quite as straight as the template's, which determine how the scan is placed.
    np.testing.assert_allclose(body.joint_centres, drawn.joint_centres - drawn.joint_centres[0], atol=0.012)
    for k, parent in enumerate(body.skeleton.parents):
        if parent >= 0:
            length = np.linalg.norm(body.joint_centres[k] - body.joint_centres[parent])
            assert length == pytest.approx(np.linalg.norm(drawn.joint_centres[k] - drawn.joint_centres[parent]))
    apart = np.linalg.norm(body.vertices - (drawn.vertices - drawn.joint_centres[0]), axis=1)
    assert np.median(apart) < 0.01
    assert len(body.numbers) == 0


def test_borrowed_weights_give_the_skin_to_the_right_segments(template: Body, drawn: Body):
    skin, joints = t_pose(drawn, 0.7)
    body = scanned_body(template, vertices=skin, faces=drawn.faces, joint_centres=joints)
    found = np.stack(list(shares(body).values()), 1)
    true = np.stack(list(shares(drawn).values()), 1)
    assert (np.argmax(found, 1) == np.argmax(true, 1)).mean() > 0.93
    assert np.abs(found - true).sum(1).mean() < 0.2
    np.testing.assert_allclose(body.vertex_weights.sum(1), 1)


def test_joints_that_a_character_lacks_lie_where_they_do_in_people(template: Body, drawn: Body):
    skin, joints = t_pose(drawn, 0.0)
    lacking = ("pelvis", "abdomen", "left_clavicle", "right_clavicle", "left_toes", "right_toes", "head")
    fewer = {name: centre for name, centre in joints.items() if name not in lacking}
    body = scanned_body(template, vertices=skin, faces=drawn.faces, joint_centres=fewer)
    whole = scanned_body(template, vertices=skin, faces=drawn.faces, joint_centres=joints)
    offset = body.joint_centres - whole.joint_centres
    offset -= offset[body.skeleton.segment_names.index("left_thigh")]
    assert np.linalg.norm(offset, axis=1).max() < 0.03


def test_a_missing_limb_is_named_by_its_joint(template: Body, drawn: Body):
    skin, joints = t_pose(drawn, 0.0)
    del joints["left_shank"]
    with pytest.raises(MareyError, match="left_knee"):
        scanned_body(template, vertices=skin, faces=drawn.faces, joint_centres=joints)


def test_skin_without_weights_is_an_error(template: Body, drawn: Body):
    skin, joints = t_pose(drawn, 0.0)
    nothing = {name: np.zeros(len(skin)) for name in joints}
    with pytest.raises(MareyError, match="no weight for any segment"):
        scanned_body(template, vertices=skin, faces=drawn.faces, joint_centres=joints, weights=nothing)
