"""What explains that markers have another shape than in another trial: recovered from planted faults."""

from dataclasses import replace

import numpy as np
import pytest
from tests.clusters import moving_cluster

from marey.markers.data.clusters import Cluster
from marey.markers.data.trajectories import MarkerTrajectories, trajectories
from marey.markers.preprocessing.posture_repairs import PostureRepair, posture_distance, posture_repairs, side_pairs

CLUSTERS = tuple(
    Cluster(segment=f"{side}_thigh", labels=tuple(f"{side[0].upper()}T{k}" for k in range(5)))
    for side in ("left", "right")
)
SKIN_M = 0.001


@pytest.fixture
def markers(rng) -> MarkerTrajectories:
    points = np.concatenate([moving_cluster(rng, frames=40, count=5, skin_m=SKIN_M)[0] for _ in CLUSTERS], 1)
    return trajectories([label for cluster in CLUSTERS for label in cluster.labels], points, 100.0)


@pytest.fixture
def known(markers) -> dict[str, np.ndarray]:
    return dict(zip(markers.labels, np.array(markers.points[7]), strict=True))


def only(repairs: tuple[PostureRepair, ...]) -> PostureRepair:
    assert len(repairs) == 1
    return repairs[0]


def test_the_same_markers_need_no_repair(markers, known):
    assert posture_repairs(markers, CLUSTERS, known) == ()
    # Two postures differ by the skin's motion in both.
    assert posture_distance(markers, CLUSTERS, known) < 4 * SKIN_M


@pytest.mark.parametrize("factor", [0.001, 0.1, 10.0, 1000.0])
def test_a_factor_between_units_is_found(markers, known, factor):
    found = only(posture_repairs(replace(markers, points=factor * markers.points), CLUSTERS, known))
    assert (found.kind, found.value) == ("unit", factor)
    assert found.after_m == pytest.approx(posture_distance(markers, CLUSTERS, known))


def test_a_size_between_two_units_is_not_a_unit(markers, known):
    found = only(posture_repairs(replace(markers, points=3.0 * markers.points), CLUSTERS, known))
    assert found.kind == "unlike"
    assert found.names == ("left_thigh", "right_thigh")


def test_a_mirror_image_is_found(markers, known):
    found = only(posture_repairs(replace(markers, points=markers.points * [1, 1, -1]), CLUSTERS, known))
    assert found.kind == "mirrored"
    assert found.after_m == pytest.approx(posture_distance(markers, CLUSTERS, known))


def test_exchanged_sides_are_found(markers, known):
    order = [markers.labels.index(side_pairs(markers.labels)[label]) for label in markers.labels]
    found = only(posture_repairs(replace(markers, points=markers.points[:, order]), CLUSTERS, known))
    assert found.kind == "sides"
    assert found.after_m < 4 * SKIN_M < found.before_m


def test_a_moved_marker_is_found_with_its_distance(markers, known):
    known["LT3"] = known["LT3"] + [0.03, 0.0, 0.04]
    found = only(posture_repairs(markers, CLUSTERS, known))
    assert (found.kind, found.segment, found.names) == ("moved", "left_thigh", ("LT3",))
    # Its distance is from the places of markers that move by the skin's motion.
    assert found.value == pytest.approx(0.05, abs=10 * SKIN_M)


def test_one_of_four_markers_that_moved_is_among_those_that_may_have(rng):
    points = moving_cluster(rng, frames=40, count=4, skin_m=SKIN_M)[0]
    markers = trajectories("abcd", points, 100.0)
    known = dict(zip("abcd", np.array(points[7]), strict=True))
    known["c"] = known["c"] + [0.0, 0.06, 0.0]
    found = only(posture_repairs(markers, [Cluster(segment="shank", labels=tuple("abcd"))], known))
    assert found.kind == "moved"
    assert "c" in found.names


def test_clusters_without_three_common_markers_are_not_judged(markers, known):
    few = {label: known[label] for label in ("LT0", "LT1")}
    assert posture_repairs(markers, CLUSTERS, few) == ()


def test_labels_of_the_two_sides_are_paired():
    pairs = side_pairs(["L.Heel", "R.Heel", "LFLA", "RFLA", "left_ME", "right_ME", "C7", "STRN", "Left1", "Right1"])
    assert pairs == {
        "L.Heel": "R.Heel", "R.Heel": "L.Heel", "LFLA": "RFLA", "RFLA": "LFLA", "left_ME": "right_ME",
        "right_ME": "left_ME", "Left1": "Right1", "Right1": "Left1",
    }  # fmt: skip
