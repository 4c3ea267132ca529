"""Persons found by agreement of several images: who is who, the points in space, and one track per person."""

import numpy as np
import pytest
from tests import worlds
from tests.detected import JOINTS, detections, joints

from marey.body.articulation.pose import PosedBody
from marey.fit.recipes.seen_people import AssociationSettings, find_people

FRAMES = 20
NOISE_PX = 0.5


def walking(at, frames=range(FRAMES), *, count=FRAMES, yaw=0.0, speed=0.02, height=0.0):
    """A person who walks on and is there in some frames only."""
    body = worlds.person()
    poses = [worlds.pose(body, yaw=yaw, at=(at[0], at[1] + speed * frame, height)) for frame in range(count)]
    return [PosedBody(body, pose) if frame in frames else None for frame, pose in enumerate(poses)]


@pytest.fixture(scope="module")
def pair():
    """Two people, of whom the second is there in half of the frames, and four cameras."""
    return walking((0.45, -0.2)), walking((-0.45, 0.3), range(5, 15), yaw=2.0)


@pytest.fixture
def shuffled(pair, rng):
    """The key points of both in any order; camera 2 sees the second person only, camera 4 the first one only."""
    cameras = worlds.ring(4, size=(400, 240))
    pixels, confidence = detections(pair, cameras, noise=NOISE_PX, rng=rng, confidence=0.8)
    pixels[:, 1, 0], confidence[:, 1, 0] = np.nan, 0.0
    pixels[:, 3, 1], confidence[:, 3, 1] = np.nan, 0.0
    place = np.zeros((FRAMES, len(cameras), 2), int)
    for frame in range(FRAMES):
        for c in range(len(cameras)):
            order = rng.permutation(2)
            pixels[frame, c], confidence[frame, c] = pixels[frame, c, order], confidence[frame, c, order]
            place[frame, c] = np.argsort(order)
    return cameras, pixels, confidence, place


def test_two_people_are_told_apart_whatever_their_numbers_and_the_longest_seen_is_first(shuffled):
    cameras, pixels, confidence, place = shuffled
    tracks = find_people(cameras, pixels, confidence, rate=worlds.RATE)
    assert [[seen.frame for seen in track.seen] for track in tracks] == [list(range(FRAMES)), list(range(5, 15))]
    for person, (track, blind) in enumerate(zip(tracks, (1, 3), strict=True)):
        for seen in track.seen:
            expected = place[seen.frame, :, person].copy()
            expected[blind] = -1
            np.testing.assert_array_equal(seen.persons, expected)
            assert not seen.agreeing[blind].any()
            assert np.delete(seen.agreeing, blind, 0).all()
    # All sixteen joints in three cameras.
    assert [track.support for track in tracks] == [FRAMES * 48, 10 * 48]


def test_the_joints_are_recovered_in_space(pair, shuffled):
    cameras, pixels, confidence, _ = shuffled
    track = find_people(cameras, pixels, confidence, rate=worlds.RATE)[0]
    errors = np.array([seen.points - joints(pair[0][seen.frame]) for seen in track.seen])
    used = [cameras[c] for c in (0, 2, 3)]
    centre = joints(pair[0][10]).mean(0)
    slopes = np.concatenate([camera.project_with_derivative(centre[None])[1][0] for camera in used])
    expected = NOISE_PX * np.sqrt(np.trace(np.linalg.inv(slopes.T @ slopes)))
    # 320 joints: their root mean square is within a few percent; the distance from the cameras varies by a tenth.
    assert np.sqrt(np.mean(np.sum(errors**2, axis=2))) == pytest.approx(expected, rel=0.2)
    np.testing.assert_allclose(track.seen[3].centre, np.median(track.seen[3].points, axis=0))


def test_a_joint_that_one_image_shows_elsewhere_does_not_agree_and_does_not_pull(pair):
    cameras = worlds.ring(4, size=(400, 240))
    pixels, confidence = detections(pair[:1], cameras)
    wrist = JOINTS.index("left_wrist")
    # 14 px at 94 px/m: nearly twice the tolerance.
    pixels[7, 2, 0, wrist] += 10.0
    seen = find_people(cameras, pixels, confidence, rate=worlds.RATE)[0].seen[7]
    expected = np.ones((4, len(JOINTS)), bool)
    expected[2, wrist] = False
    np.testing.assert_array_equal(seen.agreeing, expected)
    np.testing.assert_allclose(seen.points, joints(pair[0][7]), atol=1e-4)


def test_two_people_of_whom_each_is_seen_by_one_camera_are_nobody(pair):
    cameras = worlds.ring(3, size=(400, 240))
    # One camera sees the first person, another one the second, who stands on a box.
    pixels, confidence = detections([pair[0], walking((-0.45, 0.3), height=0.4)], cameras)
    pixels[:, 0, 1], pixels[:, 1, 0], pixels[:, 2] = np.nan, np.nan, np.nan
    assert find_people(cameras, pixels, confidence, rate=worlds.RATE) == []


def test_joints_of_low_confidence_take_no_part(pair):
    cameras = worlds.ring(3, size=(400, 240))
    pixels, confidence = detections(pair[:1], cameras)
    confidence[:, 2] = 0.29
    tracks = find_people(cameras, pixels, confidence, rate=worlds.RATE)
    assert {tuple(seen.persons) for seen in tracks[0].seen} == {(0, 0, -1)}
    assert find_people(cameras, pixels, np.full_like(confidence, 0.29), rate=worlds.RATE) == []
    lower = AssociationSettings(least_confidence=0.2)
    assert find_people(cameras, pixels, confidence, rate=worlds.RATE, settings=lower)[0].seen[0].persons.min() == 0


@pytest.mark.parametrize(("rate", "tracks"), [(5.0, 1), (4.0, 2)], ids=["1.8 s", "2.25 s"])
def test_after_a_gap_of_two_seconds_a_person_is_another_one(rate, tracks):
    cameras = worlds.ring(3, size=(400, 240))
    there = [*range(3), *range(11, FRAMES)]
    pixels, confidence = detections([walking((0.2, 0.0), there, speed=0.0)], cameras)
    found = find_people(cameras, pixels, confidence, rate=rate)
    assert len(found) == tracks
    frames = sorted((seen.frame for track in found for seen in track.seen), key=int)
    assert frames == there


def test_a_person_who_would_have_to_run_too_fast_is_another_one():
    cameras = worlds.ring(3, size=(400, 240))
    first, then = walking((0.6, 0.0), range(10), speed=0.0), walking((-0.6, 0.0), range(10, FRAMES), speed=0.0)
    pixels, confidence = detections([[a or b for a, b in zip(first, then, strict=True)]], cameras)
    # 1.2 m within a frame: at 30 Hz 36 m/s, at 3 Hz 3.6 m/s.
    assert len(find_people(cameras, pixels, confidence, rate=30.0)) == 2
    assert len(find_people(cameras, pixels, confidence, rate=3.0)) == 1
