from dataclasses import replace

import numpy as np
import pytest
from tests import worlds

from marey.body.articulation.pose import PosedBody
from marey.cameras.shutter import row_shares
from marey.fit.solver.picture_times import PictureRows, PictureTimes, advanced_poses
from marey.fit.solver.pose_solver import match_cameras
from marey.observations.correspondence import OutlineMatchSettings


def accelerated(frame):
    """The pose of a uniformly accelerated motion; rotations about one axis only, so that it is exact."""
    body = worlds.person()
    pose = worlds.pose(body, yaw=0.1 * frame + 0.02 * frame**2, at=(0.03 * frame**2, 0.1 * frame, 0))
    return replace(pose, angles=pose.angles + 0.04 * frame - 0.01 * frame**2)


@pytest.mark.parametrize("late", [-0.5, 0.2, 0.5])
def test_a_uniformly_accelerated_motion_is_advanced_exactly(late):
    poses = {frame: accelerated(frame) for frame in (-1, 0, 1)}
    (found,) = advanced_poses(poses, 0, [late])
    np.testing.assert_allclose(found.change_to(accelerated(late)), 0, atol=1e-12)


def test_at_the_end_of_a_motion_it_is_uniform_and_alone_a_pose_stays():
    poses = {0: accelerated(0), 1: accelerated(1)}
    for frame in (0, 1):
        (between,) = advanced_poses(poses, frame, [0.25 if frame == 0 else -0.75])
        np.testing.assert_allclose(between.change_to(poses[0].between(poses[1], 0.25)), 0, atol=1e-12)
    (alone,) = advanced_poses({3: poses[0]}, 3, [0.4])
    np.testing.assert_allclose(alone.change_to(poses[0]), 0, atol=1e-15)


def test_pictures_of_the_frame_keep_the_posed_body():
    poses = {frame: accelerated(frame) for frame in range(3)}
    posed = PosedBody(worlds.person(), poses[1])
    times = PictureTimes(np.array([[0.0, 0.0, 0.0], [0.3, 0.3, 0.3]]))
    first, second = times.posed(1, posed, poses)
    assert first is posed
    np.testing.assert_allclose(second.pose.change_to(accelerated(1.3)), 0, atol=1e-12)


@pytest.mark.parametrize("residual", ["plane", "ray"])
def test_matches_of_a_late_picture_have_its_residuals_in_the_pose_of_the_frame(residual):
    body = worlds.person()
    posed = [PosedBody(body, pose) for pose in worlds.swing(body, 5)]
    cameras = worlds.ring(2)
    level = worlds.levels([posed[3]], cameras).at(0)
    matching = OutlineMatchSettings(gate=20.0, residual=residual)
    of_frame = match_cameras(posed[2], level.sightings, matching, 6.0, [posed[3], posed[2]])
    of_picture = match_cameras(posed[3], level.sightings, matching, 6.0)
    (stated,), (weight,) = of_frame[0]
    (late,), (late_weight,) = of_picture[0]
    np.testing.assert_allclose(stated.residuals(posed[2]), late.residuals(posed[3]), atol=1e-8)
    np.testing.assert_allclose(weight, late_weight, atol=1e-9)
    assert np.abs(late.residuals(posed[2])).mean() > 2 * np.abs(stated.residuals(posed[2])).mean()
    # The second picture is of the frame's instant: nothing is changed.
    plain = match_cameras(posed[2], level.sightings, matching, 6.0)
    np.testing.assert_array_equal(of_frame[1][0][0].residuals(posed[2]), plain[1][0][0].residuals(posed[2]))


def rolling(cameras, late, readout, side="top"):
    rows = PictureRows(cameras=tuple(cameras), readout=np.array(readout), sides=(side,) * len(cameras))
    return PictureTimes(np.array(late), rows)


@pytest.mark.parametrize("side", ["top", "bottom", "left", "right"])
def test_each_vertex_is_seen_at_the_instant_of_its_row(side):
    body, cameras = worlds.person(), worlds.ring(2)
    velocity = np.array([0.03, -0.05, 0.04])
    poses = {f: worlds.pose(body, at=velocity * f) for f in (0, 1, 2)}
    posed = PosedBody(body, poses[1])
    still, moved = rolling(cameras, [[0.0] * 3, [0.2] * 3], [0.0, 0.6], side).posed(1, posed, poses)
    assert still is posed
    share = row_shares(side, cameras[1].project(moved.vertices), cameras[1].size)
    expected = posed.vertices + (0.2 + 0.6 * np.clip(share, -0.5, 0.5))[:, None] * velocity
    # Each of the three rounds leaves at most 5 % of the error, at first 20 mm: 6 cm per frame are 6 of 240 rows.
    np.testing.assert_allclose(moved.vertices, expected, atol=0.02 * 0.05**3)
    assert np.ptp(share) > 0.2
    np.testing.assert_allclose(moved.pose.translation, velocity * 1.2, atol=1e-12)


def test_matches_of_rows_have_their_residuals_in_the_pose_of_the_frame():
    body, cameras = worlds.person(), worlds.ring(2)
    poses = dict(enumerate(worlds.swing(body, 5)))
    posed, times = PosedBody(body, poses[2]), rolling(cameras, np.zeros((2, 5)), [0.6, 0.6])
    rolled = times.posed(2, posed, poses)
    level = worlds.levels([PosedBody(body, poses[2])], cameras).at(0)
    found = match_cameras(posed, level.sightings, OutlineMatchSettings(gate=20.0), 6.0, rolled)
    for seen, (matches, _) in zip(rolled, found, strict=True):
        (match,) = matches
        motion = seen.points(match.where) - posed.points(match.where)
        own = np.einsum("ni,ni->n", match.normals, posed.points(match.where) + motion)
        stated = np.einsum("ni,ni->n", match.normals, posed.points(match.where)) - match.offsets
        sheer = own - (match.offsets + np.einsum("ni,ni->n", match.normals, motion))
        np.testing.assert_allclose(stated, sheer, atol=1e-12)
        assert np.abs(motion).max() > 1e-3


def test_pixels_of_a_rolling_shutter_are_late_by_their_rows():
    cameras = worlds.ring(2)
    times = rolling(cameras, [[0.0, 0.0], [0.1, 0.2]], [0.0, 0.6])
    pixels = np.array([[[10.0, 0.0], [10.0, cameras[0].height - 1.0]]] * 2)
    np.testing.assert_allclose(times.of_pixels(0, pixels), 0)
    np.testing.assert_allclose(times.of_pixels(1, pixels), [[-0.2, 0.4], [-0.1, 0.5]])
