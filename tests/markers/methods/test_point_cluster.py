from dataclasses import replace

import numpy as np
import pytest
from tests.skin_clusters import leg_and_bones, placed, problem, smooth_motion, thigh, turns

from marey.geometry import rotations
from marey.markers.methods.point_cluster import cluster_system, point_cluster, point_cluster_masses, redistribute_masses

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


def test_moments_too_nearly_equal_leave_the_frame_empty_and_is_reported(rng):
    rotation, origin = smooth_motion(rng, 12)
    shape = np.concatenate([np.diag([0.1, 0.1, 0.05]), -np.diag([0.1, 0.1, 0.05])])
    points = placed(rotation, origin, shape) + rng.normal(0, NOISE, (12, 6, 3))
    motion = point_cluster(one_segment(rotation, origin, points))
    assert not motion.answered.any()
    assert any("12 of 12 frames have moments of inertia too similar" in note for note in motion.notes)


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


def test_frames_without_enough_markers_are_empty_and_reported(rng):
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


def moments(points, mass):
    centre = (mass[..., None] * points).sum(-2) / mass.sum(-1)[..., None]
    about = points - centre[..., None, :]
    return np.linalg.eigvalsh(np.einsum("...m,...mi,...mj->...ij", mass, about, about))


def test_the_masses_keep_the_eigenvalues(rng):
    shape = thigh(rng, 9)
    points = shape + rng.normal(0, 0.004, (25, 9, 3))
    wanted = np.broadcast_to(moments(shape, np.ones(9)), (25, 3))
    mass, kept = redistribute_masses(points, np.ones((25, 9)), wanted)
    assert kept.all()
    np.testing.assert_allclose(moments(points, mass), wanted, rtol=1e-8)
    assert mass.min() > 0


def test_other_masses_that_keep_them_lie_hardly_nearer_to_unit_masses(rng):
    shape = thigh(rng, 9)
    points = shape + rng.normal(0, 0.004, (1, 9, 3))
    wanted = moments(shape, np.ones(9))[None]
    mass, _ = redistribute_masses(points, np.ones((1, 9)), wanted)
    for _ in range(20):
        other, kept = redistribute_masses(points, mass + rng.normal(0, 0.02, mass.shape), wanted)
        assert kept.all()
        assert np.linalg.norm(mass - 1) < 1.01 * np.linalg.norm(other - 1)


def test_a_rigid_cluster_keeps_its_unit_masses(rng):
    shape = thigh(rng, 6)
    mass, kept = redistribute_masses(shape[None], np.ones((1, 6)), moments(shape, np.ones(6))[None])
    assert kept.all()
    np.testing.assert_allclose(mass, 1)


def test_a_cluster_that_flattens_beyond_what_masses_can_keep_keeps_unit_masses(rng):
    shape = thigh(rng, 7)
    flat = shape * [1, 1, 0]
    mass, kept = redistribute_masses(flat[None], np.ones((1, 7)), moments(shape, np.ones(7))[None])
    assert not kept.any()
    np.testing.assert_array_equal(mass, 1)


def test_missing_markers_keep_no_mass(rng):
    shape = thigh(rng, 8)
    points = shape + rng.normal(0, 0.003, (4, 8, 3))
    points[:, 3] = np.nan
    start = np.ones((4, 8))
    start[:, 3] = 0
    wanted = np.broadcast_to(moments(shape[start[0] > 0], np.ones(7)), (4, 3))
    mass, kept = redistribute_masses(points, start, wanted)
    assert kept.all()
    np.testing.assert_array_equal(mass[:, 3], 0)
