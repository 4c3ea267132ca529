"""Markers on their bones: rigid ones stay, gaps stay gaps."""

import numpy as np

from marey.geometry import rotations
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.data.clusters import Cluster
from marey.markers.data.marker_motion import marker_motion
from marey.markers.data.trajectories import trajectories


def test_markers_that_ride_on_the_bone_stay_and_one_that_slides_shows(rng):
    frames = 50
    rotation, origin = rotations.exp(rng.normal(size=(frames, 3))), rng.normal(size=(frames, 3))
    places = rng.normal(size=(4, 3))
    slide = np.zeros((frames, 4, 3))
    slide[:, 3, 0] = 0.01 * np.sin(np.linspace(0, 20, frames))
    points = origin[:, None] + np.einsum("fij,fmj->fmi", rotation, places + slide)
    points[7, 1] = np.nan
    labels = ("a", "b", "c", "d")
    motion = BoneMotion(
        segments=("thigh",), rotation=rotation[:, None], origin=origin[:, None],
        covariance=np.zeros((frames, 1, 6, 6)),
    )  # fmt: skip
    clusters = [Cluster(segment="thigh", labels=labels), Cluster(segment="foot", labels=("x",))]
    found = marker_motion(trajectories(labels, points, 50.0), clusters, motion)
    assert (found.labels, found.segments) == (labels, ("thigh",) * 4)
    np.testing.assert_allclose(found.places[0, 0], places[0], atol=1e-12)
    assert np.isnan(found.places[7, 1]).all()
    np.testing.assert_allclose(found.rms[:3], 0, atol=1e-12)
    np.testing.assert_allclose(found.rms[3], slide[:, 3, 0].std(), rtol=1e-9)
    np.testing.assert_allclose(found.of("thigh")[0], np.sqrt((found.moved[0, 3] ** 2).sum() / 4), rtol=1e-9)
