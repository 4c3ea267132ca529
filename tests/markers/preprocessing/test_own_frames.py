"""Calibrations from the clusters' own axes, and calibrations transferred from another trial."""

import numpy as np
import pytest

from marey.errors import MareyError
from marey.geometry import rotations
from marey.markers.data.clusters import Cluster
from marey.markers.data.trajectories import trajectories
from marey.markers.preprocessing.own_frames import BonesAndMarkers, calibration_from_cluster_axes, transfer_calibration

LABELS = ("a", "b", "c", "d")
CLUSTER = (Cluster(segment="thigh", labels=LABELS),)


def moving(rng, frames=12):
    """A cluster that moves, the rotation and place of its bone, and its shape."""
    rotation, origin = rotations.exp(rng.normal(size=(frames, 3))), rng.normal(size=(frames, 3))
    shape = rng.normal(size=(4, 3)) * [0.2, 0.1, 0.05]
    return rotation, origin, shape, origin[:, None] + np.einsum("fij,mj->fmi", rotation, shape)


def test_a_clusters_own_axes_are_right_handed_and_its_origin_the_markers_mean(rng):
    _, _, _, points = moving(rng)
    points[0, 2] = np.nan
    found = calibration_from_cluster_axes(trajectories(LABELS, points, 100.0), CLUSTER)
    # The first frame lacks a marker, so the second is the reference.
    assert found.frames.tolist() == [1]
    np.testing.assert_allclose(found.origin[0, 0], points[1].mean(0))
    turn = found.rotation[0, 0]
    np.testing.assert_allclose(turn.T @ turn, np.eye(3), atol=1e-12)
    assert np.linalg.det(turn) == pytest.approx(1)
    spread = ((points[1] - points[1].mean(0)) @ turn).std(0)
    assert (np.diff(spread) < 0).all()


def test_no_frame_with_three_markers_is_an_error(rng):
    points = moving(rng)[3]
    points[:, :2] = np.nan
    with pytest.raises(MareyError, match="No frame shows 3 markers"):
        calibration_from_cluster_axes(trajectories(LABELS, points, 100.0), CLUSTER)


def test_a_bone_of_another_trial_is_transferred_in_the_frame_that_looks_like_it(rng):
    rotation, origin, shape, points = moving(rng)
    points += 0.003 * rng.normal(size=points.shape) * (np.arange(12) != 7)[:, None, None]
    other = rotations.exp(np.array([0.3, -0.2, 1.0]))
    known = BonesAndMarkers(
        segments=("thigh",), rotation=other[None], origin=np.array([[1.0, 2.0, 3.0]]), labels=LABELS,
        points=shape @ other.T + [1.0, 2.0, 3.0],
    )  # fmt: skip
    found = transfer_calibration(known, trajectories(LABELS, points, 100.0), CLUSTER)
    assert found.calibration.frames.tolist() == [7]
    np.testing.assert_allclose(found.calibration.rotation[0, 0], rotation[7], atol=1e-9)
    np.testing.assert_allclose(found.calibration.origin[0, 0], origin[7], atol=1e-9)
    np.testing.assert_allclose(found.residual_m, 0, atol=1e-9)


def test_a_bone_without_three_markers_in_common_is_skipped(rng):
    _, _, shape, points = moving(rng)
    known = BonesAndMarkers(
        segments=("thigh",),
        rotation=np.eye(3)[None],
        origin=np.zeros((1, 3)),
        labels=("a", "b", "x", "y"),
        points=shape,
    )
    with pytest.raises(MareyError, match="three markers in common"):
        transfer_calibration(known, trajectories(LABELS, points, 100.0), CLUSTER)
