from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.clusters import moving_cluster
from tests.skin_clusters import placed, problem, rigid_leg, smooth_motion, thigh, turns

from marey.geometry import rotations
from marey.markers.data.clusters import AnatomicalCalibration, Cluster
from marey.markers.data.problem import MarkerProblem
from marey.markers.data.rigid_fit import fit_rigid, in_cluster_frame, rigid
from marey.markers.data.trajectories import trajectories

NOISE = 5e-4


def rotation_by_eigenvalues(cross):
    """The rotations (..., 3, 3) nearest to cross-dispersion matrices, by the eigenvalues of M'M ([Spoor1980])."""
    squared, vectors = np.linalg.eigh(np.swapaxes(cross, -1, -2) @ cross)
    first, second = vectors[..., 2], vectors[..., 1]
    length = np.sqrt(squared[..., None, :])
    # The third axis is the cross product of the first two, so that planar clusters need no special case.
    turned_first = (cross @ first[..., None])[..., 0] / length[..., 2]
    turned_second = (cross @ second[..., None])[..., 0] / length[..., 1]
    before = np.stack([first, second, np.cross(first, second)], -1)
    after = np.stack([turned_first, turned_second, np.cross(turned_first, turned_second)], -1)
    return after @ np.swapaxes(before, -1, -2)


def fit_by_eigenvalues(monkeypatch, shape, points, sd):
    with monkeypatch.context() as context:
        context.setattr(rotations, "nearest", rotation_by_eigenvalues)
        return fit_rigid(shape, points, sd)


def test_the_rotation_equals_that_by_eigenvalues(rng, monkeypatch):
    rotation, origin = smooth_motion(rng, 200)
    shape = thigh(rng, 8)
    points = placed(rotation, origin, shape) + rng.normal(0, 0.01, (200, 8, 3))
    points[3, 2] = np.nan
    sd = rng.uniform(0.2, 3, 8) * NOISE
    ours, reference = fit_rigid(shape, points, sd), fit_by_eigenvalues(monkeypatch, shape, points, sd)
    np.testing.assert_allclose(reference.rotation, ours.rotation, atol=1e-10)
    np.testing.assert_allclose(reference.translation, ours.translation, atol=1e-10)


def test_the_rotation_of_a_planar_cluster_equals_that_by_eigenvalues_without_reflection(rng, monkeypatch):
    rotation, origin = smooth_motion(rng, 50)
    shape = thigh(rng, 5) * [1, 1, 0]
    points = placed(rotation, origin, shape) + rng.normal(0, 1e-3, (50, 5, 3))
    ours, reference = fit_rigid(shape, points, NOISE), fit_by_eigenvalues(monkeypatch, shape, points, NOISE)
    np.testing.assert_allclose(reference.rotation, ours.rotation, atol=1e-10)
    np.testing.assert_allclose(np.linalg.det(ours.rotation), 1)


def test_rigid_markers_give_the_true_bones(rng):
    for known in ([0], [0, 13]):
        leg = rigid_leg(rng, known=known)
        motion = rigid(leg)
        for k, frame in enumerate(known):
            assert turns(motion.rotation[frame], leg.calibration.rotation[k]).max() < 1e-9
        fitted = motion.rotation[:, 0].swapaxes(1, 2) @ leg.trajectories.points[:, 0, :, None]
        place = fitted[..., 0] - np.einsum("fji,fj->fi", motion.rotation[:, 0], motion.origin[:, 0])
        assert np.ptp(place, axis=0).max() < 1e-9


def test_the_stated_covariance_is_that_of_the_errors(rng):
    frames = 4000
    rotation, origin = smooth_motion(rng, frames)
    shape = thigh(rng, 6)
    sd = np.array([1, 2, 1, 3, 1, 1]) * NOISE
    fit = fit_rigid(shape, placed(rotation, origin, shape) + rng.normal(size=(frames, 6, 3)) * sd[:, None], sd)
    turn = rotations.log(np.swapaxes(fit.rotation, 1, 2) @ rotation)
    errors = np.concatenate([turn, origin - fit.translation], 1)
    squared = np.einsum("fa,fab,fb->f", errors, np.linalg.inv(fit.noise_covariance), errors)
    assert squared.mean() == pytest.approx(6, abs=4 * np.sqrt(12 / frames))
    assert fit.variance_ratio.mean() == pytest.approx(1, abs=4 * np.sqrt(2 / 12 / frames))


def test_a_cluster_that_does_not_stay_rigid_states_more_than_the_noise(rng):
    rotation, origin = smooth_motion(rng, 30)
    shape = thigh(rng, 7)
    fit = fit_rigid(shape, placed(rotation, origin, shape) + rng.normal(0, 10 * NOISE, (30, 7, 3)), NOISE)
    ratio = fit.covariance[:, 0, 0] / fit.noise_covariance[:, 0, 0]
    assert np.median(ratio) == pytest.approx(100, rel=0.25)
    still = fit_rigid(shape, placed(rotation, origin, shape), NOISE)
    np.testing.assert_array_equal(still.covariance, still.noise_covariance)


def test_weights_let_a_loose_marker_go(rng):
    rotation, origin = smooth_motion(rng, 20)
    shape = thigh(rng, 6)
    points = placed(rotation, origin, shape)
    points[:, 0] += 0.02
    sd = np.where(np.arange(6) == 0, 1.0, 1e-3)
    assert turns(fit_rigid(shape, points, sd).rotation, rotation).max() < 1e-5
    assert turns(fit_rigid(shape, points, 1e-3).rotation, rotation).max() > 1e-2


def test_frames_with_fewer_than_three_markers_or_collinear_markers_have_no_estimate_and_is_reported(rng):
    rotation, origin = smooth_motion(rng, 10)
    shape = thigh(rng, 5)
    shape[2] = (shape[0] + shape[1]) / 2
    points = placed(rotation, origin, shape) + rng.normal(0, 1e-4, (10, 5, 3))
    points[4, 2:] = np.nan
    points[6, 3:] = np.nan
    motion = rigid(problem({"thigh": (rotation, origin)}, {"thigh": points}, frames=[0]))
    assert np.flatnonzero(~motion.answered[:, 0]).tolist() == [4, 6]
    assert np.isnan(motion.covariance[[4, 6]]).all()
    assert any("1 of 10 frames have fewer than 3 markers" in note for note in motion.notes)
    assert any("1 of 10 frames have collinear markers" in note for note in motion.notes)


def test_a_marker_that_no_known_posture_shows_is_skipped_and_reported(rng):
    leg = rigid_leg(rng)
    points = leg.trajectories.points.copy()
    points[0, 2] = np.nan
    motion = rigid(replace(leg, trajectories=trajectories(leg.trajectories.labels, points, 100.0)))
    assert motion.answered.all()
    assert any("skipped thigh_02" in note for note in motion.notes)


def test_the_walk_on_the_treadmill_is_read_as_its_publishers_meant_it(shared: Path):
    """3.0 degrees for the thigh and 1.7 for the shank, root mean square, with the first frame as reference."""
    with np.load(shared / "data" / "markers" / "sta" / "lmam_treadmill_walking.npz") as stored:
        trial = dict(stored)
    for segment, expected in (("thigh", 3.0), ("shank", 1.7)):
        rotation, origin = trial[f"{segment}_rotation"], trial[f"{segment}_origin"] / 1000
        points = placed(rotation, origin, trial[f"{segment}_markers"] / 1000)
        labels = tuple(f"{segment}_{i:02d}" for i in range(points.shape[1]))
        calibration = AnatomicalCalibration(
            segments=(segment,), frames=np.array([0]), rotation=rotation[:1, None], origin=origin[:1, None]
        )
        motion = rigid(
            MarkerProblem(
                trajectories=trajectories(labels, points, 240.0),
                clusters=(Cluster(segment=segment, labels=labels),),
                calibration=calibration,
            )
        )
        error = np.degrees(np.sqrt((turns(motion.rotation[:, 0], rotation) ** 2).mean()))
        assert error == pytest.approx(expected, abs=0.05)


def test_a_rigid_cluster_stands_still_in_its_own_frame(rng):
    points, rotation, _ = moving_cluster(rng, skin_m=0)
    points[10:20, 2] = np.nan
    local, found, _ = in_cluster_frame(points)
    assert np.nanmax(np.abs(local - np.nanmean(local, 0))) < 1e-12
    np.testing.assert_allclose(found, rotation @ rotation[0].T @ found[0], atol=1e-9)
