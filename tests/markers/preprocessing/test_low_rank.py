import numpy as np
from tests.clusters import moving_cluster

from marey.markers.preprocessing.low_rank import complete, predict_markers


def test_a_matrix_of_low_rank_is_completed(rng):
    whole = rng.normal(size=(60, 2)) @ rng.normal(size=(2, 9)) + rng.normal(size=9)
    holed = np.where(rng.uniform(size=whole.shape) < 0.2, np.nan, whole)
    np.testing.assert_allclose(complete(holed, 2), whole, atol=1e-3)
    np.testing.assert_allclose(complete(holed, 0)[3], np.nanmean(holed, 0))


def test_a_column_that_is_never_known_stays_unknown(rng):
    values = rng.normal(size=(20, 4))
    values[:, 1] = np.nan
    completed = complete(values, 1)
    assert np.isnan(completed[:, 1]).all()
    assert np.isfinite(completed[:, [0, 2, 3]]).all()


def test_a_missing_marker_is_predicted_by_the_others(rng):
    points, _, _ = moving_cluster(rng, count=8)
    holed = points.copy()
    holed[40:90, 3] = np.nan
    still = np.linalg.norm(predict_markers(holed, 0) - points, axis=-1)[40:90, 3]
    moving = np.linalg.norm(predict_markers(holed, 2) - points, axis=-1)[40:90, 3]
    assert np.sqrt((moving**2).mean()) < 0.2 * np.sqrt((still**2).mean())


def test_frames_with_two_markers_have_no_estimate(rng):
    points, _, _ = moving_cluster(rng, count=4)
    points[5, 2:] = np.nan
    assert np.isnan(predict_markers(points, 0)[5]).all()
