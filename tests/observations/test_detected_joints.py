"""Detected joints: offsets that turn with the segment, robust weights, and nothing from behind the camera."""

import numpy as np
import pytest
from tests import worlds
from tests.people import any_pose, stick_person

from marey.body.articulation.pose import PosedBody
from marey.observations.detected_joints import JOINT_FREEDOM, DetectedJoints, t_weights

SD_PX = 2.0
STEP = 1e-6


@pytest.fixture
def posed():
    body = worlds.person()
    return PosedBody(body, worlds.pose(body))


def detected(posed, camera, rng, *, away=0.0, freedom=JOINT_FREEDOM):
    """The joints with offsets of centimetres, seen a distance away from where they are [standard deviations]."""
    segments = posed.body.joint_segments
    offsets = rng.normal(size=(len(segments), 3)) * 0.03
    exact = DetectedJoints(
        camera=camera, segments=segments, offsets=offsets, pixels=np.zeros((len(segments), 2)),
        sd_px=rng.uniform(0.5, 1.5, len(segments)) * SD_PX, freedom=freedom,
    )  # fmt: skip
    direction = rng.normal(size=(len(segments), 2))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    pixels = camera.project(exact.predict(posed)) - away * exact.sd_px[:, None] * direction
    return (
        DetectedJoints(
            camera=camera,
            segments=segments,
            offsets=offsets,
            pixels=pixels,
            sd_px=exact.sd_px,
            freedom=freedom,
        ),
        direction,
    )


def test_the_offset_turns_with_the_segment_that_ends_at_the_joint(posed, rng):
    skeleton = posed.body.skeleton
    knee = skeleton.segment("left_shank")
    offset = np.array([0.01, 0.05, -0.02])
    camera = worlds.ring(1)[0]
    one = DetectedJoints(
        camera=camera, segments=np.array([knee]), offsets=offset[None], pixels=np.zeros((1, 2)), sd_px=np.ones(1)
    )
    thigh = posed.segment_rotation[skeleton.segment("left_thigh")]
    np.testing.assert_allclose(one.predict(posed)[0], posed.segment_origin[knee] + thigh @ offset, atol=1e-12)
    # Bending the knee moves the shank, and leaves the thigh and the point on it.
    angles = posed.pose.angles.copy()
    angles[worlds.column(skeleton, "left_knee_flexion")] += 0.5
    bent = PosedBody(posed.body, type(posed.pose)(posed.pose.translation, posed.pose.rotation, angles))
    np.testing.assert_allclose(one.predict(bent), one.predict(posed), atol=1e-12)


def test_the_residual_is_in_standard_deviations_and_has_the_root_of_the_weight(posed, rng):
    camera = worlds.ring(1)[0]
    for away in (0.0, 0.5, 4.0):
        seen, direction = detected(posed, camera, rng, away=away)
        weight = (1 + 2 / JOINT_FREEDOM) / (1 + away**2 / JOINT_FREEDOM)
        residual = seen.whiten(posed).residual.reshape(-1, 2)
        np.testing.assert_allclose(residual, np.sqrt(weight) * away * direction, atol=1e-9)


@pytest.mark.parametrize("shape", [False, True], ids=["pose", "pose and shape"])
@pytest.mark.parametrize("freedom", [JOINT_FREEDOM, 1.0, np.inf])
def test_the_derivative_is_the_change_with_the_weights_held(freedom, shape, rng):
    body = stick_person(rng)
    posed = PosedBody(body, any_pose(rng, body, spread=1.2))
    camera = worlds.looking_at(posed.segment_origin.mean(0), posed.segment_origin.mean(0) + [4.0, 3.0, 1.0])
    seen, _ = detected(posed, camera, rng, away=2.0, freedom=freedom)
    plain = DetectedJoints(
        camera=camera, segments=seen.segments, offsets=seen.offsets, pixels=seen.pixels, sd_px=seen.sd_px,
        freedom=np.inf,
    )  # fmt: skip
    model = seen.linearize(posed, shape=shape)
    held = np.sqrt(t_weights(np.full(2 * len(seen.segments), 4.0), freedom))
    columns = len(body.skeleton) + (len(body.space) if shape else 0)
    assert model.jacobian.shape == (2 * len(seen.segments), columns)
    for column in range(columns):
        change = np.zeros(columns)
        change[column] = STEP
        ahead = plain.linearize(posed.moved(change), shape=shape).residual
        behind = plain.linearize(posed.moved(-change), shape=shape).residual
        difference = held * (ahead - behind) / (2 * STEP)
        # Central differences err by the step squared and by rounding over the step.
        tolerance = 1e-6 * np.abs(model.jacobian).max()
        np.testing.assert_allclose(model.jacobian[:, column], difference, atol=tolerance, err_msg=f"column {column}")


def test_a_joint_behind_the_camera_contributes_nothing(posed, rng):
    camera = worlds.looking_at(np.array([0.0, 5.0, 0.3]), np.array([0.0, 0.3, 0.3]))
    segments = posed.body.joint_segments
    assert (camera.depths(posed.segment_origin[segments]) < 0).all()
    behind = DetectedJoints(
        camera=camera, segments=segments, offsets=np.zeros((16, 3)), pixels=np.zeros((16, 2)), sd_px=np.ones(16)
    )
    for shape in (False, True):
        model = behind.linearize(posed, shape=shape)
        np.testing.assert_array_equal(model.residual, 0)
        np.testing.assert_array_equal(model.jacobian, 0)


def test_the_weights_are_those_of_the_t_distribution(rng):
    # The weight is the derivative of the negative log-likelihood, (f + 2) / 2 log(1 + d2 / f), by d2 / 2.
    squares = rng.uniform(0, 50, 20)
    for freedom in (1.0, JOINT_FREEDOM, 30.0):
        slope = (freedom + 2) * (np.log1p((squares + 1e-5) / freedom) - np.log1p((squares - 1e-5) / freedom)) / 2e-5
        np.testing.assert_allclose(t_weights(squares, freedom), slope, rtol=1e-5)


def test_errors_of_the_t_distribution_have_a_mean_weighted_square_of_two(rng):
    # Of a bivariate t distribution: E[w d2] = 2, as E[d2] = 2 of a normal one; a million draws give it within 0.01.
    normal, chi = rng.normal(size=(1_000_000, 2)), rng.chisquare(JOINT_FREEDOM, 1_000_000)
    squares = np.sum(normal**2, axis=1) * JOINT_FREEDOM / chi
    assert np.mean(t_weights(squares, JOINT_FREEDOM) * squares) == pytest.approx(2.0, abs=0.01)


def test_with_infinite_freedom_all_weights_are_one_and_with_finite_freedom_they_fall():
    squares = np.array([0.0, 1.0, 100.0, 1e6])
    np.testing.assert_array_equal(t_weights(squares, np.inf), 1.0)
    assert (np.diff(t_weights(squares, JOINT_FREEDOM)) < 0).all()
    assert t_weights(squares, JOINT_FREEDOM)[-1] < 1e-5
