from dataclasses import replace

import numpy as np
import pytest
from tests.skin_clusters import leg_and_bones, placed, problem, smooth_motion, thigh, turns

from marey.geometry import rotations
from marey.markers.methods.point_cluster import cluster_system, point_cluster, point_cluster_masses

NOISE = 5e-4


def one_segment(rotation, origin, points, frames=(0,)):
    return problem({"thigh": (rotation, origin)}, {"thigh": points}, frames=list(frames), noise_m=NOISE)


def test_centre_and_axes_carry_the_local_coordinates_to_the_markers(rng):
    """[Alexander2003] eq. (2): G = C + E L, with the same L in every frame of a rigid cluster."""
    rotation, origin = smooth_motion(rng, 30)
    points = placed(rotation, origin, thigh(rng, 8))
    system = cluster_system(points, np.ones((30, 8)), rotation)
    local = np.einsum("fji,fmj->fmi", system.axes, points - system.centre[:, None])
    np.testing.assert_allclose(local, np.broadcast_to(local[0], local.shape), atol=1e-12)
    np.testing.assert_allclose(
        np.einsum("fmi,fmj->fij", local, local), system.moments[:, :, None] * np.eye(3), atol=1e-14
    )
    np.testing.assert_allclose(np.linalg.det(system.axes), 1)


def test_axes_stay_with_the_segment_where_the_order_of_the_moments_changes(rng):
    shape = np.concatenate([np.diag([0.1, 0.08, 0.05]), -np.diag([0.1, 0.08, 0.05])])
    stretch = np.linspace(0.8, 1.4, 60)  # along y: its moment passes that along x at 1.25
    places = shape * np.stack([np.ones(60), stretch, np.ones(60)], -1)[:, None]
    rotation, origin = smooth_motion(rng, 60)
    system = cluster_system(placed(rotation, origin, places), np.ones((60, 6)), rotation)
    clear = np.abs(stretch - 1.25) > 0.02
    assert turns(system.axes, rotation)[clear].max() < 1e-9
    assert (np.diff(np.sign(system.moments[:, 0] - system.moments[:, 1])) != 0).sum() == 1


def test_moments_too_nearly_equal_leave_the_frame_empty_and_it_is_said(rng):
    rotation, origin = smooth_motion(rng, 12)
    shape = np.concatenate([np.diag([0.1, 0.1, 0.05]), -np.diag([0.1, 0.1, 0.05])])
    points = placed(rotation, origin, shape) + rng.normal(0, NOISE, (12, 6, 3))
    motion = point_cluster(one_segment(rotation, origin, points))
    assert not motion.answered.any()
    assert any("12 of 12 frames have moments of inertia too nearly equal" in note for note in motion.notes)


def test_the_stated_covariance_is_that_of_the_errors(rng):
    frames = 4000
    rotation, origin = smooth_motion(rng, frames)
    shape = thigh(rng, 7)
    points = placed(rotation, origin, shape)
    points[1:] += rng.normal(0, NOISE, (frames - 1, 7, 3))
    motion = point_cluster(one_segment(rotation, origin, points))
    turn = rotations.log(np.swapaxes(motion.rotation[1:, 0], 1, 2) @ rotation[1:])
    errors = np.concatenate([turn, origin[1:] - motion.origin[1:, 0]], 1)
    squared = np.einsum("fa,fab,fb->f", errors, np.linalg.inv(motion.covariance[1:, 0]), errors)
    # The stated variance is never below that of the noise, so the ratio lies a little under 6, not above.
    assert 4 < squared.mean() < 6 + 4 * np.sqrt(12 / frames)


def test_a_marker_that_goes_missing_changes_nothing_on_a_rigid_cluster(rng):
    leg, bones = leg_and_bones(rng)
    points = leg.trajectories.points.copy()
    points[5:9, 1] = np.nan
    for method in (point_cluster, point_cluster_masses):
        motion = method(replace(leg, trajectories=replace(leg.trajectories, points=points)))
        assert turns(motion.rotation[:, 0], bones["thigh"][0]).max() < 1e-9


def test_frames_without_enough_markers_are_empty_and_said(rng):
    leg, _ = leg_and_bones(rng)
    points = leg.trajectories.points.copy()
    points[5, :7] = np.nan
    motion = point_cluster_masses(replace(leg, trajectories=replace(leg.trajectories, points=points)))
    assert np.flatnonzero(~motion.answered[:, 0]).tolist() == [5]
    assert any("1 of 40 frames have fewer than 3 markers" in note for note in motion.notes)


def test_redistributed_masses_help_where_one_marker_slips_along_the_bone(rng):
    rotation, origin = smooth_motion(rng, 20)
    places = np.broadcast_to(thigh(rng, 8), (20, 8, 3)).copy()
    places[1:, 0] += [0.0, 0.02, 0.0]
    leg = one_segment(rotation, origin, placed(rotation, origin, places))
    plain, masses = point_cluster(leg), point_cluster_masses(leg)
    shift = [np.linalg.norm(m.origin[1:, 0] - origin[1:], axis=-1).mean() for m in (plain, masses)]
    assert shift[0] == pytest.approx(0.02 / 8, rel=0.5)
    assert np.isfinite(shift[1])
