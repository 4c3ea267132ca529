"""The projected uncertainty of a pose against random draws of the pose."""

import numpy as np
import pytest
from tests import worlds

from marey.body.articulation.pose import PosedBody
from marey.body.articulation.skeleton import COLOUR_PARTS
from marey.body.people.person import person_body
from marey.fit.recipes.projected_uncertainty import part_deviations

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
