"""Motion from detected joints alone, and detected joints in a refinement: made motions whose truth is known."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from tests import worlds
from tests.detected import JOINTS, detections, joints

from marey.body.articulation.pose import PosedBody
from marey.body.people.person import person_body
from marey.fit.recipes import detections as recipe
from marey.fit.recipes.detections import (
    DetectionSettings,
    DetectionTerms,
    JoinedTerms,
    PersonDetections,
    joint_offsets,
    track_detections,
    with_usual_limbs,
)
from marey.fit.recipes.person import PersonSettings
from marey.fit.recipes.seen_people import find_people
from marey.fit.solver.picture_times import PictureTimes
from marey.observations.detected_joints import JOINT_FREEDOM

FRAMES = 16
NOISE_PX = 0.7
CAMERAS = worlds.ring(4, size=(400, 240))


@pytest.fixture(scope="module")
def motion():
    body = worlds.scan()
    return [PosedBody(body, pose) for pose in worlds.swing(body, FRAMES)]


def seen(motion, cameras=CAMERAS, **errors):
    """The detections of one person, and its track."""
    pixels, confidence = detections([motion], cameras, **errors)
    [track, *others] = find_people(cameras, pixels, confidence, rate=worlds.RATE)
    assert not others
    return PersonDetections.of_track(cameras, JOINTS, pixels, confidence, track), track


def errors(poses, motion):
    """Distances (F, J) of the joints [m]."""
    return np.array(
        [np.linalg.norm(joints(PosedBody(motion[f].body, p)) - joints(motion[f]), axis=1) for f, p in poses.items()]
    )


def noise_in_space(motion):
    """Root mean square distance of a joint that is triangulated from pixels with the noise [m]."""
    centre = joints(motion[0]).mean(0)
    slopes = np.concatenate([camera.project_with_derivative(centre[None])[1][0] for camera in CAMERAS])
    return NOISE_PX * np.sqrt(np.trace(np.linalg.inv(slopes.T @ slopes)))


@pytest.mark.slow
def test_a_motion_is_recovered_within_the_noise_of_its_joints(motion, rng):
    found, track = seen(motion, noise=NOISE_PX, rng=rng)
    body, poses, first = track_detections(found, track, motion[0].body, PersonSettings(), rate=worlds.RATE)
    assert list(poses) == list(range(FRAMES))
    assert first in poses
    away = errors(poses, motion)
    # Sixteen joints in space have 48 numbers, a pose has 54 degrees of freedom: the fit may follow all of the noise.
    # Usual angles and the prediction pull by less than the noise.
    assert np.sqrt(np.mean(away**2)) < 1.5 * noise_in_space(motion)
    assert away.max() < 0.06
    np.testing.assert_array_equal(body.vertices, motion[0].body.vertices)


@pytest.mark.slow
def test_the_sizes_follow_from_the_joints_of_the_first_frame(motion):
    body = worlds.person()
    large = body.with_numbers(np.array([1.5, -1.0, 0.0, 0.0, 0.0, 0.0]) * np.sqrt(np.diag(body.space.prior_covariance)))
    there = [PosedBody(large, posed.pose) for posed in motion[:3]]
    found, track = seen(there)
    fitted, _, _ = track_detections(found, track, body, PersonSettings(), rate=worlds.RATE)

    def thigh(of):
        ends = [of.skeleton.segment(name) for name in ("left_thigh", "left_shank")]
        return np.linalg.norm(np.subtract(*of.joint_centres[ends]))

    assert abs(thigh(large) - thigh(body)) > 0.02
    assert abs(thigh(fitted) - thigh(large)) < 0.3 * abs(thigh(large) - thigh(body))


@pytest.mark.slow
def test_frames_after_a_gap_are_found_anew(motion, rng):
    body = motion[0].body
    # The person is away for 24 frames, longer than a prediction is worth, and comes back turned by half a turn.
    late = [PosedBody(body, worlds.pose(body, yaw=3.0, at=(0.3, 0.1, 0.0))) for _ in range(4)]
    person = [*motion[:5], *[None] * 24, *late]
    found, track = seen(person, noise=NOISE_PX, rng=rng)
    assert PersonSettings().track.longest_hole * worlds.RATE < 24
    _, poses, _ = track_detections(found, track, body, PersonSettings(), rate=worlds.RATE)
    assert list(poses) == [*range(5), *range(29, 33)]
    assert np.sqrt(np.mean(errors(poses, person) ** 2)) < 1.5 * noise_in_space(motion)


@pytest.mark.slow
def test_frames_in_which_a_detector_lost_the_person_for_a_moment_have_no_pose_but_do_not_stop_it(motion, rng):
    person = [posed if frame not in (6, 7) else None for frame, posed in enumerate(motion)]
    found, track = seen(person, noise=NOISE_PX, rng=rng)
    _, poses, _ = track_detections(found, track, motion[0].body, PersonSettings(), rate=worlds.RATE)
    assert list(poses) == [frame for frame in range(FRAMES) if frame not in (6, 7)]
    assert np.sqrt(np.mean(errors(poses, person) ** 2)) < 1.5 * noise_in_space(motion)


@pytest.mark.slow
def test_the_neutral_posture_leads_out_of_a_wrong_minimum(motion, rng, monkeypatch):
    found, _ = seen(motion[:1])
    limits = motion[0].body.skeleton.limits.T
    with_neutral, without = [], []
    for _ in range(30):
        far = np.clip(motion[0].pose.angles + 1.3 * rng.normal(size=limits.shape[1]), *limits)
        start = replace(motion[0], pose=replace(motion[0].pose, angles=far))
        with_neutral.append(errors(recipe._follow(found, start, [0], PersonSettings(), worlds.RATE), motion).max())
        with monkeypatch.context() as patch:
            patch.setattr(recipe, "with_usual_limbs", lambda posed: posed)
            without.append(errors(recipe._follow(found, start, [0], PersonSettings(), worlds.RATE), motion).max())
    wrong = np.array(without) > 0.2
    assert wrong.any()
    # The usual angles pull by centimetres, as a single frame is all that there is.
    assert np.max(np.array(with_neutral)[wrong]) < 0.1


def test_usual_limbs_keep_place_direction_and_trunk(motion):
    posed = motion[3]
    neutral = with_usual_limbs(posed)
    skeleton = posed.body.skeleton
    limbs = np.array(
        [name.startswith(("left_", "right_")) and "clavicle" not in name for name in skeleton.segment_names]
    )
    # Hips and shoulders are where they were, for only angles beyond them have changed.
    kept = ~limbs | np.array([name.endswith(("thigh", "upperarm")) for name in skeleton.segment_names])
    np.testing.assert_allclose(neutral.segment_origin[kept], posed.segment_origin[kept], atol=1e-12)
    elbow = worlds.column(skeleton, "left_elbow_flexion")
    assert neutral.pose.angles[elbow] == skeleton.habit[0][elbow] != posed.pose.angles[elbow]


def test_constant_offsets_are_recovered_in_the_frame_of_the_segment(motion, rng):
    offsets = rng.normal(size=(len(JOINTS), 3)) * 0.02
    found, _ = seen(motion, offsets=offsets)
    poses = {frame: posed.pose for frame, posed in enumerate(motion)}
    estimated = joint_offsets(found, poses, motion[0].body)
    settings = DetectionSettings()
    # Each camera measures two of three axes with sd_m; the prior then shortens an offset by this share.
    weight = (1 + 2 / JOINT_FREEDOM) * 2 / 3 * len(CAMERAS)
    share = settings.sd_m**2 / (settings.offset_sd_m**2 * settings.distinct_frames * weight)
    assert share < 0.011
    # Directions between the cameras' optical axes are measured less well than the mean one: three times at most.
    assert np.linalg.norm(estimated - offsets, axis=1).max() < 3 * share * np.linalg.norm(offsets, axis=1).max() + 1e-4


def test_the_prior_shortens_the_offset_of_a_hip_less_than_that_of_another_joint(motion):
    # One image of one frame hardly measures an offset beside its prior.
    found, _ = seen(motion[:1], offsets=np.full((len(JOINTS), 3), 0.01))
    confidence = found.confidence.copy()
    confidence[:, 1:] = 0.0
    once = replace(found, confidence=confidence, settings=replace(found.settings, distinct_frames=0.05))
    size = np.linalg.norm(joint_offsets(once, {0: motion[0].pose}, motion[0].body), axis=1)
    assert size[JOINTS.index("left_hip")] > 1.5 * size[JOINTS.index("left_shoulder")] > 0


def test_the_offset_of_a_joint_is_not_that_of_one_wrong_camera_and_without_detections_it_is_zero(motion):
    found, _ = seen(motion)
    pixels, confidence = found.pixels.copy(), found.confidence.copy()
    elbow, wrist = JOINTS.index("left_elbow"), JOINTS.index("right_wrist")
    pixels[:, 1, elbow] += [60.0, 0.0]
    confidence[:, :, wrist] = 0.0
    spoiled = replace(found, pixels=pixels, confidence=confidence)
    poses = {frame: posed.pose for frame, posed in enumerate(motion)}
    offsets = joint_offsets(spoiled, poses, motion[0].body)
    np.testing.assert_array_equal(offsets[wrist], 0.0)
    # 60 px are 0.64 m; the mean of four cameras would be off by 0.16 m or more.
    assert np.linalg.norm(offsets[elbow]) < 0.02
    others = np.delete(np.arange(len(JOINTS)), [elbow, wrist])
    np.testing.assert_allclose(offsets[others], 0.0, atol=1e-6)


def test_joints_that_a_preset_does_not_follow_are_not_used(motion, rng):
    upper = person_body("coarse", preset="upper")
    found, _ = seen(motion[:1])
    posed = PosedBody(upper, worlds.pose(upper, {}))
    names = {JOINTS[j] for j in np.flatnonzero(found.segments(upper) >= 0)}
    assert "left_wrist" in names
    assert "left_knee" not in names
    for observed in found.of_frame(0, posed, np.zeros((len(JOINTS), 3))):
        assert len(observed.segments) == len(names)
    moved = joint_offsets(found, {0: posed.pose}, upper)
    without = [j for j, name in enumerate(JOINTS) if name not in names]
    np.testing.assert_array_equal(moved[without], 0.0)


def test_standard_deviations_are_lengths_at_the_body_and_grow_as_the_joints_become_less_certain(motion):
    found, _ = seen(motion[:1])
    confidence = found.confidence.copy()
    confidence[0, 0, :3] = [0.5, 0.31, 0.29]
    found = replace(found, confidence=confidence, settings=DetectionSettings(weakest=0.4))
    [first, *_] = found.of_frame(0, motion[0], np.zeros((len(JOINTS), 3)))
    camera = CAMERAS[0]
    away = np.linalg.norm(motion[0].segment_origin[first.segments] - camera.centre, axis=1)
    full = 0.02 * camera.matrix[0, 0] / away
    # The third joint is not used; the others have 1 / confidence, which 0.4 limits.
    assert len(first.segments) == len(JOINTS) - 1
    np.testing.assert_allclose(first.sd_px / full, [1 / 0.5, 1 / 0.4, *[1.0] * (len(JOINTS) - 3)])


@pytest.mark.parametrize("alone", [False, True], ids=["beside silhouettes", "alone"])
def test_terms_are_the_equations_of_the_observations(motion, rng, alone):
    body = worlds.person()
    people = [PosedBody(body, posed.pose) for posed in motion[:3]]
    found, _ = seen(people, noise=NOISE_PX, rng=rng)
    poses = {frame: posed.pose for frame, posed in enumerate(people)}
    terms = DetectionTerms.of_round(found, poses, body, alone=alone)
    assert terms.shared == 0
    information, gradient = terms.terms(1, people[1])
    size = len(body.skeleton) + len(body.space)
    expected, slope = np.zeros((size, size)), np.zeros(size)
    for observed in found.of_frame(1, people[1], joint_offsets(found, poses, body)):
        # Beside silhouettes the detector's errors are the same in nine frames.
        repeated = 1.0 if alone else np.sqrt(found.settings.repeated_frames)
        model = replace(observed, sd_px=observed.sd_px * repeated).whiten(people[1], shape=True)
        expected += model.jacobian.T @ model.jacobian
        slope += model.jacobian.T @ model.residual
    np.testing.assert_allclose(information, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())
    np.testing.assert_allclose(gradient, slope, rtol=1e-9, atol=1e-9 * np.abs(slope).max())
    assert np.abs(expected).max() > 0


def test_of_several_persons_only_the_one_of_the_track_is_used(motion):
    other = [PosedBody(p.body, worlds.pose(p.body, yaw=2.0, at=(0.9, 0.4, 0.0))) for p in motion[:4]]
    pixels, confidence = detections([other[:2] + [None] * 2, motion[:4]], CAMERAS)
    track = find_people(CAMERAS, pixels, confidence, rate=worlds.RATE)[0]
    found = PersonDetections.of_track(CAMERAS, JOINTS, pixels, confidence, track)
    np.testing.assert_allclose(found.pixels, pixels[:, :, 1])
    assert found.agreeing.all()
    assert not found.elsewhere.any()


def test_images_in_which_only_other_people_are_detected_are_known(motion):
    other = [PosedBody(p.body, worlds.pose(p.body, yaw=2.0, at=(0.9, 0.4, 0.0))) for p in motion[:2]]
    pixels, confidence = detections([motion[:2]], CAMERAS)
    pixels[0, 0] = detections([other], CAMERAS)[0][0, 0]
    pixels[1, 1], confidence[1, 1] = np.nan, 0.0
    track = find_people(CAMERAS, pixels, confidence, rate=worlds.RATE)[0]
    found = PersonDetections.of_track(CAMERAS, JOINTS, pixels, confidence, track)
    assert np.argwhere(found.elsewhere).tolist() == [[0, 0]]


def test_joined_terms_are_the_sum(motion):
    one, two = np.eye(3), np.arange(9.0).reshape(3, 3)
    kinds = [SimpleNamespace(shared=0, terms=lambda frame, body, each=each: (each, each[0])) for each in (one, two)]
    information, gradient = JoinedTerms(tuple(kinds)).terms(0, motion[0])
    np.testing.assert_array_equal(information, one + two)
    np.testing.assert_array_equal(gradient, one[0] + two[0])


def test_joints_of_late_pictures_are_interpolated_to_the_frame(rng):
    late = np.stack([np.zeros(8), np.full(8, 0.4), np.full(8, -0.3), np.linspace(-0.5, 0.5, 8)])
    start, speed = rng.normal(size=(2, 4, 3, 2)) * 10
    there = start + speed * (np.arange(8) + late).T[:, :, None, None]
    there[5, 1, 2] = np.nan
    found = PersonDetections(
        cameras=CAMERAS, joint_names=JOINTS[:3], pixels=there, confidence=np.ones((8, 4, 3)),
        agreeing=np.ones((8, 4, 3), bool), elsewhere=np.zeros((8, 4), bool),
    ).at_frames(PictureTimes(late))  # fmt: skip
    wanted = np.broadcast_to(start, there.shape) + speed * np.arange(8)[:, None, None, None]
    inner = found.pixels[1:-1]
    kept = np.isnan(there)
    # A joint beside a missing one stays where it was found.
    kept[6, 1, 2] = True
    np.testing.assert_allclose(np.where(kept[1:-1], 0, inner), np.where(kept[1:-1], 0, wanted[1:-1]), atol=1e-9)
    np.testing.assert_array_equal(found.pixels[6, 1, 2], there[6, 1, 2])
    np.testing.assert_array_equal(found.pixels[5, 1, 2], np.nan)
    np.testing.assert_array_equal(found.pixels[:, 0], there[:, 0])


@pytest.mark.slow
def test_the_tracking_starts_from_the_given_joints_of_a_frame(motion, rng):
    found, track = seen(motion, noise=NOISE_PX, rng=rng)
    frame, true = 4, np.stack([camera.project(joints(motion[4])) for camera in CAMERAS])
    wrong = np.array(found.pixels)
    wrong[frame] += 40.0
    given = replace(found, pixels=wrong).with_given(frame, true, np.ones(true.shape[:2]))
    np.testing.assert_array_equal(given.pixels[frame], true)
    np.testing.assert_array_equal(np.delete(given.pixels, frame, 0), np.delete(wrong, frame, 0))
    assert given.agreeing[frame].all()
    again = track.with_seen(given.seen(frame, track.persons(frame, len(CAMERAS))))
    assert [each.frame for each in again.seen] == [each.frame for each in track.seen]
    np.testing.assert_allclose(again.seen[frame].points, joints(motion[frame]), atol=1e-6)
    _, poses, first = track_detections(
        given, again, motion[0].body, PersonSettings(), rate=worlds.RATE, start=frame
    )  # fmt: skip
    assert first == frame
    # The other frames have the detector's noise alone.
    assert errors(poses, motion)[frame].mean() < noise_in_space(motion)


def test_a_joint_that_is_given_in_one_image_agrees_with_those_of_the_detector_in_the_others(motion):
    found, _ = seen(motion)
    pixels = np.full(found.pixels[0].shape, np.nan)
    pixels[1, 3] = found.pixels[0, 1, 3] + 1.0
    given = found.with_given(0, pixels, np.ones(pixels.shape[:2]))
    np.testing.assert_array_equal(given.agreeing[0], found.agreeing[0])
    pixels[0, 3] = found.pixels[0, 0, 3]
    given = found.with_given(0, pixels, np.ones(pixels.shape[:2]))
    assert given.agreeing[0, :, 3].tolist() == [True, True] + [False] * (len(CAMERAS) - 2)


def test_the_likelihood_of_a_pose_falls_with_its_distance_from_the_detected_joints(motion):
    found, _ = seen(motion)
    zero, values = np.zeros((len(JOINTS), 3)), []
    for away in (0.0, 0.05, 0.5):
        pose = motion[2].pose
        moved = replace(pose, translation=pose.translation + [away, 0, 0])
        values.append(found.log_likelihood(2, PosedBody(motion[2].body, moved), zero))
    assert values[0] == pytest.approx(0.0, abs=0.5)
    assert values[0] > values[1] + 1 > values[2] + 2
