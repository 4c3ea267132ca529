import numpy as np
import pytest
from tests.nonrigid.filmed_surfaces import CAMERAS, filmed, moving_surface

from marey.errors import SettingProblem
from marey.nonrigid.correspondence.view_joining import join_views


def three_views(random, seen):
    surface = moving_surface(random, points=26)
    return [
        filmed(surface[:, own], camera, noise=0.005, random=random) for own, camera in zip(seen, CAMERAS, strict=True)
    ]


@pytest.mark.slow
def test_three_cameras_join_to_one_array():
    random = np.random.default_rng(5)
    seen = [random.permutation(own) for own in (np.arange(0, 24), np.arange(2, 26), np.r_[0:12, 14:26])]
    joined = join_views(three_views(random, seen))
    assert joined.points.shape == (3, 26)
    assert joined.tracks.shape == (3, 60, 2, 26)
    for column in joined.points.T:
        names = {int(seen[camera][track]) for camera, track in enumerate(column) if track >= 0}
        assert len(names) == 1
    assert np.array_equal(np.isfinite(joined.tracks[:, 0, 0]), joined.points >= 0)
    assert np.nanmin(joined.probability) > 0.95
    assert len(joined.shared(3)) == 20
    assert len(joined.shared()) == 26


def test_a_camera_without_motion_shares_no_points():
    random = np.random.default_rng(6)
    views = three_views(random, [np.arange(20)] * 3)
    views[1] = np.repeat(views[1][:1], 60, axis=0)
    joined = join_views(views)
    assert len(joined.shared()) == 20
    assert not (joined.points[:, joined.shared()][1] >= 0).any()
    assert any("Camera 2 shares no points" in note for note in joined.notes)


def test_one_camera_is_an_error():
    with pytest.raises(SettingProblem, match="two cameras"):
        join_views([np.zeros((5, 2, 8))])
