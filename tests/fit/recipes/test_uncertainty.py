"""The projected uncertainty of a pose against random draws, and the contradictions between the cameras."""

from dataclasses import replace

import numpy as np
import pytest
from tests import worlds
from tests.reference_jackknife import camera_spread, without_camera

from marey.body.articulation.pose import PosedBody
from marey.body.articulation.skeleton import COLOUR_PARTS
from marey.body.people.person import person_body
from marey.fit.recipes.person import PersonSettings, refine_person
from marey.fit.recipes.sequence import join_pieces
from marey.fit.recipes.uncertainty import (
    part_deviations,
    part_displacements,
    with_camera_contradictions,
    with_unusual_shoulders,
)

DRAWS = 300


@pytest.fixture(scope="module")
def posed():
    body = worlds.scan()
    return PosedBody(body, worlds.pose(body, at=(0.1, 0.0, 0.0)))


def face_centres(posed):
    return posed.vertices[posed.body.faces].mean(axis=1)


def test_the_deviations_are_those_of_random_draws_of_the_pose(posed, rng):
    cameras, degrees = worlds.ring(2), len(posed.body.skeleton)
    # Correlated, of different sizes: up to a centimetre and two degrees, so that the projection is linear.
    root = rng.normal(size=(degrees, degrees)) / np.sqrt(degrees) * 0.01
    root[6:] *= np.where(rng.random(degrees - 6) < 0.5, 3.0, 0.3)[:, None]
    found = part_deviations(posed, root @ root.T, cameras)
    changes = rng.normal(size=(DRAWS, degrees)) @ root.T
    centres = np.array([face_centres(posed.moved(change)) for change in changes])
    for c, camera in enumerate(cameras):
        pixels = np.array([camera.project(each) for each in centres])
        variance = 0.5 * np.sum((pixels - camera.project(face_centres(posed))) ** 2, axis=(0, 2)) / DRAWS
        drawn = [np.sqrt(variance[posed.body.face_colour_part == p].mean()) for p in range(len(COLOUR_PARTS))]
        # The draws err by 1 / sqrt(2 x 300) = 4 % at one degree of freedom; twelve points stand for all of a part.
        np.testing.assert_allclose(found[c], drawn, rtol=0.2)
    assert found.max() > 2 * found.min()


def test_the_displacement_of_a_shift_is_its_length_in_the_image(posed):
    camera = worlds.looking_at(np.array([0.1, 0.0, 0.0]), np.array([0.1, -50.0, 0.0]), focal=4000.0)
    along, across = np.eye(len(posed.body.skeleton))[:2] * 0.01
    # As above: one centimetre at 80 px/m in one of two axes of the image.
    np.testing.assert_allclose(part_displacements(posed, posed.moved(along), [camera]), 0.8 * np.sqrt(0.5), rtol=0.02)
    assert part_displacements(posed, posed.moved(across), [camera]).max() < 0.02
    assert not part_displacements(posed, posed, [camera]).any()


def test_only_the_part_that_moves_is_displaced(posed):
    names = posed.body.skeleton.coordinate_names
    change = np.zeros(len(posed.body.skeleton))
    change[names.index("left_knee_flexion")] = 0.1
    found = part_displacements(posed, posed.moved(change), worlds.ring(3))
    moved = np.isin(COLOUR_PARTS, ("shank", "foot"))
    assert (found[:, moved] > 0.3).all()
    unmoved = np.isin(COLOUR_PARTS, ("head", "forearm", "hand"))
    np.testing.assert_allclose(found[:, unmoved], 0.0, atol=1e-9)


def test_a_shift_towards_the_camera_is_not_seen_and_one_across_is_in_pixels(posed):
    camera = worlds.looking_at(np.array([0.1, 0.0, 0.0]), np.array([0.1, -50.0, 0.0]), focal=4000.0)
    for axis, expected in ((0, 0.5), (1, 0.0)):
        covariance = np.zeros((len(posed.body.skeleton),) * 2)
        covariance[axis, axis] = 0.01**2
        # One centimetre at 80 px/m in one of two axes of the image; the body is a hundredth of the distance deep.
        found = part_deviations(posed, covariance, [camera])
        np.testing.assert_allclose(found[0], 0.8 * np.sqrt(expected), atol=0.02)


def test_a_joint_that_is_not_known_makes_only_what_lies_beyond_it_uncertain(posed):
    covariance = np.zeros((len(posed.body.skeleton),) * 2)
    elbow = 6 + worlds.column(posed.body.skeleton, "left_elbow_flexion")
    covariance[elbow, elbow] = 0.1**2
    of_part = dict(zip(COLOUR_PARTS, part_deviations(posed, covariance, worlds.ring(1))[0], strict=True))
    # The forearm turns about its end: 0.1 rad at 0.1 m is one centimetre, at 94 px/m, in one of two axes of the image.
    assert of_part["hand"] > of_part["forearm"] > 0.5
    still = set(COLOUR_PARTS) - {"hand", "forearm", "upperarm"}
    assert all(of_part[part] == 0 for part in still)


def test_parts_that_are_behind_the_camera_or_not_of_the_body_have_no_deviation(posed):
    covariance = np.eye(len(posed.body.skeleton)) * 1e-4
    behind = worlds.looking_at(np.array([0.0, 5.0, 0.3]), np.array([0.0, 1.0, 0.3]))
    assert np.isnan(part_deviations(posed, covariance, [behind])).all()
    arm = person_body("coarse", preset="left_arm")
    one = PosedBody(arm, worlds.pose(arm, {}))
    found = part_deviations(one, np.eye(len(arm.skeleton)) * 1e-4, worlds.ring(1))[0]
    known = {arm.skeleton.segment_colour_part[s] for s in arm.face_segment}
    np.testing.assert_array_equal(np.isfinite(found), [p in known for p in range(len(COLOUR_PARTS))])


@pytest.fixture(scope="module")
def motion():
    """Four frames of a known person in four cameras."""
    body, cameras = worlds.scan(), worlds.ring(size=(100, 120), focal=150.0)
    poses = worlds.swing(body, 4)
    return body, dict(enumerate(poses)), worlds.take([PosedBody(body, pose) for pose in poses], cameras)


def shifted(take, camera: int, columns: int):
    """The same take with the silhouettes of one camera shifted."""

    def masks_of(frame):
        masks = list(take.masks_of(frame))
        masks[camera] = np.roll(masks[camera], columns, axis=1)
        return masks

    return replace(take, masks_of=masks_of)


def test_a_take_without_a_camera_has_the_silhouettes_of_the_others(motion):
    take = motion[2]
    hidden = replace(take, hidden_of=lambda frame: [np.full((2, 2), c == frame) for c in range(4)])
    rest = without_camera(hidden, 2)
    assert rest.cameras == (take.cameras[0], take.cameras[1], take.cameras[3])
    for mine, other in zip(rest.masks_of(1), [take.masks_of(1)[c] for c in (0, 1, 3)], strict=True):
        np.testing.assert_array_equal(mine, other)
    assert rest.edges_of(1) is None
    assert [bool(mask.any()) for mask in rest.hidden_of(3) or []] == [False, False, True]


def refined(motion, take):
    body, poses, _ = motion
    return join_pieces(list(refine_person(take, body, poses, [], PersonSettings(), height=160.0, rounds=2)))


def test_one_step_without_each_camera_shows_what_whole_refinements_show(motion):
    """The shifted camera moves the body by about a third of 5 cm; `camera_spread` refines again without each camera."""
    agreeing, contradicting = refined(motion, motion[2]), refined(motion, shifted(motion[2], 1, 4))
    body, poses, take = motion
    slow = camera_spread(shifted(take, 1, 4), body, poses, PersonSettings(), height=160.0)
    for k, frame in enumerate(contradicting.frames):
        place = np.sqrt(np.trace(contradicting.between_cameras[k][:3, :3]))
        assert 0.01 < place < 0.1
        assert place > 5 * np.sqrt(np.trace(agreeing.between_cameras[k][:3, :3]))
        assert place == pytest.approx(np.sqrt(np.trace(slow[int(frame)][:3, :3])), rel=0.5)


def test_contradictions_are_averaged_over_time_and_added(motion):
    fit = refined(motion, shifted(motion[2], 1, 4))
    found = with_camera_contradictions(fit, rate=4.0)
    degrees = len(fit.body.skeleton)
    # Half a second is two frames: the first of four averages the first three.
    added = found.covariance[0, :degrees, :degrees] - fit.covariance[0, :degrees, :degrees]
    np.testing.assert_allclose(added, fit.between_cameras[:3].mean(0), atol=1e-12)
    two = refined(motion, without_camera(without_camera(motion[2], 3), 0))
    assert two.between_cameras is None
    assert with_camera_contradictions(two, rate=30.0) is two


def test_an_unusual_shoulder_is_uncertain_and_what_is_observed_stays(motion):
    fit = refined(motion, motion[2])
    assert np.array_equal(with_unusual_shoulders(fit).covariance, fit.covariance)  # The shoulders of walking are usual.
    skeleton = fit.body.skeleton
    k = [c.name for c in skeleton.coordinates].index("left_clavicle_elevation")
    raised = np.array(fit.poses[1].angles)
    raised[k] += np.deg2rad(20.0)  # 12 degrees more than the standard deviation of 8 degrees.
    poses = (fit.poses[0], replace(fit.poses[1], angles=raised), *fit.poses[2:])
    found = with_unusual_shoulders(replace(fit, poses=poses)).covariance
    added = found - fit.covariance
    assert not added[[0, 2, 3]].any()
    assert np.sqrt(added[1, 6 + k, 6 + k]) == pytest.approx(np.deg2rad(12.0), abs=np.deg2rad(5.0))
    # One change of the pose, which is as probable as any of this size.
    change = added[1, 6 + k] / np.sqrt(added[1, 6 + k, 6 + k])
    np.testing.assert_allclose(added[1], np.outer(change, change), atol=1e-12)
    ratio = change @ np.linalg.solve(fit.covariance[1], change)
    assert ratio == pytest.approx(change[6 + k] ** 2 / fit.covariance[1, 6 + k, 6 + k], rel=1e-6)
