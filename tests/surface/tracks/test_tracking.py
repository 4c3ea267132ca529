from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.distance import cdist
from tests.moving_surface import PIXEL_M, Scene, moving, scene, three_cameras
from tests.surfaces import no_points

from marey.errors import SettingProblem
from marey.surface.tracks.following import ViewPatchSettings
from marey.surface.tracks.tracking import Tracks, track, tracks_from

SETTINGS = ViewPatchSettings(noise=1.0)


def followed(made: Scene, frames, *, cameras=None, settings=SETTINGS, **given) -> list[Tracks]:
    cameras = three_cameras() if cameras is None else cameras
    pictures = made.frames(cameras, list(frames))
    return list(track(pictures, cameras, lambda f: made.seeds(cameras, f), settings=settings, spacing=3.0, **given))


def own_places(made: Scene, tracks: Tracks) -> np.ndarray:
    """Where on the plane the points are (N, 3), NaN where they are not measured [m]."""
    places = made.world_from_plane(tracks.frame).inverse().apply(tracks.position)
    places[~tracks.measured] = np.nan
    return places


@pytest.fixture(scope="module")
def made() -> Scene:
    return scene()


@pytest.fixture(scope="module")
def rows(made) -> list[Tracks]:
    return followed(made, range(9))


@pytest.mark.slow
def test_points_stay_where_they_are_on_the_surface(made, rows):
    first, count = rows[0], len(rows[0])
    assert count > 300
    kept = rows[-1].measured[:count]
    # Those that leave the images are lost; the others are not.
    inside = np.stack([
        camera.sees(camera.project(made.world_from_plane(8).apply(own_places(made, first))), margin=10)
        for camera in three_cameras()
    ])  # fmt: skip
    assert kept[inside.all(axis=0)].mean() > 0.98
    early, late = own_places(made, rows[1])[:count][kept], own_places(made, rows[-1])[:count][kept]
    moved = np.linalg.norm((late - early)[:, [0, 2]], axis=1)
    # 0.05 px correspond to 0.17 mm.
    assert np.nanmedian(moved) < 1.5e-4
    assert np.nanpercentile(moved, 99) < 8e-4


def test_errors_do_not_add_up_from_frame_to_frame(made, rows):
    count = len(rows[0])
    kept = np.all([row.measured[:count] for row in rows], axis=0)
    places = np.stack([own_places(made, row)[:count][kept] for row in rows])[..., [0, 2]]
    apart = np.sqrt(np.mean(np.sum((places[1:] - places[0]) ** 2, axis=-1), axis=-1))
    assert apart.max() < 0.03 * PIXEL_M
    assert apart[-1] < 1.5 * apart[0]


def depths_in_sd(made: Scene, row: Tracks) -> np.ndarray:
    """Errors of the depth of measured points in stated standard deviations."""
    pose, kept = made.world_from_plane(row.frame), row.measured
    spread = np.einsum("i,nij,j->n", pose.rotation[:, 1], row.covariance[kept], pose.rotation[:, 1])
    return own_places(made, row)[kept][:, 1] / np.sqrt(spread)


@pytest.mark.slow
def test_errors_of_depth_have_the_stated_covariance(made, rows):
    exact = followed(made, range(5), settings=replace(SETTINGS, floor_px=0.0))
    away = depths_in_sd(made, exact[-1])
    # Matches in one image are taken as dependent, which they are in part; overlapping patches are not independent.
    assert 0.2 < np.mean(away**2) < 1.5
    assert np.abs(away).max() < 8
    assert stats.normaltest(away).statistic < 60
    # Pictures without compression have no errors beyond the noise: the floor makes the intervals wider.
    assert np.mean(np.abs(depths_in_sd(made, rows[4])) < 1.96) > 0.99


def test_new_points_start_where_the_surface_comes_into_view(rows):
    assert len(rows[-1]) > len(rows[0]) + 20
    for before, row in pairwise(rows):
        shown = row.pixels[:, 1]
        old = np.flatnonzero(row.measured & (np.arange(len(row)) < len(before)) & np.isfinite(shown[:, 0]))
        new = np.flatnonzero(row.measured & (np.arange(len(row)) >= len(before)))
        if len(new):
            # A seed is about 0.1 px from its match.
            assert cdist(shown[new], shown[old]).min() > 2.9


@pytest.mark.slow
def test_two_cameras_are_enough_and_time_may_run_backwards(made):
    cameras = three_cameras(2)
    rows = followed(made, range(5), cameras=cameras)
    count = len(rows[0])
    kept = rows[-1].measured[:count]
    assert kept.mean() > 0.9
    # Frame numbers increase also in a reversed video.
    back = Scene(texture=made.texture, world_from_plane=lambda f: moving(8 - f))
    again = followed(back, range(5))
    kept = again[-1].measured[: len(again[0])]
    assert kept.mean() > 0.85
    places = own_places(back, again[-1])[: len(kept)][kept] - own_places(back, again[1])[: len(kept)][kept]
    assert np.nanmedian(np.linalg.norm(places[:, [0, 2]], axis=1)) < 1.5e-4


@pytest.mark.slow
def test_a_first_step_of_many_pixels_is_found():
    quick = scene(world_from_plane=lambda f: moving(f, step=(0.05, 0.0, 0.02), turn=0.02))
    rows = followed(quick, range(3))
    count = len(rows[0])
    shown = np.stack([
        camera.sees(camera.project(quick.world_from_plane(2).apply(own_places(quick, rows[0]))), margin=10)
        for camera in three_cameras()
    ]).all(axis=0)  # fmt: skip
    assert shown.sum() > 100
    assert rows[-1].measured[:count][shown].mean() > 0.95


def still(frame: float):
    return moving(0.3 * frame, turn=0.01)


def board(frame: float) -> tuple[float, float]:
    """A board of 6 cm that is carried through the images from the left."""
    return -0.25 + 0.04 * frame, -0.19 + 0.04 * frame


@pytest.fixture(scope="module")
def passed() -> tuple[Scene, list[Tracks]]:
    made = scene(world_from_plane=still, hidden=board)
    return made, followed(made, range(13))


@pytest.mark.slow
def test_a_point_that_was_hidden_continues_as_the_same_point(passed):
    made, rows = passed
    count = len(rows[0])
    measured = np.stack([row.measured[:count] for row in rows])
    gaps = ~measured & (np.cumsum(measured, axis=0) > 0) & (np.cumsum(measured[::-1], axis=0)[::-1] > 0)
    assert gaps.any(axis=0).sum() > 100
    returned = gaps.any(axis=0) & measured[-1]
    places = np.stack([own_places(made, row)[:count][returned] for row in rows])
    apart = np.linalg.norm((places[-1] - places[0])[:, [0, 2]], axis=1)
    assert np.percentile(apart, 90) < 1e-3


def test_nothing_is_followed_on_the_board(passed):
    _, rows = passed
    for row in rows[1:]:
        low, high = board(row.frame)
        x, y, _ = row.position[row.measured].T
        # Seen from the middle camera, a metre before the origin.
        across = x / (1 + y) * 0.95
        assert np.mean((across > low + 0.02) & (across < high - 0.02)) < 0.01


@pytest.mark.slow
def test_a_lost_point_is_found_where_a_body_expects_it(made):
    cameras = three_cameras()
    pictures = list(made.frames(cameras, range(4)))
    dark = [(number, [np.full_like(image, 90) for image in images]) for number, images in pictures[2:3]]
    frames = [*pictures[:2], *dark, pictures[3]]

    def seeds(frame):
        return made.seeds(cameras, frame) if frame == 0 else no_points([c.name for c in cameras])

    def expected(frame, last, seen):
        places = [made.world_from_plane(f).inverse().apply(place) for f, place in zip(seen, last, strict=True)]
        return made.world_from_plane(frame).apply(np.array(places)) + [0.004, 0.0, -0.004]

    rows = list(track(frames[:2], cameras, seeds, settings=SETTINGS, spacing=3.0))
    without = list(track(frames, cameras, seeds, settings=SETTINGS, spacing=3.0))
    assert without[2].measured.sum() == 0
    assert without[3].measured.sum() == 0
    again = list(track(frames, cameras, seeds, settings=SETTINGS, spacing=3.0, expected=expected))
    back = again[3].measured
    assert back.mean() > 0.85
    places = own_places(made, again[3])[back] - own_places(made, rows[1])[back]
    assert np.nanmedian(np.linalg.norm(places[:, [0, 2]], axis=1)) < 2e-4


def test_an_interrupted_run_gives_the_same_result(made, rows):
    cameras = three_cameras()
    known = tracks_from(rows[2].arrays())
    resumed = list(
        track(
            made.frames(cameras, range(2, 5)), cameras, lambda f: made.seeds(cameras, f), settings=SETTINGS,
            spacing=3.0, known=known,
        )
    )  # fmt: skip
    assert resumed[-1].started == rows[4].started
    assert [row.frame for row in resumed] == [3, 4]
    np.testing.assert_array_equal(resumed[-1].seen, rows[4].seen)
    np.testing.assert_array_equal(resumed[-1].position, rows[4].position)


@pytest.mark.slow
def test_points_lost_long_ago_are_dropped_and_keep_their_numbers(made):
    settings = ViewPatchSettings(noise=1.0, gap=1)
    cameras = three_cameras()
    rows = list(
        track(made.frames(cameras, range(5)), cameras, lambda f: made.seeds(cameras, f), settings=settings, spacing=3.0)
    )
    for before, row in pairwise(rows):
        assert (np.diff(row.number) > 0).all()
        assert row.number.max() < row.started
        assert row.seen.min() >= before.frame
        shared = np.isin(before.number, row.number)
        moved = row.position[np.isin(row.number, before.number)] - before.position[shared]
        assert np.linalg.norm(moved, axis=1).max() < 0.02
    assert len(rows[-1]) < rows[-1].started


def test_what_was_known_before_is_not_changed(made):
    cameras = three_cameras()
    rows = []
    for row in track(made.frames(cameras, range(3)), cameras, lambda f: made.seeds(cameras, f), settings=SETTINGS):
        rows.append((row, {name: value.copy() for name, value in row.arrays().items()}))
    for (row, copy), _ in pairwise(rows):
        for name, value in row.arrays().items():
            np.testing.assert_array_equal(value, copy[name])


def test_without_texture_nothing_is_followed(made):
    cameras = three_cameras()
    flat = [(f, [np.full((120, 150), 100, np.uint8)] * 3) for f in range(2)]
    rows = list(track(flat, cameras, lambda f: made.seeds(cameras, f), settings=SETTINGS))
    assert len(rows[-1]) == 0


@pytest.mark.parametrize("given", [{"box": 0.0}, {"alike": 1.5}, {"size": 12}, {"residual": -1.0}])
def test_impossible_settings_are_rejected(given):
    with pytest.raises(SettingProblem, match=f"{next(iter(given))} is"):
        ViewPatchSettings(**given)
