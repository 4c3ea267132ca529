"""Motion of a body from trajectories of points on it."""

import numpy as np
import pytest
from tests.fit import metaball_worlds as world

from marey.body.articulation.pose import PosedBody
from marey.fit.points.carry import CarrySettings, carrying_segments, follow_points, pose_from_points, pose_on_surface
from marey.fit.points.surface_points import FramePoints, PersonPoints
from marey.observations.carried_points import local_places

NOISE = 0.0003


@pytest.fixture(scope="module")
def scene():
    """An arm that bends over eight frames, and points that its segments carry."""
    rng = np.random.default_rng(21)
    space = world.arm_space()
    body = world.person(space, np.zeros(len(space)))
    first = world.arm_poses(rng, 1)[0]
    change = np.concatenate([[0.004, 0, 0.002], np.zeros(3), np.deg2rad([2, -2, 1, 4, 2, 1])])
    poses = {f: first.step((f - 3) * change) for f in range(8)}
    start = PosedBody(body, poses[3])
    points = world.measured(body, poses[3], 500, 0.0, rng).points
    on = carrying_segments(start, points, near_m=0.05)
    places = local_places(start, on, points)
    position = np.full((8, len(points), 3), np.nan)
    for f, pose in poses.items():
        posed = PosedBody(body, pose)
        turned = np.einsum("nab,nb->na", posed.segment_rotation[on], places)
        position[f] = posed.segment_origin[on] + turned + rng.normal(size=points.shape) * NOISE
    return body, poses, position, on


def test_one_step_is_estimated_from_the_points_alone(scene):
    body, poses, position, on = scene
    pose = pose_from_points(PosedBody(body, poses[3]), position[3], position[4], CarrySettings(), segments=on)
    arm = [body.skeleton.segment(f"right_{name}") for name in ("upperarm", "forearm", "hand")]
    away = PosedBody(body, pose).segment_origin[arm] - PosedBody(body, poses[4]).segment_origin[arm]
    # Two measurements' noise over some dozens of points per segment, and levers of a few of their sizes.
    assert np.linalg.norm(away, axis=1).max() < 4 * NOISE
    # The elbow's flexion, and pronation, which a round surface would not show.
    assert np.abs(pose.angles - poses[4].angles).max() < np.deg2rad(0.7)


def test_trajectories_that_slip_do_not_carry_the_body_away(scene, rng):
    body, poses, position, on = scene
    slipped = position[4].copy()
    slipped[::5] += rng.normal(size=slipped[::5].shape) * 0.05
    pose = pose_from_points(PosedBody(body, poses[3]), position[3], slipped, CarrySettings(), segments=on)
    assert np.abs(pose.angles - poses[4].angles).max() < np.deg2rad(1.5)


def test_the_motion_is_tracked_to_both_ends(scene):
    body, poses, position, _ = scene
    gaps = position.copy()
    gaps[0, ::2] = np.nan
    computed = []

    def anchor(frame, pose):
        computed.append(frame)
        return pose

    settings = CarrySettings(unanchored=4)
    found = follow_points(body, (3, poses[3]), range(8), gaps, settings=settings, anchor=anchor)
    assert list(found) == list(range(8))
    assert computed == [7]
    for f, pose in found.items():
        elbow, wrist = (body.skeleton.segment(f"right_{name}") for name in ("forearm", "hand"))
        for k in (elbow, wrist):
            away = PosedBody(body, pose).segment_origin[k] - PosedBody(body, poses[f]).segment_origin[k]
            # Points near a joint lie on the skin of either segment: up to four steps of that.
            assert np.linalg.norm(away) < 0.006


def test_without_points_a_body_stays_where_it_was(scene):
    body, poses, position, _ = scene
    nowhere = np.full_like(position, np.nan)
    found = follow_points(body, (3, poses[3]), range(8), nowhere)
    np.testing.assert_allclose(found[0].angles, poses[3].angles, atol=1e-9)


def test_points_far_from_the_skin_are_ignored(scene):
    body, poses, _, _ = scene
    assert carrying_segments(PosedBody(body, poses[3]), np.array([[5.0, 0, 0]]), near_m=0.05)[0] == -1


def test_a_pose_is_fitted_to_the_points_of_its_frame(scene, rng):
    body, poses, _, _ = scene
    points = world.measured(body, poses[5], 3000, NOISE, rng)
    given = PersonPoints(by_frame={5: FramePoints(points.points, points.covariance)}, model_sd_m=5e-4, scale_m=0.03)
    off = poses[5].step(np.append(rng.normal(size=3) * 0.005, rng.normal(size=3 + len(poses[5].angles)) * 0.02))
    found = pose_on_surface(PosedBody(body, off), given, 5, CarrySettings())
    elbow = body.skeleton.segment("right_forearm")
    away = [
        np.linalg.norm(PosedBody(body, p).segment_origin[elbow] - PosedBody(body, poses[5]).segment_origin[elbow])
        for p in (off, found)
    ]
    assert away[1] < 0.001
    assert away[1] < 0.2 * away[0]
