from dataclasses import replace

import numpy as np
import pytest
from tests.clusters import moving_cluster

from marey.markers.data.clusters import AnatomicalCalibration, Cluster
from marey.markers.data.trajectories import MarkerTrajectories, trajectories
from marey.markers.preprocessing.faults import find_faults

CLUSTERS = (Cluster(segment="thigh", labels=tuple("abcd")),)


@pytest.fixture
def markers(rng) -> MarkerTrajectories:
    points, _, _ = moving_cluster(rng, frames=40, count=4, skin_m=0.001)
    return trajectories(tuple("abcd"), points, 100.0)


def changed(markers: MarkerTrajectories, points: np.ndarray) -> MarkerTrajectories:
    return replace(markers, points=points)


def test_good_markers_have_no_faults(markers):
    assert find_faults(markers, CLUSTERS) == ()


def test_frames_with_fewer_than_three_markers_are_listed(markers):
    points = markers.points.copy()
    points[[5, 6, 20], :2] = np.nan
    (fault,) = find_faults(changed(markers, points), CLUSTERS)
    assert fault == "thigh: 3 of 40 frames have fewer than 3 markers and no result: 5-6, 20."


def test_a_cluster_that_is_never_whole_has_no_estimate(markers):
    points = markers.points.copy()
    points[:, :2] = np.nan
    faults = find_faults(changed(markers, points), CLUSTERS)
    assert "no frame shows 3 of its markers" in faults[0]
    assert "a, b is not visible in any frame" in faults[1]


def test_an_impossible_size_is_reported_with_the_question_of_its_unit(markers):
    (fault,) = find_faults(changed(markers, markers.points * 10), CLUSTERS)
    assert "Is the file's unit right?" in fault


def test_collinear_markers_are_reported(markers):
    points = markers.points.copy()
    points[:, :, 1:] = points[:, :1, 1:]
    assert any("collinear" in fault for fault in find_faults(changed(markers, points), CLUSTERS))


def test_a_reference_in_another_unit_or_without_the_segment_is_reported(markers):
    still = np.eye(3)[None, None]
    far = AnatomicalCalibration(
        segments=("thigh",), frames=[0], rotation=np.eye(3)[None, None], origin=[[[300.0, 0, 0]]]
    )
    assert "Are its origins in millimetres" in find_faults(markers, CLUSTERS, far)[0]
    other = AnatomicalCalibration(segments=("hip",), frames=[0], rotation=still, origin=[[[0.0, 0, 0]]])
    assert "no reference pose is given for this bone" in find_faults(markers, CLUSTERS, other)[0]
    points = markers.points.copy()
    points[0, :2] = np.nan
    near = replace(far, origin=[[[0.0, 0, 0.8]]])
    assert any("shows 2 of its markers" in fault for fault in find_faults(changed(markers, points), CLUSTERS, near))
