"""Tracked points that are carried by their segments, at one position in all frames."""

from dataclasses import replace

import numpy as np
import pytest
from tests.fit import metaball_worlds as world

from marey.body.articulation.pose import PosedBody
from marey.fit.points.person_tracks import ROBUST_SD_SHARE_3D, PersonTracks, PersonTrackSettings
from marey.fit.solver.weights import SCALE_IN_SD, geman_mcclure
from marey.observations.carried_points import CarriedPoints
from marey.surface.tracks.trajectories import Trajectories

NOISE = 2e-4


@pytest.fixture(scope="module")
def scene():
    """An arm in six frames, and points attached to thorax, upper arm and forearm."""
    rng = np.random.default_rng(8)
    space = world.arm_space()
    numbers = np.zeros(len(space))
    numbers[space.names.index("upperarm_length")] = 0.06
    body = world.person(space, numbers)
    poses = dict(enumerate(world.arm_poses(rng, 6)))
    strongest = body.vertex_segments[np.arange(len(body.vertices)), body.vertex_weights.argmax(1)]
    wanted = [body.skeleton.segment(name) for name in ("thorax", "right_upperarm", "right_forearm")]
    which = np.flatnonzero(np.isin(strongest, wanted) & (body.vertex_weights.max(1) > 0.95))
    segment, away = strongest[which], body.vertices[which] - body.joint_centres[strongest[which]]
    posed = [PosedBody(body, pose) for pose in poses.values()]
    position = np.stack(
        [p.segment_origin[segment] + np.einsum("nab,nb->na", p.segment_rotation[segment], away) for p in posed]
    )  # fmt: skip
    position += rng.normal(size=position.shape) * NOISE
    position[rng.random(position.shape[:2]) < 0.1] = np.nan
    tracks = PersonTracks(
        frames=np.array(list(poses)), position=position, variance=np.full(position.shape[:2], NOISE**2),
        skin_sd_m=5e-4, patch_m=1e-6,
    )  # fmt: skip
    return body, poses, tracks, segment


def test_points_are_carried_by_the_segment_on_whose_skin_they_lie(scene):
    body, poses, tracks, segment = scene
    attached = tracks.attached(poses, body)
    known = attached.segment >= 0
    assert known.mean() > 0.9
    np.testing.assert_array_equal(attached.segment[known], segment[known])
    for frame, pose in poses.items():
        _, residual = attached.residuals(frame, PosedBody(body, pose))
        assert np.sqrt(np.mean(residual**2)) == pytest.approx(NOISE * np.sqrt(5 / 6), rel=0.1)


def test_points_in_fewer_frames_than_the_settings_require_are_not_carried(scene):
    body, poses, tracks, _ = scene
    many = replace(tracks, settings=PersonTrackSettings(least_frames=7))
    assert (many.attached(poses, body).segment == -1).all()


def test_the_sum_is_that_of_carried_points(scene):
    body, poses, tracks, _ = scene
    attached, posed = tracks.attached(poses, body), PosedBody(body, poses[2].step(np.full(12, 1e-4)))
    hessian, gradient = attached.terms(2, posed)
    which, residual = attached.residuals(2, posed)
    plain = CarriedPoints(
        segments=attached.segment[which], places=attached.place[which], points=tracks.position[2, which], sigma_m=1.0
    )  # fmt: skip
    rows = plain.linearize(posed, shape=True)
    np.testing.assert_allclose(rows.residual, residual.ravel(), atol=1e-12)
    weight = np.repeat(attached.weights(2, which, residual), 3)
    size = rows.jacobian.shape[1]
    wanted = rows.jacobian.T @ (weight[:, None] * rows.jacobian)
    np.testing.assert_allclose(hessian[:size, :size], wanted, atol=1e-9 * np.abs(wanted).max())
    np.testing.assert_allclose(gradient[:size], rows.jacobian.T @ (weight * rows.residual), atol=1e-6)


def test_the_last_columns_are_the_motion_of_a_segments_positions(scene):
    body, poses, tracks, _ = scene
    attached, posed = tracks.attached(poses, body), PosedBody(body, poses[1])
    _, gradient = attached.terms(1, posed)
    first = len(body.skeleton) + len(body.space)
    k, step = body.skeleton.segment("right_forearm"), 1e-6
    which, residual = attached.residuals(1, posed)
    weight = attached.weights(1, which, residual)
    for column in range(6):
        place = attached.place.copy()
        own = attached.segment == k
        if column < 3:
            place[own, column] += step
        else:
            place[own] += step * np.cross(np.eye(3)[column - 3], place[own])
        _, moved = replace(attached, place=place).residuals(1, posed)
        change = np.sum(weight[:, None] * residual * (moved - residual)) / step
        assert gradient[first + 6 * k + column] == pytest.approx(change, rel=1e-3, abs=1e-2)


def test_a_frame_without_points_contributes_nothing(scene):
    body, poses, tracks, _ = scene
    hessian, gradient = tracks.attached(poses, body).terms(99, PosedBody(body, poses[0]))
    assert not hessian.any()
    assert not gradient.any()


def test_trajectories_of_other_frames_contribute_nothing(scene):
    body, poses, tracks, _ = scene
    other = replace(tracks, frames=tracks.frames + 100)
    attached = other.attached(poses, body)
    assert (attached.segment == -1).all()
    assert attached.reestimated({f: PosedBody(body, pose) for f, pose in poses.items()}).skin_sd_m == other.skin_sd_m


def test_removed_trajectories_are_skipped():
    covariance = np.broadcast_to(np.eye(3) * 4e-8, (2, 3, 3, 3)).copy()
    covariance[0, 2] = np.nan
    nothing = np.full((2, 3, 3), np.nan)
    found = PersonTracks.of(
        Trajectories(
            frames=np.array([4, 5]), rate=30.0, position=np.arange(18.0).reshape(2, 3, 3), velocity=nothing,
            acceleration=nothing, covariance=covariance, camera_names=("a", "b"), pixels=np.zeros((2, 3, 2, 2)),
            removed=np.array([False, True, False]),
        )
    )  # fmt: skip
    np.testing.assert_array_equal(found.position[1], [[9, 10, 11], [15, 16, 17]])
    np.testing.assert_allclose(found.variance, [[4e-8, 0.0], [4e-8, 4e-8]], rtol=1e-6)


def test_the_standard_deviation_of_the_skin_is_recovered(scene):
    body, poses, tracks, _ = scene
    rng = np.random.default_rng(2)
    moving = replace(tracks, position=tracks.position + rng.normal(size=tracks.position.shape) * 0.001)
    bodies = {f: PosedBody(body, pose) for f, pose in poses.items()}
    found = moving
    for _ in range(4):
        found = found.attached(poses, body).reestimated(bodies)
    assert found.skin_sd_m == pytest.approx(0.001, rel=0.15)


def test_the_robust_share_is_the_integral_over_the_weights():
    length = np.linspace(0, 12, 4001)
    density = length**2 * np.exp(-(length**2) / 2)
    weighted = geman_mcclure(length, SCALE_IN_SD) * density
    share = np.sqrt((weighted * length**2).sum() / (3 * weighted.sum()))
    assert pytest.approx(share, abs=1e-3) == ROBUST_SD_SHARE_3D


def test_a_body_without_metaballs_is_rejected(scene):
    body, poses, tracks, _ = scene
    bare = replace(body, metaballs=None)
    with pytest.raises(ValueError, match="metaballs"):
        tracks.attached(poses, bare).terms(0, PosedBody(bare, poses[0]))
