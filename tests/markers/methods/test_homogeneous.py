from dataclasses import replace

import numpy as np
import pytest
from tests.skin_clusters import leg_and_bones, placed, problem, smooth_motion, thigh, turns

from marey.geometry import rotations
from marey.markers.data.cluster_data import cluster_data
from marey.markers.data.rigid_fit import rigid
from marey.markers.methods.homogeneous import bone_by_factorisation, homogeneous


def test_a_shape_that_deforms_in_one_way_without_turning_is_followed_to_its_bone(rng):
    rotation, origin = smooth_motion(rng, 60)
    shape = thigh(rng, 10)
    about = shape - shape.mean(0)
    way = rng.normal(size=shape.shape)
    way -= way.mean(0)  # no shift, and no turn to first order, so that what is left is the deformation's own
    inertia = np.eye(3) * (about**2).sum() - about.T @ about
    way -= np.cross(np.linalg.solve(inertia, np.cross(about, way).sum(0)), about)
    weight = 0.008 * (np.cos(2 * np.pi * np.arange(60) / 30) - 1)
    points = placed(rotation, origin, shape + weight[:, None, None] * way) + rng.normal(0, 1e-4, (60, 10, 3))
    trial = problem({"thigh": (rotation, origin)}, {"thigh": points}, frames=[0], noise_m=1e-4)
    data = cluster_data(trial, trial.clusters[0])
    by_rank = [
        np.sqrt((turns(bone_by_factorisation(data, 1e-4, k).rotation[:, 0], rotation) ** 2).mean()) for k in (1, 2)
    ]
    assert by_rank[1] <= by_rank[0]
    assert by_rank[1] < 2e-2


def test_the_bone_is_exact_in_the_known_posture_and_its_covariance_rotates_with_it(rng):
    leg, bones = leg_and_bones(rng, known=[7])
    points = leg.trajectories.points + rng.normal(0, 1e-3, leg.trajectories.points.shape)
    motion = homogeneous(replace(leg, trajectories=replace(leg.trajectories, points=points)))
    for name, (rotation, origin) in bones.items():
        assert turns(motion.bone(name)[0][7], rotation[7]) < 1e-9
        np.testing.assert_allclose(motion.bone(name)[1][7], origin[7], atol=1e-9)
    moments = np.linalg.eigvalsh(motion.covariance[3, 0])
    assert moments.min() > 0
    error = rotations.log(np.swapaxes(motion.rotation[:, 0], 1, 2) @ bones["thigh"][0])
    assert np.sqrt((error**2).mean()) < 3 * motion.rotation_sd[:, 0].mean()


@pytest.mark.slow
def test_too_few_markers_leave_the_frame_empty_and_a_cluster_of_three_is_rigid(rng):
    leg, _ = leg_and_bones(rng)
    points = leg.trajectories.points.copy()
    points[:, 3:9] = np.nan
    points[5, :3] = np.nan
    leg = replace(leg, trajectories=replace(leg.trajectories, points=points))
    motion = homogeneous(leg)
    assert np.flatnonzero(~motion.answered[:, 0]).tolist() == [5]
    assert any("thigh: basis shapes: 1" in note for note in motion.notes)
    assert turns(motion.rotation[6, 0], rigid(leg).rotation[6, 0]) < 1e-9
