import numpy as np
import pytest
from tests.nonrigid.filmed_surfaces import CAMERAS, filmed, moving_surface

from marey.nonrigid.tracking.stray_places import without_strays


def views(random, points=24):
    surface = moving_surface(random, points=points)
    return np.stack([filmed(surface, camera, scale=60, noise=0.1, random=random) for camera in CAMERAS])


@pytest.mark.slow
def test_outliers_are_removed_and_other_positions_kept():
    random = np.random.default_rng(0)
    tracks = views(random)
    strays = np.zeros((3, 60, 24), bool)
    for camera, point in ((0, 3), (1, 17), (2, 20)):
        start = random.integers(10, 40)
        strays[camera, start : start + 8, point] = True
    tracks = tracks + 8.0 * strays[:, :, None]
    kept = np.isfinite(without_strays(tracks, np.full(tracks.shape, 0.1))[:, :, 0])
    assert not kept[strays].any()
    assert kept[~strays].mean() > 0.98


@pytest.mark.slow
def test_short_appearances_and_nearly_empty_frames_are_removed():
    tracks = views(np.random.default_rng(1))
    tracks[0, 20:, :, 5] = np.nan
    tracks[0, 40:42, :, 5] = 300.0
    tracks[1, 50, :, 5:] = np.nan
    kept = np.isfinite(without_strays(tracks, np.full(tracks.shape, 0.1))[:, :, 0])
    assert not kept[0, 20:, 5].any()
    assert not kept[1, 50].any()
    assert kept[0, :20, 5].all()
