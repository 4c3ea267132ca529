from dataclasses import replace

import numpy as np
import pytest
from tests.clusters import moving_cluster

from marey.markers.data.clusters import Cluster
from marey.markers.data.trajectories import MarkerTrajectories, trajectories
from marey.markers.preprocessing.gaps import (
    FROM_CLUSTER,
    MEASURED,
    SPLINE,
    STILL_MISSING,
    HeldOutGapSettings,
    fill_gaps,
    spline,
)

CLUSTER = (Cluster(segment="thigh", labels=tuple("abcdef")),)


@pytest.fixture
def whole(rng) -> np.ndarray:
    points, _, _ = moving_cluster(rng, skin_m=0.002, noise_m=1e-4)
    return points


def with_gaps(points: np.ndarray, *gaps: tuple[int, int, int]) -> MarkerTrajectories:
    points = points.copy()
    for marker, start, end in gaps:
        points[start:end, marker] = np.nan
    markers = trajectories(tuple("abcdef"), points, 100.0)
    return replace(markers, residuals=np.where(markers.present, 2e-4, np.nan))


@pytest.mark.slow
def test_a_short_gap_is_filled_by_the_spline_and_a_long_one_by_the_cluster(whole):
    holed = with_gaps(whole, (0, 50, 51), (3, 60, 100))
    filled = fill_gaps(holed, CLUSTER)
    assert set(filled.way[60:100, 3]) == {FROM_CLUSTER}
    off = np.linalg.norm(filled.trajectories.points - whole, axis=-1)
    assert off[50, 0] < 1e-3
    assert off[60:100, 3].max() < 4e-3
    assert off[holed.present].max() == 0
    np.testing.assert_array_equal(filled.trajectories.filled, ~holed.present)
    np.testing.assert_array_equal(np.isnan(filled.trajectories.residuals), ~holed.present)


@pytest.mark.slow
def test_the_stated_deviation_is_what_held_out_gaps_showed(whole):
    filled = fill_gaps(with_gaps(whole, (3, 60, 100)), CLUSTER)
    off = np.linalg.norm(filled.trajectories.points - whole, axis=-1)[60:100, 3]
    stated = np.sqrt(3) * filled.sd[60, 3]
    assert 0.2 < np.sqrt((off**2).mean()) / stated < 5
    assert np.isnan(filled.sd[filled.way == MEASURED]).all()


@pytest.mark.slow
def test_what_cannot_be_filled_well_stays_empty_and_is_reported(whole):
    alone = with_gaps(whole, *((m, 40, 110) for m in range(6)))
    filled = fill_gaps(alone, CLUSTER, largest_error_m=1e-3)
    assert (filled.way[40:110] == STILL_MISSING).all()
    assert not filled.trajectories.present[40:110].any()
    assert "420 missing points were left empty" in filled.notes[-1]


def test_a_marker_of_no_cluster_is_never_continued_past_its_ends(whole):
    filled = fill_gaps(with_gaps(whole, (0, 0, 4), (0, 50, 52), (1, 140, 150)))
    assert (filled.way[:4, 0] == STILL_MISSING).all()
    assert (filled.way[140:, 1] == STILL_MISSING).all()
    assert (filled.way[50:52, 0] == SPLINE).all()


@pytest.mark.slow
def test_settings_limit_the_lengths_of_artificial_gaps_and_what_they_may_predict(whole):
    holed = with_gaps(whole, (3, 60, 100))
    short = fill_gaps(holed, CLUSTER, settings=HeldOutGapSettings(lengths=(1, 2, 4)))
    assert short.held_out[0].lengths.max() == 4
    assert (short.way[60:100, 3] == STILL_MISSING).all()
    far = fill_gaps(holed, CLUSTER, settings=HeldOutGapSettings(lengths=(1, 2, 4), reach_ratio=10.0))
    assert (far.way[60:100, 3] == FROM_CLUSTER).all()


def test_a_trial_without_gaps_is_left_as_it_is(whole):
    filled = fill_gaps(with_gaps(whole), CLUSTER)
    np.testing.assert_array_equal(filled.trajectories.points, whole)
    assert filled.notes == ()


def test_a_spline_follows_a_smooth_path_through_a_gap_and_a_line_exactly():
    time = np.arange(40.0) / 100
    path = np.stack([time, np.sin(6 * time), np.cos(9 * time)], -1)[:, None]
    holed = path.copy()
    holed[18:22] = np.nan
    through = spline(holed)
    np.testing.assert_allclose(through[..., 0], path[..., 0], atol=1e-12)
    np.testing.assert_allclose(through, path, atol=5e-3)  # of ways of half a metre
