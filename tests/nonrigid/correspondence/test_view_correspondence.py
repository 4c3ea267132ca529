import numpy as np
import pytest
from tests.nonrigid.filmed_surfaces import CAMERAS, filmed, moving_surface

from marey.errors import SettingProblem
from marey.nonrigid.correspondence.view_correspondence import NOT_MOVING, match_tracks


@pytest.fixture
def random():
    return np.random.default_rng(4)


def two_views(random, *, lone=0, noise=0.005, points=24, **kwargs):
    """Give two cameras' tracks in orders of their own, and the true numbers of their points."""
    surface = moving_surface(random, points=points, **kwargs)
    seen = [random.permutation(np.r_[0 : points - 2 * lone, extra]) for extra in lone_points(points, lone)]
    views = [
        filmed(surface[:, own], camera, scale=scale, noise=noise * scale, random=random)
        for own, camera, scale in zip(seen, CAMERAS[:2], (1.0, 40.0), strict=True)
    ]
    return views, seen


def lone_points(points, lone):
    return np.arange(points - 2 * lone, points - lone), np.arange(points - lone, points)


def right(found, seen):
    return seen[0][found.pairs[:, 0]] == seen[1][found.pairs[:, 1]]


def test_all_points_find_their_partners_from_motion_alone(random):
    views, seen = two_views(random)
    found = match_tracks(*views)
    assert len(found.pairs) == 24
    assert right(found, seen).all()
    assert found.probability.min() > 0.95
    assert found.notes == ()


def test_points_of_one_camera_have_no_partner(random):
    views, seen = two_views(random, lone=4)
    found = match_tracks(*views)
    assert len(found.pairs) == 16
    assert right(found, seen).all()
    assert set(seen[0][found.alone_first]) == {16, 17, 18, 19}
    assert set(seen[1][found.alone_second]) == {20, 21, 22, 23}


def test_exact_tracks_are_matched(random):
    views, seen = two_views(random, noise=0.0)
    found = match_tracks(*views)
    assert len(found.pairs) == 24
    assert right(found, seen).all()


def test_tracks_with_gaps_are_matched(random):
    views, seen = two_views(random)
    for view in views:
        for point in range(view.shape[2]):
            start = random.integers(50)
            view[start : start + 10, :, point] = np.nan
    views[0][20] = np.nan
    found = match_tracks(*views)
    assert right(found, seen).all()
    assert len(found.pairs) >= 23


@pytest.mark.slow
def test_the_order_of_the_cameras_does_not_matter(random):
    views, _ = two_views(random, lone=3)
    there, back = match_tracks(*views), match_tracks(*views[::-1])
    assert set(map(tuple, there.pairs)) == set(map(tuple, back.pairs[:, ::-1]))


def test_points_that_do_not_move_are_not_matched(random):
    still = np.repeat(moving_surface(random, frames=1), 40, axis=0)
    shifting = still + random.normal(size=(40, 1, 3))
    for points, noise in ((still, 0.01), (shifting, 0.01), (still, 0.0)):
        views = [filmed(points, camera, noise=noise, random=random) for camera in CAMERAS[:2]]
        found = match_tracks(*views)
        assert len(found.pairs) == 0
        assert found.notes == (NOT_MOVING,)
        assert len(found.alone_first) == len(found.alone_second) == 24


def test_two_points_that_move_alike_share_their_probability(random):
    surface = moving_surface(random)
    surface[:, 1] = surface[:, 0]
    views = [filmed(surface, camera, noise=0.005, random=random) for camera in CAMERAS[:2]]
    found = match_tracks(*views)
    twins = np.isin(found.pairs[:, 0], (0, 1))
    assert found.probability[twins].max() < 0.95
    assert found.probability[~twins].min() > 0.95
    assert "ambiguous" in found.notes[0]


def test_appearance_distinguishes_points_that_move_alike(random):
    surface = moving_surface(random)
    surface[:, 1] = surface[:, 0]
    views = [filmed(surface, camera, noise=0.005, random=random) for camera in CAMERAS[:2]]
    looks = np.zeros((24, 24))
    looks[:2, :2] = ((15, -15), (-15, 15))
    found = match_tracks(*views, looks)
    assert {(0, 0), (1, 1)} <= set(map(tuple, found.pairs))
    assert found.probability.min() > 0.95


def test_arrays_of_wrong_shape_are_an_error(random):
    views, _ = two_views(random)
    with pytest.raises(SettingProblem, match="same instants"):
        match_tracks(views[0], views[1][1:])
    with pytest.raises(SettingProblem, match="one view"):
        match_tracks(views[0][0], views[1])
    with pytest.raises(SettingProblem, match="appearance"):
        match_tracks(*views, np.zeros((3, 3)))


def test_too_few_points_give_no_pairs(random):
    views, _ = two_views(random)
    found = match_tracks(views[0][:, :, :4], views[1])
    assert len(found.pairs) == 0
    assert "Fewer than 6 points" in found.notes[0]


def test_points_seen_for_part_of_the_time_are_matched(random):
    views, seen = two_views(random)
    late = np.arange(4)
    for view, own in zip(views, seen, strict=True):
        view[25:, :, np.isin(own, late)] = np.nan
    found = match_tracks(*views)
    assert right(found, seen).all()
    assert len(found.pairs) == 24
