import numpy as np
import pytest
from tests.clusters import moving_cluster

from marey.markers.data.clusters import Cluster
from marey.markers.data.trajectories import MarkerTrajectories, trajectories
from marey.markers.preprocessing.exchanges import (
    LabelExchange,
    LabelExchangeSettings,
    exchanges_against_posture,
    find_exchanges,
    ranges,
    undo_exchanges,
)

THIGH, SHANK = tuple(f"thigh_{n}" for n in range(5)), tuple(f"shank_{n}" for n in range(4))
CLUSTERS = (Cluster(segment="thigh", labels=THIGH), Cluster(segment="shank", labels=SHANK))


@pytest.fixture
def right(rng) -> MarkerTrajectories:
    thigh, _, _ = moving_cluster(rng, frames=80, count=5, skin_m=0.002)
    shank, _, _ = moving_cluster(rng, frames=80, count=4, skin_m=0.002)
    return trajectories((*THIGH, *SHANK), np.concatenate([thigh, shank[::-1]], 1), 100.0)


def exchanged(markers: MarkerTrajectories, first: str, second: str, start: int, end: int):
    frames = np.zeros(len(markers), bool)
    frames[start:end] = True
    exchange = LabelExchange(labels=(first, second), frames=frames)
    return undo_exchanges(markers, [exchange]), exchange


def test_correct_labels_are_not_reported(right):
    assert find_exchanges(right, CLUSTERS) == ()


@pytest.mark.parametrize(("first", "second"), [("thigh_1", "thigh_3"), ("thigh_0", "shank_2")])
def test_a_pair_that_is_exchanged_for_a_while_is_named_with_its_frames(right, first: str, second: str):
    wrong, exchange = exchanged(right, first, second, 10, 30)
    (found,) = find_exchanges(wrong, CLUSTERS)
    assert found.labels == (first, second)
    np.testing.assert_array_equal(found.frames, exchange.frames)
    assert found.note == f"{first} and {second} look exchanged in the frames 10-29."
    np.testing.assert_array_equal(undo_exchanges(wrong, [found]).points, right.points)


def test_a_pair_of_two_segments_that_is_exchanged_over_the_whole_trial_is_named(right):
    wrong, _ = exchanged(right, "thigh_4", "shank_0", 0, 80)
    (found,) = find_exchanges(wrong, CLUSTERS)
    assert (found.labels, found.frames.all()) == (("thigh_4", "shank_0"), True)
    assert "in every frame" in found.note


def test_a_pair_of_one_segment_that_is_exchanged_over_the_whole_trial_needs_a_posture_with_right_labels(right):
    wrong, _ = exchanged(right, "thigh_1", "thigh_3", 0, 80)
    assert find_exchanges(wrong, CLUSTERS) == ()
    (found,) = find_exchanges(wrong, CLUSTERS, right.points[40])
    assert (found.labels, found.frames.all()) == (("thigh_1", "thigh_3"), True)
    (against,) = exchanges_against_posture(
        wrong, CLUSTERS, (*right.labels, "further"), np.vstack([right.points[40], np.zeros(3)])
    )
    assert against.labels == ("thigh_1", "thigh_3")
    assert exchanges_against_posture(right, CLUSTERS, right.labels, right.points[40]) == ()


def test_a_long_trial_is_processed_in_sections(right, monkeypatch):
    wrong, exchange = exchanged(right, "thigh_1", "thigh_3", 10, 30)
    whole = find_exchanges(wrong, CLUSTERS)
    monkeypatch.setattr("marey.markers.preprocessing.exchanges._MAXIMUM_DISTANCES", 81 * 25)
    parts = find_exchanges(wrong, CLUSTERS)
    assert [x.labels for x in parts] == [x.labels for x in whole]
    np.testing.assert_array_equal(parts[0].frames, exchange.frames)


def test_a_larger_least_gain_reports_fewer_exchanges(right):
    wrong, _ = exchanged(right, "thigh_1", "thigh_3", 10, 30)
    assert len(find_exchanges(wrong, CLUSTERS)) == 1
    assert find_exchanges(wrong, CLUSTERS, settings=LabelExchangeSettings(least_gain_m=1.0)) == ()


def test_frames_are_written_as_ranges():
    frames = np.zeros(12, bool)
    frames[[0, 1, 2, 5, 8, 9]] = True
    assert ranges(frames) == "0-2, 5, 8-9"
    assert ranges(frames, most=1) == "0-2 and 2 further ranges"


def test_markers_that_lie_alike_to_the_rest_are_found_by_their_jumps():
    shape = np.array([[0, 0, 0], [0.2, 0, 0], [0.1, 0.1, 0], [0.1, -0.1, 0.0]])
    time = np.arange(60) / 100
    points = shape + np.stack([time, np.sin(6 * time), 0 * time], -1)[:, None]
    kite = trajectories(tuple("abcd"), points, 100.0)
    cluster = (Cluster(segment="kite", labels=tuple("abcd")),)
    assert find_exchanges(kite, cluster) == ()
    wrong, exchange = exchanged(kite, "c", "d", 20, 35)
    (found,) = find_exchanges(wrong, cluster)
    assert found.labels == ("c", "d")
    np.testing.assert_array_equal(found.frames, exchange.frames)
